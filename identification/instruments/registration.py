"""Where the arm stands and where its tool is, from nothing: the start of a fit that needs no guess.

    y_i = B (p_i + R_i t) + b,    B, b: pose of the base for the instrument;  t: measured point in the tip's frame

For a given t the best base is a rigid registration of two clouds of points (Kabsch 1976, Arun 1987), for a given base
the best t a mean; taken in turns the sum of squares falls to a minimum. The starts of t lie around the tip.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.instruments.search import ENOUGH, Placement, starts_of_tool


def registered(points: Array, measured: Array) -> Array:
    """(4, 4) pose that brings points (m, 3) closest to the measured ones (m, d) in least squares; in the plane, d = 2,
    it is a turn about z."""
    d = measured.shape[1]
    center, target = points[:, :d].mean(axis=0), measured.mean(axis=0)
    left, _, right = np.linalg.svd((measured - target).T @ (points[:, :d] - center))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))  # no mirror
    frame = np.eye(4)
    frame[:d, :d] = left @ right
    frame[:d, 3] = target - frame[:d, :d] @ center
    return frame


def placed(frames: Array, measured: Array, reach: float) -> Placement:
    """Base and tool that explain measured points (m, 3) best.

    frames : (m, 4, 4) nominal poses of the tip in the base;  reach : [mm] that gives the starts of the tool their size
    """
    moments, tools = _Moments.of(frames, measured), starts_of_tool(reach)
    before = np.full(len(tools), np.inf)
    for _ in range(200):  # effort: steps of each start
        rotations = moments.rotations(tools)
        tools = moments.tools(rotations)
        squares = moments.squares(rotations, tools)
        if np.all(squares > before * (1.0 - ENOUGH)):
            break
        before = squares
    best = int(np.argmin(squares))
    tool = tools[best]
    base = registered(frames[:, :3, 3] + frames[:, :3, :3] @ tool, measured)
    left = measured - (frames[:, :3, 3] + frames[:, :3, :3] @ tool) @ base[:3, :3].T - base[:3, 3]
    return Placement(base, tool, float(np.sqrt(np.mean(np.sum(left**2, axis=1)))))


class _Moments(NamedTuple):
    """Means over the rows that the sum of squares needs, so that a round costs the same for any number of them.

    With positions p and rotations R of the tip and measured points y, each less its mean: of y p^T (3, 3), of y_k R
    (3, 3, 3), of R^T p (3,), of R^T R (3, 3) and the inverse of that without what is still, of |p|^2 + |y|^2.
    """

    points: Array
    turns: Array
    along: Array
    gram: Array
    inverse: Array
    squared: float

    @classmethod
    def of(cls, frames: Array, measured: Array) -> _Moments:
        """Of poses (m, 4, 4) and measured points (m, 3)."""
        p, turn, y = (a - a.mean(axis=0) for a in (frames[:, :3, 3], frames[:, :3, :3], measured))
        m = len(p)
        points, turns = y.T @ p / m, np.einsum("mk,mij->kij", y, turn) / m
        along, gram = np.einsum("mji,mj->i", turn, p) / m, np.einsum("mji,mjk->ik", turn, turn) / m
        values, axes = np.linalg.eigh(gram)
        # what moves a point 1 mm from the flange's center by less than 0.01 mm (RMS) is lost in a drawing's errors
        inverse = (axes * np.divide(1.0, values, out=np.zeros(3), where=values > 0.01**2)) @ axes.T
        return cls(points, turns, along, gram, inverse, float(np.sum(p**2 + y**2)) / m)

    def rotations(self, tools: Array) -> Array:
        """(s, 3, 3) best rotations of the base for tools (s, 3) (Kabsch)."""
        left, _, right = np.linalg.svd(self.points + np.einsum("kij,sj->ski", self.turns, tools))
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]  # no mirror
        return np.asarray(left @ right)

    def tools(self, rotations: Array) -> Array:
        """(s, 3) best tools for rotations (s, 3, 3) of the base."""
        target = np.einsum("ski,kij->sj", rotations, self.turns) - self.along
        return np.asarray(target @ self.inverse)

    def squares(self, rotations: Array, tools: Array) -> Array:
        """(s,) mean squared distances left [mm^2]."""
        crossed = np.einsum("ski,ki->s", rotations, self.points)
        crossed += np.einsum("ski,kij,sj->s", rotations, self.turns, tools)
        of_tools = 2.0 * tools @ self.along + np.einsum("si,ij,sj->s", tools, self.gram, tools)
        return np.asarray(self.squared + of_tools - 2.0 * crossed)
