"""A touch probe on a ball: the measured point is on a sphere, wherever that stands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from identification.arrays import Array
from identification.instruments.base import PLACE, Guide, OwnValue, register_instrument
from identification.instruments.distance import Distance, distance_to_center
from identification.instruments.search import Placement, Unplaced
from identification.instruments.surfaces import CenterStarts, FreeSphereStarts, placed_by_lengths
from identification.kinematics.parameters import Parameter

RADIUS = "sphere.radius"  # [mm] the parameter, where the arm file does not say it


@register_instrument
@dataclass(frozen=True)
class Sphere(Distance):
    """Its frame has the origin at the center of the ball.

    radius : [mm] of ball and stylus tip together; None: a parameter, and read are heights above the surface
    """

    kind = "sphere"
    keys = frozenset({"center_mm", "radius_mm"})
    coordinates = ()
    target = "surface"
    offers = frozenset()
    guide = Guide(
        about="a touch probe: the measured point is on a ball, wherever that stands",
        table='kind = "sphere"\n'
        "radius_mm = 15.0  # EXAMPLE: of the ball and of the stylus' tip, together; left out: unknown, found from the "
        "data",
        reads="touch",
        stands="ball",
        labels="ball that is touched, a new one wherever it is moved",
        touches="a ball in two places or more",
    )

    radius: float | None = None

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return distance_to_center(point) - (values[0] if self.radius is None else 0.0)

    @property
    def touched(self) -> float:
        return self.radius or 0.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter(RADIUS, "mm", kind=PLACE),) if self.radius is None else ()

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        for value in super().own_values(values):
            text = "of ball and stylus tip together; known as well as the size of the arm"
            yield value._replace(name="sphere radius", convention=text)

    def unknown(self, values: Mapping[str, float]) -> str:
        return "radius_mm" if self.radius is None and values.get(RADIUS, 0.0) <= 0.0 else ""

    @property
    def size_is_open(self) -> tuple[str, str]:
        return ("contacts with spheres of unknown radius", "give radius_mm") if self.radius is None else ("", "")

    def place(self, rows: Unplaced) -> Placement:
        """Of an unknown radius readings may be any constant: they are heights above the ball."""
        state = FreeSphereStarts if self.radius is None else CenterStarts
        return placed_by_lengths(state, rows)

    def settled(self, starts: Array, residuals: Callable[[Array], Array], own: list[int]) -> tuple[Array, list[int]]:
        """An unknown radius is the mean distance from the center. An arm that shrinks with its sphere would explain any
        residual to first order, since heights above the sphere are homogeneous in all lengths, so the radius is held
        first; where nothing but noise is left, the arm explains no more than that."""
        starts[:, own] -= residuals(starts).mean(axis=(1, 2))[:, None]
        return starts, own

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Sphere:
        return cls(table.get("radius_mm"))

    def table(self) -> dict[str, Any]:
        return super().table() | ({} if self.radius is None else {"radius_mm": float(self.radius)})
