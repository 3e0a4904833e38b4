"""A probe on balls and planes: |p_i + R_i t - c| = r, and n . (p_i + R_i t) = h, by total least squares for given t."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, Self

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.errors import require
from identification.instruments.base import Instrument, Placement, Unplaced, register_instrument
from identification.instruments.distance import Distance
from identification.kinematics.frames import from_angles, pose, rotation_about
from identification.kinematics.parameters import AXES, error_names
from identification.workspace import circle_across


@register_instrument
@dataclass(frozen=True)
class Sphere(Distance):
    """A touch probe on a ball, wherever that stands: read is the height above the surface, in a frame with the origin
    at the center of the ball. The radius is that of ball and stylus tip together."""

    kind = "sphere"
    keys = frozenset({"center_mm", "radius_mm"})
    coordinates = ()
    target = "surface"
    offers = frozenset()

    @classmethod
    def of_table(cls, table: Mapping[str, Any]) -> Self:
        require("radius_mm" in table, "instrument.radius_mm: is missing, allowed: of ball and stylus tip together [mm]")
        return cls(table["radius_mm"])


@register_instrument
@dataclass(frozen=True)
class Plane(Instrument):
    """A touch probe on planes: the measured point is on a plane, or always off it by the same.

    The z axis of its frame is the normal of the plane: read is the height above; shifts along the plane and turns about
    its normal no contact shows.
    """

    kind = "plane"
    keys = frozenset({"center_mm", "normal"})
    target = "surface"
    size_is_open = "contacts with planes", "only [machining] tells"

    def reading(self, point: ca.SX, values: ca.SX, target: ca.SX) -> ca.SX:
        return point[2]

    def hidden(self, base: Array) -> frozenset[str]:
        """The turn about that axis of the base that is nearest to the normal stands for the turn about the normal."""
        return frozenset({"base.x", "base.y", error_names("base")[3 + int(np.argmax(np.abs(base[2, :3])))]})

    def between(self, first: Array, base: Array) -> tuple[dict[str, float], frozenset[str]]:
        """A plane does not show how the base is turned about the normal: of such turns that is taken which lets two of
        the three rotations, without that about the axis held, tilt the normal best where they tilt it least."""
        best, choice, steps = -1.0, (dict[str, float](), frozenset[str]()), 1e-5 * np.eye(3)  # [rad]
        for angle, held in product(np.arange(0.0, np.pi, np.pi / 6.0), range(3)):
            movement = super().between(first, pose(rotation=rotation_about([0.0, 0.0, 1.0], angle)) @ base)[0]
            turn = np.array([movement[f"w{axis}"] for axis in AXES])
            ends = [[first[2, :3] @ from_angles(turn + s * steps[k]) for s in (1, -1)] for k in {0, 1, 2} - {held}]
            tilt = float(np.linalg.svd([(up - down) / 2e-5 for up, down in ends], compute_uv=False)[-1])
            if tilt > best:
                best, choice = tilt, (movement, frozenset({"x", "y", f"w{AXES[held]}"}))
        return choice

    def place(self, rows: Unplaced) -> Placement:
        """From bases above the plane: their z axis is its normal, x is near one of the arm's axes, and the origin is in
        the middle of the points."""
        bases = []
        for points in rows.points:
            middle = points.mean(axis=0)
            normal = np.linalg.eigh((points - middle).T @ (points - middle))[1][:, 0]  # of least scatter; of few any
            normal *= -1.0 if normal @ middle > 0.0 else 1.0
            one, other = circle_across(normal)
            axes = np.array([-other, one, normal])
            bases.append(pose(-axes @ middle, axes))
        return self.searched(rows, np.array(bases))
