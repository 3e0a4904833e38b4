"""Where an arm may move: constraints on its postures as plain data, in millimetres and radians, and what they ask."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from identification.arrays import Array


@dataclass(frozen=True)
class WorkspaceBox:
    """The tip stays inside `x`, `y` and, in space, `z` [mm]."""

    kind: ClassVar[str] = "workspace_box"
    forbidden: ClassVar[bool] = False
    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float] | None = None

    def outlines(self, dimension: int) -> list[Array]:
        """The four edges (k, d) in a plane or of a floor without limits of height, or the twelve in space."""
        corners = np.array([(self.x[i], self.y[j]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))])
        if dimension == corners.shape[1]:
            return [corners]
        low, high = self.z or (0.0, 0.0)
        floors = [np.column_stack([corners, np.full(len(corners), height)]) for height in {low, high}]
        return [*floors, *(np.array([(x, y, low), (x, y, high)]) for x, y in corners[:4])]


@dataclass(frozen=True)
class KeepOutCircle:
    """Every link stays outside the circle, in space the sphere [mm]."""

    kind: ClassVar[str] = "keep_out_circle"
    forbidden: ClassVar[bool] = True
    center: tuple[float, ...]
    radius: float
    axis = property(lambda self: (self.center, self.center))

    def outlines(self, dimension: int) -> list[Array]:
        """The circle (k, 2), or three of the sphere (k, 3)."""
        axes = np.eye(3) if dimension == len("xyz") else np.eye(3)[2:]
        return [np.array(self.center) + self.radius * ring(axis)[:, :dimension] for axis in axes]


@dataclass(frozen=True)
class KeepOutCylinder:
    """Every link stays outside a cylinder with round ends [mm]: half a ball is on each."""

    kind: ClassVar[str] = "keep_out_cylinder"
    forbidden: ClassVar[bool] = True
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float
    axis = property(lambda self: (self.start, self.end))

    def outlines(self, dimension: int) -> list[Array]:
        """Both ends (k, 3), and lines between them."""
        ends = np.array([self.start, self.end])
        first, last = (end + self.radius * ring(ends[1] - ends[0]) for end in ends)
        return [first, last, *(np.array(pair) for pair in zip(first[::12], last[::12], strict=True))]


@dataclass(frozen=True)
class LineOfSight:
    """The tracker sees the tip: inside its cone, nothing of the arm between; in space in its range and from in front.

    reach : smallest and largest distance [mm];  facing : direction of the reflector in the frame of the tip
    acceptance : [rad] largest angle between that direction and the one to the tracker
    """

    kind: ClassVar[str] = "line_of_sight"
    forbidden: ClassVar[bool] = False
    tracker: tuple[float, ...]  # [mm]
    half_angle: float  # [rad]
    toward: tuple[float, ...]  # [mm] a point on the cone's axis
    reach: tuple[float, float] | None = None
    facing: tuple[float, float, float] | None = None
    acceptance: float = float(np.pi / 2.0)

    def outlines(self, dimension: int) -> list[Array]:
        """In a plane the two sides of its cone (k, 2), in space its end and four lines to it (k, 3); as far as the
        tracker or the arm reaches."""
        tracker = np.array(self.tracker)
        axis = np.array(self.toward) - tracker
        unit, far = axis / np.linalg.norm(axis), float(np.linalg.norm(axis))
        cos, sin = float(np.cos(self.half_angle)), float(np.sin(self.half_angle))
        if dimension == len("xy"):
            turn = np.array([[cos, -sin], [sin, cos]])
            return [np.stack([tracker + 1.3 * far * (turn.T @ unit), tracker, tracker + 1.3 * far * (turn @ unit)])]
        length = 1.2 * far if self.reach is None else self.reach[1]
        end = tracker + length * (cos * unit + sin * ring(axis))
        return [end, *(np.stack([tracker, place]) for place in end[:-1:12])]


@dataclass(frozen=True)
class ColumnLimits:
    """A controller's limits of a joint that it counts together with others (`Counting`): of a sum of joint angles.

    joint : from 1;  coefficients : (n) of the joints in the sum;  lower, upper : of the sum [rad, mm]
    """

    kind: ClassVar[str] = "joint_limits"
    forbidden: ClassVar[bool] = False
    joint: int
    coefficients: tuple[float, ...]
    lower: float
    upper: float

    def outlines(self, dimension: int) -> list[Array]:
        """None: it is of angles, not of places."""
        return []


WorkspaceConstraint = ColumnLimits | WorkspaceBox | KeepOutCircle | KeepOutCylinder | LineOfSight


class PostureCondition(Protocol):
    """What a posture must satisfy besides the joint limits, as computed by `doe.problem.constraints`.

    kind : name in messages, as in the arm file
    """

    @property
    def kind(self) -> str: ...

    def margin(self, postures: Array) -> Array:
        """(m, k) margins [mm] of postures (m, n), satisfied where >= 0."""
        ...


def circle_across(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors (3,) perpendicular to an axis and to each other."""
    unit = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    one = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit))])
    one /= np.linalg.norm(one)
    return one, np.cross(unit, one)


def ring(axis: Array) -> Array:
    """(49, 3) unit circle around an axis."""
    one, other = circle_across(axis)
    around = np.linspace(0.0, 2.0 * np.pi, 49)[:, None]
    return np.asarray(np.cos(around) * one + np.sin(around) * other)
