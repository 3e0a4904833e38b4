"""D-optimality: the volume of the confidence ellipsoid. Invariant to units and to linear changes of the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria import principal_submatrices
from identification.arrays import Array


@dataclass(frozen=True)
class D:
    """Phi(M) = log det M (paper, Section V; invariant to units, doe/README.md, "Criteria")."""

    name: str = "D"

    def value(self, information: Array) -> Array:
        """(...) log det M, -inf where M is singular."""
        return principal_submatrices.value(information, _everything(information))

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1."""
        return np.asarray(np.linalg.inv(information), dtype=np.float64)

    def curvature(self, information: Array, directions: Array) -> Array:
        """-tr(M^-1 X_a M^-1 X_b)."""
        return principal_submatrices.curvature(information, directions, _everything(information))

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """log det(A + B^T B) - log det A = log det(I_d + B A^-1 B^T): d x d determinants only."""
        return principal_submatrices.values_after_adding(information, jacobians, _everything(information))

    def upper_bound(self, information: Array, largest: float) -> float:
        """log det M + p log(max d / p): from log det N - log det M <= p log(tr(M^-1 N) / p) (arithmetic-geometric)."""
        p = information.shape[-1]
        return float(self.value(information)) + p * float(np.log(largest / p))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p)."""
        return float(np.exp((value - bound) / parameters))


def _everything(information: Array) -> list[principal_submatrices.Term]:
    return [(1.0, np.arange(information.shape[-1]))]
