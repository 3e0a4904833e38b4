"""Criteria made of log-determinants of principal submatrices of M: their common mathematics.

    Phi(M) = sum_t sign_t log det M[rows_t, rows_t]

D is one with every row; D_s subtracts that of the nuisance parameters; the paper's D* adds two.
Each of them has Phi(c M) = Phi(M) + s log c, s = sum_t sign_t |rows_t|; with Phi concave that gives the bound
Phi(N) <= Phi(M) + s log( tr(G N) / s )  (tangent at c M, c chosen best).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

Term = tuple[float, NDArray[np.intp]]  # sign, rows

RIDGE = 1e-9  # a plan that lacks one run may be singular; this share of the mean eigenvalue keeps the ranking right


def principal_submatrix(matrices: Array, rows: NDArray[np.intp]) -> Array:
    """(..., r, r) principal submatrix of (..., p, p)."""
    return matrices[..., rows[:, None], rows]


def value(information: Array, terms: list[Term]) -> Array:
    """(...) Phi(M), -inf where M is singular."""
    sign, _ = np.linalg.slogdet(information)
    total = np.zeros(information.shape[:-2])
    for factor, rows in terms:
        positive, log_det = np.linalg.slogdet(principal_submatrix(information, rows))
        sign = np.minimum(sign, positive)
        total = total + factor * np.where(positive > 0, log_det, 0.0)
    return np.where(sign > 0, total, -np.inf)


def gradient(information: Array, terms: list[Term]) -> Array:
    """(p, p) sum_t sign_t inverse of the submatrix, in its place."""
    total = np.zeros_like(information)
    for factor, rows in terms:
        total[np.ix_(rows, rows)] += factor * np.linalg.inv(principal_submatrix(information, rows))
    return total


def curvature(information: Array, directions: Array, terms: list[Term]) -> Array:
    """(k, k) -sum_t sign_t tr(M_t^-1 X_t M_t^-1 Y_t): Gram matrices of L_t^-1 X_t L_t^-T."""
    total = np.zeros((len(directions), len(directions)))
    for factor, rows in terms:
        root = np.linalg.inv(np.linalg.cholesky(principal_submatrix(information, rows)))
        whitened = (root @ principal_submatrix(directions, rows) @ root.T).reshape(len(directions), -1)
        total -= factor * (whitened @ whitened.T)
    return total


def values_after_adding(information: Array, jacobians: Array, terms: list[Term]) -> Array:
    """(s, c) Phi(A_s + B_sc^T B_sc) - Phi(A_s), by the determinant lemma: log det(I_d + B_t A_t^-1 B_t^T)."""
    s, c, d, _ = jacobians.shape
    total = np.zeros((s, c))
    for factor, rows in terms:
        p = len(rows)
        own = principal_submatrix(information, rows)
        ridge = RIDGE * (1e-3 + np.trace(own, axis1=-2, axis2=-1) / p)  # submatrices are about one
        root = np.linalg.inv(np.linalg.cholesky(own + ridge[:, None, None] * np.eye(p)))
        parts = jacobians if p == jacobians.shape[-1] else jacobians[..., rows]
        whitened = (parts.reshape(s, c * d, p) @ np.swapaxes(root, -1, -2)).reshape(s, c, d, p)
        total += factor * log_det_small(np.eye(d) + whitened @ np.swapaxes(whitened, -1, -2))
    return total


def size(terms: list[Term]) -> float:
    """s, the degree of homogeneity: Phi(c M) = Phi(M) + s log c."""
    return float(sum(factor * len(rows) for factor, rows in terms))


def upper_bound(value_here: float, largest: float, degree: float) -> float:
    """Phi(M) + s log(max tr(G N) / s)."""
    return value_here + degree * float(np.log(largest / degree))


def log_det_small(matrices: Array) -> Array:
    """(...) log det of small positive definite matrices; 2 x 2, the planar case, without a factorisation."""
    if matrices.shape[-1] != 2:
        return np.linalg.slogdet(matrices)[1]
    return np.log(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])
