"""D-optimality: the volume of the confidence ellipsoid. Invariant to units and to linear changes of the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arm import Array

RIDGE = 1e-9  # a plan that lacks one run may be singular; this share of the mean eigenvalue keeps the ranking right


@dataclass(frozen=True)
class D:
    """Phi(M) = log det M (paper, Section V; invariant to units, THEORY.md section 6)."""

    name: str = "D"

    def value(self, information: Array) -> Array:
        """(...) log det M, -inf where M is singular."""
        sign, log_det = np.linalg.slogdet(information)
        return np.where(sign > 0, log_det, -np.inf).astype(np.float64)

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1."""
        return np.asarray(np.linalg.inv(information), dtype=float)

    def curvature(self, information: Array, directions: Array) -> Array:
        """-tr(M^-1 X_a M^-1 X_b), as a Gram matrix of L^-1 X L^-T with M = L L^T."""
        root = np.linalg.inv(np.linalg.cholesky(information))
        whitened = (root @ directions @ root.T).reshape(len(directions), -1)
        return -(whitened @ whitened.T)

    def values_after_adding(self, information: Array, blocks: Array) -> Array:
        """log det(A + B^T B) - log det A = log det(I_d + B A^-1 B^T): d x d determinants only."""
        s, c, d, p = blocks.shape
        ridge = RIDGE * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)  # blocks are about one
        root = np.linalg.inv(np.linalg.cholesky(information + ridge[:, None, None] * np.eye(p)))
        whitened = (blocks.reshape(s, c * d, p) @ np.swapaxes(root, -1, -2)).reshape(s, c, d, p)
        return log_det_small(np.eye(d) + whitened @ np.swapaxes(whitened, -1, -2))

    def upper_bound(self, information: Array, largest: float) -> float:
        """log det M + p log(max d / p): from log det N - log det M <= p log(tr(M^-1 N) / p) (arithmetic-geometric)."""
        p = information.shape[-1]
        return float(self.value(information)) + p * float(np.log(largest / p))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p)."""
        return float(np.exp((value - bound) / parameters))


def log_det_small(matrices: Array) -> Array:
    """(...) log det of small positive definite matrices; 2 x 2, the planar case, without a factorisation."""
    if matrices.shape[-1] != 2:
        return np.linalg.slogdet(matrices)[1]
    return np.log(matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0])
