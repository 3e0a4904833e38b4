"""Where the arm stands and where its tool is, from nothing: the start of a fit that needs no guess.

    y_i = B (p_i + R_i t) + b,    B, b: pose of the base for the instrument;  t: measured point in the tip's frame

For a given t the best base is a rigid registration of two clouds of points (Kabsch 1976, Arun 1987), for a given base
the best t a mean; taken in turns the sum of squares falls to a minimum. The starts of t lie around the tip.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.kinematics.frames import pose

ROUNDS = 200  # effort: of each start
ENOUGH = 1e-6  # relative fall of the sum of squares in a round, below which a least-squares fit goes on from here


class Placement(NamedTuple):
    """base : (4, 4) pose of the base [mm];  tool : (3,) place of the measured point [mm];  rms : distance left [mm]."""

    base: Array
    tool: Array
    rms: float


def registered(points: Array, measured: Array) -> Array:
    """(4, 4) pose that brings points (m, 3) closest to the measured ones (m, 3) in least squares."""
    center, target = points.mean(axis=0), measured.mean(axis=0)
    left, _, right = np.linalg.svd((measured - target).T @ (points - center))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = left @ mirror @ right
    return pose(target - rotation @ center, rotation)


def placed(frames: Array, measured: Array, reach: float) -> Placement:
    """Base and tool that explain measured points (m, 3) best.

    frames : (m, 4, 4) nominal poses of the tip in the base;  reach : [mm] that gives the starts of the tool their size
    """
    starts = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]) * 0.1 * reach
    return min((_alternated(frames, measured, start) for start in starts), key=lambda found: found.rms)


def placed_tool(frames: Array, measured: Array, base: Array) -> Array:
    """(3,) the measured point in the frame of the tip that explains measured points (m, 3) best.

    frames : (m, 4, 4) nominal poses of the tip in the base;  base : (4, 4) its pose [mm]
    """
    local = (measured - base[:3, 3]) @ base[:3, :3]  # in the base's frame
    return np.asarray(np.einsum("mji,mj->i", frames[:, :3, :3], local - frames[:, :3, 3]) / len(frames))


def _alternated(frames: Array, measured: Array, tool: Array) -> Placement:
    turns, origins = frames[:, :3, :3], frames[:, :3, 3]
    before = np.inf
    for _ in range(ROUNDS):
        base = registered(origins + turns @ tool, measured)
        tool = placed_tool(frames, measured, base)
        left = measured - (origins + turns @ tool) @ base[:3, :3].T - base[:3, 3]
        squares = float(np.mean(np.sum(left**2, axis=1)))
        if squares > before * (1.0 - ENOUGH):
            break
        before = squares
    return Placement(base, tool, float(np.sqrt(squares)))
