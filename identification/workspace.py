"""Where an arm may move: constraints on its postures as plain data, in millimetres and radians, and what they ask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from identification.arrays import Array


@dataclass(frozen=True)
class WorkspaceBox:
    """The tip stays inside `x`, `y` and, in space, `z` [mm]."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float] | None = None


@dataclass(frozen=True)
class KeepOutCircle:
    """Every link stays outside the circle, in space the sphere [mm]."""

    center: tuple[float, ...]
    radius: float


@dataclass(frozen=True)
class KeepOutCylinder:
    """Every link stays outside a cylinder with flat ends [mm]."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class LineOfSight:
    """The tracker sees the tip: inside its cone, nothing of the arm between; in space in its range and from in front.

    reach : smallest and largest distance [mm];  facing : direction of the reflector in the frame of the tip
    acceptance : [rad] largest angle between that direction and the one to the tracker
    """

    tracker: tuple[float, ...]  # [mm]
    half_angle: float  # [rad]
    toward: tuple[float, ...]  # [mm] a point on the cone's axis
    reach: tuple[float, float] | None = None
    facing: tuple[float, float, float] | None = None
    acceptance: float = float(np.pi / 2.0)


@dataclass(frozen=True)
class ColumnLimits:
    """A controller's limits of a joint that it counts together with others (`Counting`): of a sum of joint angles.

    joint : from 1;  coefficients : (n) of the joints in the sum;  lower, upper : of the sum [rad, mm]
    """

    joint: int
    coefficients: tuple[float, ...]
    lower: float
    upper: float


WorkspaceConstraint = ColumnLimits | WorkspaceBox | KeepOutCircle | KeepOutCylinder | LineOfSight


class PostureCondition(Protocol):
    """What a posture must satisfy besides the joint limits, as computed by `doe.problem.constraints`."""

    @property
    def kind(self) -> str:
        """Name in messages, as in the arm file."""
        ...

    def margin(self, postures: Array) -> Array:
        """(m, k) margins [mm] of postures (m, n), satisfied where >= 0."""
        ...


def distance_to_segment(point: Array, start: Array, end: Array) -> Array:
    """(...) distance of points (..., d) from segments."""
    return np.asarray(np.linalg.norm(nearest_on_segment(point, start, end) - point, axis=-1))


def nearest_on_segment(point: Array, start: Array, end: Array) -> Array:
    """(..., d) the points of segments that are nearest to points (..., d)."""
    along = end - start
    square = np.maximum(np.sum(along**2, axis=-1), 1e-300)
    fraction = np.clip(np.sum((point - start) * along, axis=-1) / square, 0.0, 1.0)
    return np.asarray(start + fraction[..., None] * along)


def circle_across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to an axis and to each other."""
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    one = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    one /= np.linalg.norm(one)
    return one, np.cross(unit, one)
