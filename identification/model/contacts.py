"""Postures at which something is touched: others are led there by the shortest steps of Newton's method."""

from __future__ import annotations

import numpy as np

from identification.arrays import Array
from identification.conditions import Conditions
from identification.model.arm_model import Model


def led_to_contact(
    model: Model, postures: Array, goals: Array | float, units: Array, target: Array | None = None
) -> Array:
    """Postures (m, n) led to where the instrument reads the goals (m, d), most of them; limits apart.

    units : (n,) what counts as a radian of each joint [rad, mm];  target : (m,) number of what each touches, of several
        that have one; None: the nearest
    """
    q = np.array(postures)
    # effort: Newton's method doubles the digits once it is near
    for _ in range(30):
        conditions = model.condition_table(q, Conditions(marker=target))
        reading, slopes = model.posture_jacobian(q, conditions, model.values[None])
        slopes = slopes * units
        across = slopes @ np.swapaxes(slopes, 1, 2)
        sizes = np.einsum("mdd->m", across)[:, None, None]
        # slopes below this share of the largest go nowhere
        across = across + (1e-12 * sizes + 1e-300) * np.eye(across.shape[-1])
        gaps = goals - reading[..., 0]
        steps = (np.swapaxes(slopes, 1, 2) @ np.linalg.solve(across, gaps[..., None]))[..., 0]
        # at most 0.5 rad at a time, of a prismatic joint that share of its range / (2 pi)
        q = q + steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True) / 0.5, 1.0) * units
    return q
