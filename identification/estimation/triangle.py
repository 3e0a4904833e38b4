"""Tall least-squares problems made small by QR: the triangular factor has all that a step needs.

Orthogonal transformations change neither sums of squares nor products of columns, and least squares see nothing else
(A. Bjorck, "Numerical Methods for Least Squares Problems", 1996, section 2.4).
"""

from __future__ import annotations

import numpy as np

from identification.arrays import Array

TALL = 20  # rows per column from which the triangle pays: a step passes over the rows some ten times
BLOCK = 2048  # rows at a time, which stay in the processor's cache


def triangle(rows: Array) -> Array:
    """(k, q, q) upper triangles R with R^T R = A^T A of tables (k, N, q), N >= q."""
    found = []
    for table in rows:
        parts = [np.linalg.qr(table[start : start + BLOCK], mode="r") for start in range(0, len(table), BLOCK)]
        found.append(parts[0] if len(parts) == 1 else np.linalg.qr(np.concatenate(parts), mode="r"))
    return np.array(found)


def compressed(residuals: Array, jacobians: Array) -> tuple[Array, Array]:
    """Residuals (k, q) and Jacobians (k, q, p), q = p + 1, of the same least-squares problems as tall (k, N) and
    (k, N, p); those that are not tall as they are."""
    if jacobians.shape[1] < TALL * (jacobians.shape[2] + 1):
        return residuals, jacobians
    found = triangle(np.concatenate([jacobians, residuals[:, :, None]], axis=2))
    return found[:, :, -1], found[:, :, :-1]
