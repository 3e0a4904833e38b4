"""The information matrix and what follows from it before any data exist (paper, eq. 16-19, corrected)."""

from __future__ import annotations

import numpy as np

from identification.arm import Array


def information_matrix(jacobian: Array, weights: Array | None = None) -> Array:
    """(..., p, p) sum_i w_i J_i^T J_i of Jacobians (..., m, d, p); weights (m,) default to one."""
    *batch, m, d, p = jacobian.shape
    rows = jacobian if weights is None else jacobian * np.sqrt(np.asarray(weights))[:, None, None]
    rows = rows.reshape(*batch, m * d, p)
    return np.swapaxes(rows, -1, -2) @ rows


def orientation_transform(names: tuple[str, ...]) -> Array:
    """(n, p) matrix T with dtheta = T parameters: dtheta_j = dq_1 + ... + dq_j of the joint offsets that are estimated.

    The paper's sigma_q (eq. 25) is the deviation of dtheta_j, not of the joint offset dq_j.
    """
    offsets = [k for k, name in enumerate(names) if name.startswith("joint_offset:")]
    transform = np.zeros((len(offsets), len(names)))
    for row in range(len(offsets)):
        transform[row, offsets[: row + 1]] = 1.0
    return transform
