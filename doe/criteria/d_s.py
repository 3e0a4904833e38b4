"""D_s-optimality: the confidence ellipsoid of some parameters, the others being estimated as well."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria import principal_submatrices
from identification.arrays import Array


@dataclass(frozen=True)
class Ds:
    """Phi(M) = log det M - log det M_22 = -log det of the covariance of the `subset` (M_22: all other parameters).

    subset : indices (from 0) of the parameters that matter. Invariant to units.
    """

    subset: tuple[int, ...]
    name: str = "Ds"

    def value(self, information: Array) -> Array:
        """(...) log det of the subset's information, -inf where M is singular."""
        return principal_submatrices.value(information, self._terms(information))

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1 less M_22^-1 in its place."""
        return principal_submatrices.gradient(information, self._terms(information))

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative along symmetric directions."""
        return principal_submatrices.curvature(information, directions, self._terms(information))

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) gain of adding a posture."""
        return principal_submatrices.values_after_adding(information, jacobians, self._terms(information))

    def upper_bound(self, information: Array, largest: float) -> float:
        """Phi(M) + s log(max tr(G N) / s), s parameters in the subset."""
        return principal_submatrices.upper_bound(float(self.value(information)), largest, float(len(self.subset)))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / s)."""
        return float(np.exp((value - bound) / len(self.subset)))

    def _terms(self, information: Array) -> list[principal_submatrices.Term]:
        everything = np.arange(information.shape[-1])
        return [(1.0, everything), (-1.0, np.setdiff1d(everything, self.subset))]
