"""D-optimality: the volume of the confidence ellipsoid. Invariant to units and to linear changes of the parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arm import Array


@dataclass(frozen=True)
class D:
    """Phi(M) = log det M (paper, Section V; invariant to units, THEORY.md section 6)."""

    name: str = "D"

    def value(self, information: Array) -> Array:
        """(...) log det M, -inf where M is singular."""
        sign, log_det = np.linalg.slogdet(information)
        return np.where(sign > 0, log_det, -np.inf)

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1."""
        return np.linalg.inv(information)

    def upper_bound(self, information: Array, largest: float) -> float:
        """log det M + p log(max d / p): from log det N - log det M <= p log(tr(M^-1 N) / p) (arithmetic-geometric)."""
        p = information.shape[-1]
        return float(self.value(information)) + p * float(np.log(largest / p))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p)."""
        return float(np.exp((value - bound) / parameters))
