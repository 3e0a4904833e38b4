"""Distances from a center: |p_i + R_i t - c| = d_i, a sphere about c, which for a given t is linear in c and |c|^2.

Beside a planar arm the center stands in the frame of the base.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.information import RANK_TOLERANCE
from identification.instruments.base import AtTargets, Coordinate, Instrument, Placement, Unplaced, register_instrument
from identification.kinematics.frames import pose
from identification.kinematics.parameters import JOINT_OFFSET, error_names


def distance_to_center(point: ca.SX) -> ca.SX:
    """[mm] of a point (3,) from the origin."""
    return ca.sqrt(ca.sumsqr(point) + 1e-9**2)  # a point this near [mm] has no direction from there


@register_instrument
@dataclass(frozen=True)
class Distance(Instrument):
    """Its frame has the origin at the center; how that frame is turned no distance shows.

    radius : [mm] at which a length counts from zero, 0: it counts from the center
    """

    kind = "distance"
    keys = frozenset({"center_mm"})
    coordinates: ClassVar[tuple[Coordinate, ...]] = (Coordinate("distance", positive=True),)
    offers = frozenset({"distance"})

    radius: float = 0.0

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return distance_to_center(point) - self.radius

    def hidden(self, base: Array) -> frozenset[str]:
        return frozenset(error_names("base")[3:])

    def place(self, rows: Unplaced) -> Placement:
        """From algebraic fits of lengths d, |a|^2 - d^2 = 2 a . c - (|c|^2), about the mean of the points; of points in
        a plane |c|^2 alone says how far off it the center is, on one side or the other. What the lengths leave open of
        the base is along the arm's own axes."""
        points, bases = rows.points, np.tile(np.eye(4), (len(rows.tools), 1, 1))
        middle = points.mean(axis=1, keepdims=True)
        around = (points - middle) / rows.reach
        columns = np.concatenate([2.0 * around, np.ones((*around.shape[:2], 1))], axis=2)
        goals = np.sum(around**2, axis=2) - ((rows.readings[:, 0] + self.radius) / rows.reach) ** 2
        solved = (np.linalg.pinv(columns, rcond=RANK_TOLERANCE) @ goals[..., None])[..., 0]
        normals = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)[1][..., 0]  # of the least scatter
        off = np.sqrt((-solved[:, 3] - np.sum(solved[:, :3] ** 2, axis=1)).clip(min=0.0))
        bases[:, :3, 3] = -middle[:, 0] - rows.reach * (solved[:, :3] + normals * off[:, None])
        return self.searched(rows, bases)


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
    meaning = "of the distances, in the frame of the base"

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        centers = [values[2 * k : 2 * k + 2] for k in range(len(self.at))] or [ca.SX.zeros(2)]
        return distance_to_center(point - self.of_row(centers[: len(self.at)], target, centers[0]))

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
    def of_table(cls, table: Mapping[str, Any]) -> Self:
        center = table.get("center_mm")
        return cls() if center is None else cls((("1", tuple(map(float, center))),))
