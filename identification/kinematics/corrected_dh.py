"""The Denavit-Hartenberg table of a corrected chain: four numbers between the axes of successive joints.

Between axes that the drawing has parallel the common normal stands anywhere, and the strict table explodes. There d
stays as drawn, the next origin is where the next axis meets the plane of that d, and a turn beta about the new y axis
follows alpha (S. A. Hayati, "Robot arm geometric link parameter estimation", CDC 1983):

    Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)

What is before the first axis is the base, what is behind the last axis the tip: there the table stays as drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.denavit_hartenberg import STANDARD, DHRow, X, Z
from identification.kinematics.frames import pose, rotation_about
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import SpatialChain

PARALLEL = 1e-6  # sine of the angle of axes that a drawing has parallel
Y = np.eye(3)[1]


@dataclass(frozen=True)
class Link:
    """From the axis of a joint to the next: theta, alpha, beta [rad], d, a [mm]; beta None: axes are not parallel."""

    theta: float
    d: float
    a: float
    alpha: float
    beta: float | None = None

    @property
    def matrix(self) -> Array:
        """(4, 4) Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
        turn, tilt = rotation_about(Z, self.theta), rotation_about(X, self.alpha) @ rotation_about(Y, self.beta or 0.0)
        return np.asarray(pose(rotation=turn) @ pose((self.a, 0.0, self.d), tilt))


@dataclass(frozen=True)
class CorrectedLinks:
    """The n - 1 links between n axes.

    first : (4, 4) pose of the first axis's frame in that of the base;  last : of the tip's in that of the last axis
    """

    links: tuple[Link, ...]
    first: Array
    last: Array


def drawn_links(rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[Link, ...]:
    """The links between the axes of a table.

    Raises `InputError` for prismatic joints, whose axes have no place, and for successive axes that are one.
    """
    if any(row.type != REVOLUTE for row in rows):
        raise InputError("dh: found prismatic joints, allowed: a table of revolute joints")
    behind = rows[:-1] if convention == STANDARD else rows[1:]  # whose a and alpha lead to the next axis
    links = tuple(
        Link(row.offset, row.d, after.a, after.alpha, 0.0 if abs(np.sin(after.alpha)) < PARALLEL else None)
        for row, after in zip(rows, behind, strict=False)
    )
    if any(link.beta is not None and link.a == 0.0 for link in links):
        raise InputError("dh: found successive joints with one axis, allowed: different axes")
    return links


def corrected_links(chain: SpatialChain, drawn: Sequence[Link]) -> CorrectedLinks:
    """The links of a chain of revolute joints about their z axes (as `corrected`), nearest to those drawn."""
    at, places = np.eye(4), []
    for joint in chain.joints:
        at = at @ joint.origin
        places.append(at)
    frame, links = places[0], []
    for k, link in enumerate(drawn):
        next_place = places[k + 1]
        between = _parallel(frame, next_place, link) if link.beta is not None else _skew(frame, next_place, link)
        if k == 0:  # where the first frame stands on its axis is free: theta and d as drawn
            frame = frame @ pose((0.0, 0.0, between.d - link.d), rotation_about(Z, between.theta - link.theta))
            between = Link(link.theta, link.d, between.a, between.alpha, between.beta)
            first = frame
        frame = frame @ between.matrix
        links.append(between)
    return CorrectedLinks(tuple(links), first if links else places[0], np.linalg.inv(frame) @ at @ chain.end)


def _skew(frame: Array, following: Array, drawn: Link) -> Link:
    """By the common normal of two axes, the z axes of both frames (4, 4)."""
    z, w, between = frame[:3, 2], following[:3, 2], following[:3, 3] - frame[:3, 3]
    normal = np.cross(z, w)
    normal = normal / np.linalg.norm(normal)
    wanted = frame[:3, :3] @ rotation_about(Z, drawn.theta) @ X
    normal = normal if normal @ wanted >= 0.0 else -normal
    alpha = float(np.arctan2(np.cross(z, w) @ normal, z @ w))
    d = float(np.cross(between, w) @ normal / np.sin(alpha))
    return Link(_angle(frame, normal, drawn.theta), d, float(between @ normal), _near(alpha, drawn.alpha))


def _parallel(frame: Array, following: Array, drawn: Link) -> Link:
    """By the point in which the second axis meets the plane of d as drawn."""
    z, w, start = frame[:3, 2], following[:3, 2], frame[:3, 3] + drawn.d * frame[:3, 2]
    point = following[:3, 3] + w * float((start - following[:3, 3]) @ z) / float(w @ z)
    away = point - start
    wanted = frame[:3, :3] @ rotation_about(Z, drawn.theta) @ X
    normal = away / np.linalg.norm(away)
    normal = normal if normal @ wanted >= 0.0 else -normal
    alpha = float(np.arctan2(-np.cross(z, normal) @ w, z @ w))
    beta = float(np.arcsin(np.clip(normal @ w, -1.0, 1.0)))
    return Link(_angle(frame, normal, drawn.theta), drawn.d, float(away @ normal), _near(alpha, drawn.alpha), beta)


def _angle(frame: Array, normal: Array, drawn: float) -> float:
    """Of a normal about the frame's z axis, nearest to that drawn [rad]."""
    x, y, _ = frame[:3, :3].T @ normal
    return _near(float(np.arctan2(y, x)), drawn)


def _near(angle: float, drawn: float) -> float:
    return angle - 2.0 * np.pi * round((angle - drawn) / (2.0 * np.pi))
