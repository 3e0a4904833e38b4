"""Postures at which an arm of lines in space touches a surface: Newton steps on differences, all postures at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from identification import Array
from tests.identification.exponentials import Exponentials

STEP = 1e-6  # [rad] of central differences


def touching(truth: Exponentials, gap: Callable[[Array], Array], count: int, generator: np.random.Generator) -> Array:
    """(count, 6) postures whose points are on a surface: of random ones those that end within 150 degrees.

    gap : of points (m, 3) in the frame of the base [mm], zero on the surface
    """
    back = np.linalg.inv(truth.base)

    def left(q: Array) -> Array:
        return gap(truth.poses(q)[:, :3, 3] @ back[:3, :3].T + back[:3, 3])

    q = generator.uniform(-2.0, 2.0, (3 * count, 6))
    for _ in range(50):
        slopes = np.stack([(left(q + e) - left(q - e)) / (2.0 * STEP) for e in STEP * np.eye(6)], axis=1)
        steps = slopes * (-left(q) / np.sum(slopes**2, axis=1))[:, None]
        q = q + steps * np.minimum(1.0, 0.3 / np.maximum(np.linalg.norm(steps, axis=1), 1e-12))[:, None]
    good = (np.abs(left(q)) < 1e-8) & (np.abs(q).max(axis=1) < 2.6)
    assert good.sum() >= count
    return q[good][:count]


def sphere(center: Array, radius: float) -> Callable[[Array], Array]:
    """How far points (m, 3) are outside of a sphere [mm]."""
    return lambda points: np.linalg.norm(points - center, axis=1) - radius


def plane(normal: Array, height: float) -> Callable[[Array], Array]:
    """How high points (m, 3) are above a plane [mm]."""
    unit = normal / np.linalg.norm(normal)
    return lambda points: points @ unit - height


def seated(truth: Exponentials, centers: Array, noise: float, generator: np.random.Generator) -> Array:
    """(m, n) postures that bring the measured point to centers (m, 3) in the frame of the base [mm], but for the noise:
    of random ones the first that end within 160 degrees."""
    back = np.linalg.inv(truth.base)
    goals, n = centers + noise * generator.standard_normal(centers.shape), len(truth.lines)

    def left(q: Array, goal: Array) -> Array:
        return goal - truth.poses(q)[:, :3, 3] @ back[:3, :3].T - back[:3, 3]

    found, todo = np.zeros((len(goals), n)), np.arange(len(goals))
    while len(todo):
        q, goal = generator.uniform(-2.2, 2.2, (len(todo), n)), goals[todo]
        for _ in range(40):
            slopes = np.stack(
                [(left(q - e, goal) - left(q + e, goal)) / (2.0 * STEP) for e in STEP * np.eye(n)], axis=2
            )
            across = slopes @ np.swapaxes(slopes, 1, 2) + 1e-6 * np.eye(3)
            steps = np.einsum("mjn,mj->mn", slopes, np.linalg.solve(across, left(q, goal)[..., None])[..., 0])
            q = q + steps * np.minimum(1.0, 0.4 / np.maximum(np.linalg.norm(steps, axis=1), 1e-12))[:, None]
        good = (np.linalg.norm(left(q, goal), axis=1) < 1e-7) & (np.abs(q).max(axis=1) < 2.8)
        found[todo[good]], todo = q[good], todo[~good]
    return found
