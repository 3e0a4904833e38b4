"""Cleaning up solver weights: nonnegative, summing to one, smallest support."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.errors import InputError

CLEAR = 1e-8  # smallest eigenvalue of scalar products of unit vectors that are independent without a closer look


@dataclass(frozen=True)
class Weights:
    """Weights (k,) on k postures, gradient (p, p) G there, gap max_i g_i - tr(G M) on these postures."""

    weights: Array
    gradient: Array
    gap: float
    iterations: int


def proper_weights(weights: Array) -> Array:
    """A solver's weights made into a design: negative ones (rounding) to zero, sum to one.

    Raises InputError where nothing positive is left.
    """
    clipped = np.maximum(np.asarray(weights, dtype=float), 0.0)
    total = float(clipped.sum())
    if not np.isfinite(total) or total <= 0.0:
        raise InputError(f"weights: their sum is {total}, allowed: finite weights >= 0 that sum to one")
    return clipped / total


def sparsest(jacobians: Array, weights: Array) -> Array:
    """Weights (k,) of the same information matrix on at most p (p + 1) / 2 + 1 postures (Caratheodory).

    Along a combination c with sum c_i F_i = 0 and sum c_i = 0 the information does not change: follow it until a
    weight is zero, and again.
    """
    from scipy.linalg import null_space  # 0.1 s to import

    p = jacobians.shape[2]
    upper = np.triu_indices(p)
    support = np.flatnonzero(weights > 0.0)
    carried = jacobians[support]
    if clearly_independent(carried):
        return weights / weights.sum()
    posture_information = (np.swapaxes(carried, 1, 2) @ carried)[:, upper[0], upper[1]]
    w, alive = weights[support].copy(), np.ones(len(support), dtype=bool)
    nothing = null_space(
        np.vstack([posture_information.T / np.abs(posture_information).max(), np.ones(len(support))]), rcond=1e-12
    )
    while nothing.shape[1]:
        direction = nothing[:, 0] if nothing[:, 0].min() < 0.0 else -nothing[:, 0]
        falling = np.flatnonzero(alive & (direction < 0.0))
        reach = -w[falling] / direction[falling]
        gone = falling[int(np.argmin(reach))]
        w = np.maximum(w + reach.min() * direction, 0.0)
        w[gone], alive[gone] = 0.0, False
        pivot = int(np.argmax(np.abs(nothing[gone])))  # combinations that leave the posture gone untouched
        others = np.delete(nothing, pivot, axis=1)
        nothing = others - np.outer(nothing[:, pivot], others[gone] / nothing[gone, pivot])
        nothing[~alive] = 0.0
    sparse = np.zeros_like(weights)
    sparse[support] = w / w.sum()
    return sparse


def clearly_independent(jacobians: Array) -> bool:
    """True where the F_i = B_i^T B_i of (k, d, p) are clearly independent: no combination of them is zero.

    Their scalar products are tr(F_i F_j) = |B_i B_j^T|^2 (Frobenius): a matrix of k, not of p (p + 1) / 2 rows, which
    holds half the digits; what is not clear by far is left to the singular values.
    """
    k, d, p = jacobians.shape
    rows = jacobians.reshape(k * d, p)
    products = np.square(rows @ rows.T).reshape(k, d, k, d).sum(axis=(1, 3))
    lengths = np.sqrt(np.diag(products))
    if not np.all(lengths > 0.0):
        return False
    return bool(np.linalg.eigvalsh(products / lengths / lengths[:, None])[0] > CLEAR)
