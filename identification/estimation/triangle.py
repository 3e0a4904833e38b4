"""Tall least-squares problems made small by QR: the triangular factor has all that a step needs.

Orthogonal transformations change neither sums of squares nor products of columns, and least squares see nothing else
(A. Bjorck, "Numerical Methods for Least Squares Problems", 1996, section 2.4).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

TALL = 20  # rows per column from which the triangle pays: a step passes over the rows some ten times
MANY = 100  # parameters of one problem: singular values then take several times as long as a triangle
BLOCK = 2048  # rows at a time, which stay in the processor's cache


def triangle(blocks: Iterable[Array]) -> Array:
    """(q, q) upper triangle R with R^T R = A^T A of a table (N, q), N >= q, that comes in blocks of rows."""
    parts = [np.linalg.qr(block, mode="r") for block in blocks]
    return np.asarray(parts[0] if len(parts) == 1 else np.linalg.qr(np.concatenate(parts), mode="r"))


def compressed(residuals: Array, jacobians: Array) -> tuple[Array, Array]:
    """Residuals (k, q) and Jacobians (k, q, p), q = p + 1, of the same least-squares problems as tall (k, N) and
    (k, N, p); those that are not tall as they are."""
    rows = jacobians.shape[1]
    if rows < TALL * (jacobians.shape[2] + 1):
        return residuals, jacobians
    parts = [slice(start, start + BLOCK) for start in range(0, rows, BLOCK)]
    tables = [(np.column_stack([j[k], r[k]]) for k in parts) for r, j in zip(residuals, jacobians, strict=True)]
    triangles = np.array([triangle(table) for table in tables])
    return triangles[:, :, -1], triangles[:, :, :-1]


def regular_steps(
    columns: Array, residuals: Array, held: NDArray[np.bool_], damping: Array, tolerance: float
) -> tuple[Array, Array] | None:
    """(1, p) minimiser s of |E s - r|^2 + damping |s|^2 for columns (1, N, p) of one problem of `MANY` parameters, and
    (E^T E + damping)^-1 s, both zero where held; None for others, and where a triangle will not do."""
    if columns.shape[2] < MANY or len(columns) != 1:
        return None
    regular = _regular_step(columns[0][:, ~held[0]], residuals[0], float(damping[0]), tolerance)
    if regular is None:
        return None
    steps, softer = np.zeros((2, *held.shape))
    steps[~held], softer[~held] = regular
    return steps, softer


def _regular_step(columns: Array, residual: Array, damping: float, tolerance: float) -> tuple[Array, Array] | None:
    """(p,) minimiser s of |E s - r|^2 + damping |s|^2 of columns (N, p), and (E^T E + damping)^-1 s. None where a
    singular value may be below `tolerance` times the largest: the norms of triangle and inverse bound their ratio."""
    p = columns.shape[1]
    parts = np.asarray(np.linalg.qr(np.column_stack([columns, residual]), mode="r"))
    if len(parts) < p:
        return None
    try:
        inverse = np.linalg.inv(parts[:p, :p])
        if not np.linalg.norm(parts[:p, :p]) * np.linalg.norm(inverse) < 1.0 / tolerance:
            return None
        if damping > 0.0:
            damping_rows = np.sqrt(damping) * np.eye(p, p + 1)
            parts = np.asarray(np.linalg.qr(np.concatenate([parts[:p], damping_rows]), mode="r"))
            inverse = np.linalg.inv(parts[:p, :p])
    except np.linalg.LinAlgError:
        return None
    step = inverse @ parts[:p, p]
    return step, inverse @ (inverse.T @ step)
