"""What A- and I-optimality have in common: Phi(M) = -tr(W M^-1), a weighted sum of variances.

Phi is homogeneous, t(c M) = t(M) / c for t = tr(W M^-1) > 0; the tangent at c M, c chosen best, gives for every other
design t(N) >= t(M)^2 / tr(G N), G = M^-1 W M^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array

RIDGE = 1e-9  # see `principal_submatrices.RIDGE`
SINGULAR = 1e-13  # reciprocal condition number below which a matrix has no usable inverse


@dataclass(frozen=True)
class InverseTrace:
    """The criteria of this kind differ in the weight matrix W (p, p), positive semidefinite."""

    def weight(self, parameters: int) -> Array:
        """(p, p) W."""
        raise NotImplementedError

    def value(self, information: Array) -> Array:
        """(...) -tr(W M^-1), -inf where M is singular."""
        values, vectors = np.linalg.eigh(information)
        weight = self.weight(information.shape[-1])
        shares = np.einsum("...ik,ij,...jk->...k", vectors, weight, vectors)
        singular = values[..., 0] <= SINGULAR * np.abs(values[..., -1])
        safe = np.where(singular[..., None], 1.0, values)
        return np.where(singular, -np.inf, -np.sum(shares / safe, axis=-1))

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1 W M^-1."""
        inverse = np.linalg.inv(information)
        return inverse @ self.weight(len(information)) @ inverse

    def curvature(self, information: Array, directions: Array) -> Array:
        """-2 tr(W M^-1 X_a M^-1 X_b M^-1), as a Gram matrix of W^1/2 M^-1 X L^-T with M = L L^T."""
        inverse = np.linalg.inv(information)
        root = np.linalg.inv(np.linalg.cholesky(information))
        left = square_root(self.weight(len(information))) @ inverse
        flat = (left @ directions @ root.T).reshape(len(directions), -1)
        return -2.0 * (flat @ flat.T)

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) tr(W A^-1) - tr(W (A + B^T B)^-1), by Woodbury's identity: d x d inverses only."""
        s, c, d, p = jacobians.shape
        ridge = RIDGE * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)
        inverse = np.linalg.inv(information + ridge[:, None, None] * np.eye(p))
        seen = (jacobians.reshape(s, c * d, p) @ inverse).reshape(s, c, d, p)  # B A^-1
        inner = np.eye(d) + seen @ np.swapaxes(jacobians, -1, -2)
        outer = (seen.reshape(s, c * d, p) @ self.weight(p)).reshape(s, c, d, p) @ np.swapaxes(seen, -1, -2)
        return np.trace(np.linalg.solve(inner, outer), axis1=-2, axis2=-1)

    def upper_bound(self, information: Array, largest: float) -> float:
        """-t^2 / max tr(G N), t = tr(W M^-1)."""
        return -(float(self.value(information)) ** 2) / largest

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Ratio of the sums of variances, which fall as 1/m."""
        return bound / value if np.isfinite(value) else 0.0


def inverses_after_adding(information: Array, jacobians: Array) -> Array:
    """(s, c, p, p) (A_s + B_sc^T B_sc)^-1 by Woodbury's identity."""
    s, c, d, p = jacobians.shape
    ridge = RIDGE * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)
    inverse = np.linalg.inv(information + ridge[:, None, None] * np.eye(p))
    seen = (jacobians.reshape(s, c * d, p) @ inverse).reshape(s, c, d, p)  # B A^-1
    inner = np.eye(d) + seen @ np.swapaxes(jacobians, -1, -2)
    return inverse[:, None] - np.swapaxes(seen, -1, -2) @ np.linalg.solve(inner, seen)


def square_root(matrix: Array) -> Array:
    """(p, p) symmetric square root of a positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
