"""Distances beside a planar arm, whose centers stand in the frame of the base."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.instruments.base import AtTargets, OwnValue, Placement, Unplaced, register_instrument
from identification.instruments.distance import Distance, distance_to_center
from identification.kinematics.frames import pose
from identification.kinematics.parameters import JOINT_OFFSET


@register_instrument
@dataclass(frozen=True)
class PlanarDistance(AtTargets):
    """A ball bar or a draw wire beside a planar arm: how far the tip is from a fixed center in the plane.

    The frame is that of the base, and the centers, one for each session, are parameters in it. A turn of arm and
    centers together no distance shows: the offset of joint 1 is not estimated.
    """

    kind = "distance"
    axes = "xy"
    keys = frozenset({"center_mm"})
    coordinates = Distance.coordinates
    own_targets = "center"

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        centers = [values[2 * k : 2 * k + 2] for k in range(len(self.at))] or [ca.SX.zeros(2)]
        return distance_to_center(point - self.of_row(centers[: len(self.at)], target, centers[0]))

    def own_values(self, values: Mapping[str, float]) -> Iterator[OwnValue]:
        for value in super().own_values(values):
            name = f"center {value.name.removeprefix('center[').replace(']', '').replace('.', ' ')}"
            yield value._replace(name=name, convention="of the distances, in the frame of the base")

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset({f"{JOINT_OFFSET}:1"})

    def place(self, rows: Unplaced) -> Placement:
        """The center alone is to be found, and is the origin of the base that is found."""
        return Distance().place(rows._replace(base=None, tool=np.zeros(3)))

    def target_of(self, points: Array, readings: Array) -> Array:
        """The center that explains the distances best."""
        frames = np.array([pose((*point, 0.0)) for point in points])
        return -self.place(Unplaced(frames, readings, float(np.abs(points).max()))).base[:2, 3]

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> PlanarDistance:
        center = table.get("center_mm")
        return cls() if center is None else cls((("1", tuple(map(float, center))),))
