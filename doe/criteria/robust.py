"""Model-robust D-optimality: precise base parameters, and no missing effect that would go unseen.

Base parameters are primary terms, the parameters of possible effects are potential terms with a prior variance:
Phi(M) = log det(M + K), K = diag(0 for base, 1 / tau^2 for effects). W. DuMouchel, B. Jones, "A simple Bayesian
modification of D-optimal designs to reduce dependence on an assumed model", Technometrics 36 (1994).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria.d import D
from identification.arm import Array


@dataclass(frozen=True)
class Robust:
    """log det(M + K): D-optimality with prior precisions K on the diagonal, per run and in scaled parameters.

    precisions : (p,) zero where the data alone must tell the parameter
    """

    precisions: Array
    name: str = "robust"

    def _with_prior(self, information: Array) -> Array:
        return information + np.diag(self.precisions)

    def value(self, information: Array) -> Array:
        """(...) log det(M + K), -inf where that is singular."""
        return D().value(self._with_prior(information))

    def gradient(self, information: Array) -> Array:
        """(p, p) (M + K)^-1."""
        return D().gradient(self._with_prior(information))

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative in symmetric directions, as of D at M + K."""
        return D().curvature(self._with_prior(information), directions)

    def values_after_adding(self, information: Array, blocks: Array) -> Array:
        """As of D at M + K."""
        return D().values_after_adding(self._with_prior(information), blocks)

    def upper_bound(self, information: Array, largest: float) -> float:
        """log det(M + K) + p log((largest + tr G K) / p): the argument of D with M + K in place of M."""
        p = information.shape[-1]
        fixed = float(np.sum(np.diag(self.gradient(information)) * self.precisions))
        return float(self.value(information)) + p * float(np.log((largest + fixed) / p))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p)."""
        return float(np.exp((value - bound) / parameters))
