"""The paper's D*: lengths and angles taken separately (eq. 20, corrected)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from doe.criteria import principal_submatrices
from identification.arrays import Array


@dataclass(frozen=True)
class DStar:
    """Phi(M) = sum of the log-determinants of the groups' own principal submatrices.

    The paper maximises det C' and asks for det S' = 0, C' and S' being the diagonal and off-diagonal blocks of M'
    (eq. 20). Of the base model both diagonal blocks are C', so Phi = 2 log det C' >= log det M', with equality when
    S' = 0. What the lengths lose to the angles is not counted: prefer D, whose units do not matter either
    (doe/README.md, "Criteria"). det S' = 0 alone says nothing for odd n, where every antisymmetric matrix has it, and
    little for even n >= 4, where such a matrix may be singular without being zero: D* agrees with D for 2 links only.

    groups : indices (from 0) of the parameters of each group, say lengths and angles
    """

    groups: tuple[tuple[int, ...], ...]
    name: str = "Dstar"

    @classmethod
    def by_unit(cls, units: Sequence[str]) -> DStar:
        """One group per unit of the p parameters, as the paper argues."""
        return cls(tuple(tuple(k for k, u in enumerate(units) if u == unit) for unit in dict.fromkeys(units)))

    def value(self, information: Array) -> Array:
        """(...) sum of the groups' log det, -inf where M is singular."""
        return principal_submatrices.value(information, self._terms)

    def gradient(self, information: Array) -> Array:
        """(p, p) inverses of the groups' submatrices, in their places."""
        return principal_submatrices.gradient(information, self._terms)

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative along symmetric directions."""
        return principal_submatrices.curvature(information, directions, self._terms)

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) gain of adding a posture."""
        return principal_submatrices.values_after_adding(information, jacobians, self._terms)

    def upper_bound(self, information: Array, largest: float) -> float:
        """Phi(M) + s log(max tr(G N) / s), s parameters in the groups."""
        return principal_submatrices.upper_bound(float(self.value(information)), largest, self._size)

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / s)."""
        return float(np.exp((value - bound) / self._size))

    @property
    def _size(self) -> float:
        return principal_submatrices.size(self._terms)

    @property
    def _terms(self) -> list[principal_submatrices.Term]:
        return [(1.0, np.array(group)) for group in self.groups]
