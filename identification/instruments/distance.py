"""A ball bar, a draw wire, a laser distance: how far the measured point is from a fixed center."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from identification.arrays import Array
from identification.instruments.base import Coordinate, Guide, Instrument, register_instrument, relative
from identification.instruments.search import Placement, Unplaced
from identification.instruments.surfaces import CenterStarts, placed_by_lengths
from identification.kinematics.frames import AXES


@register_instrument
@dataclass(frozen=True)
class Distance(Instrument):
    """Its frame has the origin at the center; how that frame is turned no distance shows."""

    kind = "distance"
    keys = frozenset({"center_mm"})
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Coordinate("distance", positive=True),)
    offers = frozenset({"distance"})
    guide = Guide(
        about="a ball bar, a draw wire, a laser distance: how far the measured point is from a fixed center",
        table='kind = "distance"\n'
        "center_mm = [700.0, 0.0, 300.0]  # EXAMPLE: about where the center is, in the frame of the base: plans are "
        "made for it",
        reads="distance",
        stands="center",
    )

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return distance_to_center(point)

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset(f"base.r{axis}" for axis in AXES)

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        return relative(first, base), frozenset(f"w{axis}" for axis in AXES)

    def place(self, rows: Unplaced) -> Placement:
        return placed_by_lengths(CenterStarts, rows)


def distance_to_center(point: ca.SX) -> ca.SX:
    """[mm] of a point (3,) from the origin."""
    return ca.sqrt(ca.sumsqr(point) + 1e-9**2)  # a point this near [mm] has no direction from there
