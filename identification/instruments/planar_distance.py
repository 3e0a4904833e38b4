"""A ball bar or a draw wire beside a planar arm: how far the tip is from a fixed center in the plane.

The frame is that of the base, and the centers, one for each session, are parameters in it. A turn of arm and centers
together no distance shows: the offset of joint 1 is not estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.instruments.base import PLACE, Coordinate, Instrument, OwnValue, register_instrument
from identification.instruments.distance import distance_to_center
from identification.instruments.search import Placement, Unplaced
from identification.instruments.surfaces import CenterStarts, placed_by_lengths
from identification.kinematics.frames import pose
from identification.kinematics.parameters import JOINT_OFFSET, Parameter


@register_instrument
@dataclass(frozen=True)
class PlanarDistance(Instrument):
    """Distances in the plane of the arm.

    centers : names and places (2,) [mm] in the frame of the base, about, where fits start; empty: not known yet
    numbers : of the centers, by which rows name them, from 0; empty: in order
    """

    kind = "distance"
    axes = "xy"
    keys = frozenset({"center_mm"})
    coordinates = (Coordinate("distance", positive=True),)
    own_targets = "center"

    centers: tuple[tuple[str, tuple[float, float]], ...] = ()
    numbers: tuple[int, ...] = ()

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        center = values[:2] if self.centers else ca.SX.zeros(2)
        for k, number in enumerate(self.numbers):
            center = ca.if_else(target == number, values[2 * k : 2 * k + 2], center)
        return distance_to_center(point - center)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(
            Parameter(f"center[{name}].{axis}", "mm", kind=PLACE, start=start)
            for name, place in self.centers
            for axis, start in zip(self.axes, place, strict=True)
        )

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        for value in super().own_values(values):
            name = f"center {value.name.removeprefix('center[').replace(']', '').replace('.', ' ')}"
            yield value._replace(name=name, convention="of the distances, in the frame of the base")

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset({f"{JOINT_OFFSET}:1"})

    @property
    def targets(self) -> dict[str, Array]:
        return {name: np.array(place) for name, place in self.centers}

    def stands(self, base: Array) -> bool:
        return bool(self.centers)

    def place(self, rows: Unplaced) -> Placement:
        """The center alone is to be found, and is the origin of the base that is found."""
        return placed_by_lengths(CenterStarts, rows._replace(base=None, tool=np.zeros(3)))

    def with_targets(
        self, points: Array, readings: Array, numbers: NDArray[np.int64], names: Sequence[str]
    ) -> PlanarDistance:
        """With the center that explains the distances of each best."""
        reach, measured, centers = float(np.abs(points).max()), np.unique(numbers).tolist(), []
        for number in measured:
            chosen = numbers == number
            frames = np.array([pose((*point, 0.0)) for point in points[chosen]])
            x, y, _ = (-self.place(Unplaced(frames, readings[chosen], reach)).base[:3, 3]).tolist()
            centers.append((names[number], (x, y)))
        return replace(self, centers=tuple(centers), numbers=tuple(measured))

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> PlanarDistance:
        if (center := table.get("center_mm")) is None:
            return cls()
        x, y = (float(coordinate) for coordinate in center)
        return cls((("1", (x, y)),))

    def table(self) -> dict[str, Any]:
        places = [list(place) for _, place in self.centers]
        return super().table() | ({"center_mm": places[0]} if places else {})
