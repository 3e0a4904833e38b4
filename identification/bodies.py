"""What an arm and its cell take up in space: bodies as plain data, in millimetres.

A body is made of convex pieces that together contain its surface, so that a clearance of the pieces is one of the
body: capsules (all points within a radius of a segment; a segment of no length is a sphere), and boxes where the body
does not move, the foot of an arm apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError
from identification.kinematics.frames import rotation_to_z

CLEARANCE = 20.0  # [mm] usual smallest distance of two bodies: what cables, covers and a calibration of old are off by


def revolved(radii: Array, heights: Array, sides: int = 32) -> Array:
    """(t, 3, 3) faces of what (k,) radii at heights (k,), from the top down, draw around z."""
    turn = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides + 1)], axis=1)
    grid = radii[:, None, None] * ring + heights[:, None, None] * np.array([0.0, 0.0, 1.0])
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack(each, axis=-2).reshape(-1, 3, 3) for each in ((a, b, c), (a, c, d))])


def brick(half: Array) -> Array:
    """(12, 3, 3) faces of a box around the origin of half sizes (3,)."""
    faces = []
    for normal in np.concatenate([np.eye(3), -np.eye(3)]):
        across = np.roll(normal, 1)
        over = np.cross(normal, across)
        a, b, c, d = (normal + u * across + v * over for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
        faces += [[a, b, c], [a, c, d]]
    return np.array(faces) * half


def cut(triangles: Array, longest: float) -> Array:
    """The surface of triangles (t, 3, 3) in faces (f, 3, 3) without a longer edge: halved in the middle of the longest
    one, again and again."""
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
        faces, polar = [np.empty((0, 3, 3))], np.linspace(0.0, np.pi, 14)
        for start, end, radius in zip(self.capsules[:, :3], self.capsules[:, 3:6], self.capsules[:, 6], strict=True):
            half = 0.5 * np.linalg.norm(end - start)
            turn = rotation_to_z((end - start) / (2.0 * half)) if half > 1e-9 else np.eye(3)
            heights = radius * np.cos(polar) + np.where(polar < 0.5 * np.pi, half, -half)
            faces.append(revolved(radius * np.sin(polar), heights) @ turn.T + 0.5 * (start + end))
        faces += [brick(box[12:]) @ box[3:12].reshape(3, 3).T + box[:3] for box in self.boxes]
        return np.concatenate(faces)


@dataclass(frozen=True, eq=False)
class Cell(ByValue):
    """The bodies of an arm and around it, and how far they keep apart.

    bodies : of the arm and of the cell; those of a file are read and covered when they are first asked for
    floor : [mm] height in the frame of the arm's base below which nothing may reach; None: there is no floor
    clearance : [mm] smallest distance of two bodies, and of the arm from the floor
    apart : pairs of names that are not looked at: links that a joint connects, and what an SRDF file says
    """

    bodies: Sequence[Body] = ()
    floor: float | None = None
    clearance: float = CLEARANCE
    apart: frozenset[frozenset[str]] = frozenset()
