"""Newton's method from many starts at once: local maxima of a function of joint positions within the joint limits.

Directions are those of the absolute eigenvalues of the Hessian, which lead away from saddles; joints at a limit that
would leave the box stay there. Each start has a reach of its own, which grows with success and shrinks with failure.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

STEPS = 60
LONGEST = 0.7  # [rad] of a Newton step
Rows = NDArray[np.intp]


def newton_ascent(
    starts: Array,
    height: Callable[[Array, Rows], Array],
    slopes: Callable[[Array, Rows], tuple[Array, Array]],
    limits: tuple[Array, Array],
    units: Array,
    enough: Array | float = 0.0,
    stop: Callable[[], bool] | None = None,
) -> Array:
    """(m, n) postures reached from starts (m, n), none lower than its start.

    height : postures (k, n) of the starts numbered (k,) -> (k,) values, -inf where none may be
    slopes : the same -> (k, n) gradients and (k, n, n) Hessians
    limits : (n,) lower and (n,) upper;  units : (n,) what counts as one radian of each joint
    enough : (m,) gain of a step that ends an ascent;  stop : asked before every step
    """
    lower, upper = limits
    edge = 1e-12 * (upper - lower)
    q, values = starts.copy(), height(starts, np.arange(len(starts)))
    reach, enough = np.full(len(q), LONGEST), np.broadcast_to(enough, len(q))
    moving = np.flatnonzero(np.isfinite(values))
    for _ in range(STEPS):
        if not len(moving) or (stop is not None and stop()):
            break
        slope, hessian = slopes(q[moving], moving)
        # of the absolute eigenvalues; joints at a limit that would leave the box are held
        at, slope, hessian = q[moving], slope * units, hessian * units[:, None] * units
        held = ((at >= upper - edge) & (slope > 0)) | ((at <= lower + edge) & (slope < 0))
        free = (~held).astype(float)
        hessian = hessian * free[:, :, None] * free[:, None, :] + np.eye(len(units)) * held[:, :, None]
        eigenvalues, vectors = np.linalg.eigh(hessian)
        floor = 1e-6 * np.abs(eigenvalues).max(axis=1, keepdims=True) + 1e-12
        along = np.einsum("mij,mi->mj", vectors, slope * free) / np.maximum(np.abs(eigenvalues), floor)
        step = np.einsum("mij,mj->mi", vectors, along) * free
        length = np.abs(step).max(axis=1)
        step *= np.minimum(1.0, reach[moving] / np.maximum(length, 1e-300))[:, None]
        trial = np.clip(q[moving] + step * units, lower, upper)
        heights = height(trial, moving)
        gain = heights - values[moving]
        better = gain > 0.0
        accepted = moving[better]
        q[accepted], values[accepted] = trial[better], heights[better]
        shorter = 0.25 * np.minimum(reach[moving], length)
        reach[moving] = np.where(better, np.minimum(2.0 * reach[moving], LONGEST), shorter)
        arrived = better & (gain <= 1e-14 * np.abs(heights) + enough[moving])
        moving = moving[(reach[moving] > 1e-9) & (length > 1e-10) & ~arrived]
    return q
