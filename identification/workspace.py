"""Where an arm may move, as plain data in millimetres and radians: constraints on its postures, and the bodies of arm
and cell, which must not touch.

A body is made of convex pieces that together contain its surface, so that a clearance of the pieces is one of the
body: capsules (all points within a radius of a segment; a segment of no length is a sphere), and boxes where the body
does not move, the foot of an arm apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError

CLEARANCE = 20.0  # [mm] usual smallest distance of two bodies: what cables, covers and a calibration of old are off by


@dataclass(frozen=True)
class WorkspaceBox:
    """All measured points stay inside `x`, `y` and, in space, `z` [mm]."""

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
class KeepOut:
    """Every link stays outside a circle, in space a sphere, or a cylinder with round ends [mm]: half a ball is on each.

    start : (2,) or (3,) the center, or that of one end;  end : of the other, of a cylinder
    """

    forbidden: ClassVar[bool] = True
    start: tuple[float, ...]
    radius: float
    end: tuple[float, ...] | None = None
    axis = property(lambda self: (self.start, self.end or self.start))

    @property
    def kind(self) -> str:
        """The word in arm files."""
        return f"keep_out_{'cylinder' if self.end else 'sphere' if len(self.start) == len('xyz') else 'circle'}"

    def outlines(self, dimension: int) -> list[Array]:
        """The circle (k, 2), three of a sphere (k, 3), or both ends of a cylinder, and lines between them."""
        start, end = np.array(self.axis)
        if self.end is None:
            axes = np.eye(3) if dimension == len("xyz") else np.eye(3)[2:]
            return [start + self.radius * ring(axis)[:, :dimension] for axis in axes]
        around = self.radius * ring(end - start)
        lines = zip(start + around[::12], end + around[::12], strict=True)
        return [start + around, end + around, *map(np.array, lines)]


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
        end = tracker + (1.2 * far if self.reach is None else self.reach[1]) * (cos * unit + sin * ring(axis))
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


WorkspaceConstraint = ColumnLimits | WorkspaceBox | KeepOut | LineOfSight


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


Z = np.array([0.0, 0.0, 1.0])
CUBE = np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(-1, 3)  # its corners
BALL = np.concatenate([np.sin(up) * ring(Z) + np.cos(up) * Z for up in np.linspace(0.0, np.pi, 14)])


# -- bodies ------------------------------------------------------------------------------------------------------------
def hull(points: Array) -> Array:
    """(t, 3, 3) faces around points (m, 3) that are not in one plane, counterclockwise from outside."""
    from scipy.spatial import ConvexHull

    faces = points[ConvexHull(points).simplices]
    inward = np.linalg.det(faces - points.mean(axis=0)) < 0.0
    faces[inward] = faces[inward, ::-1]
    return np.asarray(faces)


def rounded(capsule: Array) -> Array:
    """(t, 3, 3) faces of a capsule (7,), as `hull` has them."""
    return hull(np.concatenate([capsule[:3] + capsule[6] * BALL, capsule[3:6] + capsule[6] * BALL]))


def cut(triangles: Array, longest: float) -> Array:
    """Triangles (t, 3, 3) as faces (f, 3, 3) without a longer edge: halved across the longest one, again and again."""
    done = [np.empty((0, 3, 3))]
    while len(triangles):
        edges = triangles - triangles[:, [1, 2, 0]]
        lengths = np.einsum("tij,tij->ti", edges, edges)
        large = lengths.max(axis=1) > longest**2
        done.append(triangles[~large])
        triangles, first = triangles[large], lengths[large].argmax(axis=1)
        a, b, c = (triangles[np.arange(len(first)), (first + k) % 3] for k in range(3))
        middle = 0.5 * (a + b)
        triangles = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    return np.concatenate(done)


@dataclass(frozen=True, eq=False)
class Body(ByValue):
    """A rigid part of the arm, of what it carries, or of the cell around it.

    name : as messages have it: a link of the URDF, or the name in the arm file
    joint : it moves with, from 1; 0: it stands still with the arm's base
    capsules : (k, 7) the two ends of each axis [mm] and the radius [mm], in the frame of the joint after it moved, of
        joint 0 in that of the arm's base
    boxes : (k, 15) center (3), rows of the rotation matrix (9) and half sizes (3) of each [mm], in the same frame; of
        bodies that stand still only
    triangles : (t, 3, 3) corners [mm] of what it looks like, in the same frame; none: its pieces are drawn
    """

    name: str
    joint: int = 0
    capsules: Array = field(default_factory=lambda: np.empty((0, 7)))
    boxes: Array = field(default_factory=lambda: np.empty((0, 15)))
    triangles: Array = field(default_factory=lambda: np.empty((0, 3, 3)))

    def __post_init__(self) -> None:
        for name, shape in (("capsules", (-1, 7)), ("boxes", (-1, 15)), ("triangles", (-1, 3, 3))):
            object.__setattr__(self, name, readonly(getattr(self, name), *shape))
        if self.joint and len(self.boxes):
            raise InputError(f"body {self.name}: boxes move with joint {self.joint}, allowed: capsules that cover them")

    def looks(self) -> Array:
        """(t, 3, 3) what it looks like: its own triangles, or else those of its pieces."""
        if len(self.triangles):
            return self.triangles
        bricks = (box[:3] + (CUBE * box[12:]) @ box[3:12].reshape(3, 3).T for box in self.boxes)
        return np.concatenate([self.triangles, *map(rounded, self.capsules), *map(hull, bricks)])


@dataclass(frozen=True, eq=False)
class Cell(ByValue):
    """The bodies of an arm and around it, and how far they keep apart.

    bodies : of the arm and of the cell; those of a file are read and covered when they are first asked for
    floor : [mm] height in the frame of the arm's base below which nothing may reach; None: there is no floor
    clearance : [mm] smallest distance of two bodies, and of the arm from the floor
    apart : pairs of names that are not looked at: links that a joint connects, and what an SRDF file says
    """

    FLOOR: ClassVar[str] = "floor"
    SIGHT: ClassVar[str] = "line of sight"  # of the tracker; names beside those of bodies
    bodies: Sequence[Body] = ()
    floor: float | None = None
    clearance: float = CLEARANCE
    apart: frozenset[frozenset[str]] = frozenset()
