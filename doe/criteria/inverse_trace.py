"""A- and I-optimality: Phi(M) = -tr(W M^-1), a weighted sum of variances.

Phi is homogeneous, t(c M) = t(M) / c for t = tr(W M^-1) > 0; the tangent at c M, c chosen best, gives for every other
design t(N) >= t(M)^2 / tr(G N), G = M^-1 W M^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from doe.criteria.criterion import Factored, Factors, woodbury
from identification.arrays import Array, readonly
from identification.information import information_matrix, inverses


@dataclass(frozen=True)
class InverseTrace(Factored):
    """The criteria of this kind differ in the weight matrix W (p, p), positive semidefinite."""

    def weight(self, parameters: int) -> Array:
        """(p, p) W."""
        raise NotImplementedError

    def value(self, information: Array) -> Array:
        """(...) -tr(W M^-1), -inf where M is singular."""
        inverse = inverses(information)
        none = np.isinf(inverse[..., 0, 0])
        finite = np.where(none[..., None, None], 0.0, inverse)
        return np.where(none, -np.inf, -np.sum(finite * self.weight(information.shape[-1]), axis=(-2, -1)))

    def gradient(self, information: Array) -> Array:
        """(p, p) M^-1 W M^-1."""
        inverse = np.linalg.inv(information)
        return inverse @ self.weight(len(information)) @ inverse

    def curvature_factors(self, information: Array) -> Factors:
        """-2 tr(M^-1 W M^-1 X M^-1 Y)."""
        return [(2.0, self.gradient(information), np.asarray(np.linalg.inv(information), dtype=np.float64))]

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) tr(W A^-1) - tr(W (A + B^T B)^-1), by Woodbury's identity: d x d inverses only."""
        s, c, d, p = jacobians.shape
        _, seen, inner = woodbury(information, jacobians)
        outer = (seen.reshape(s, c * d, p) @ self.weight(p)).reshape(s, c, d, p) @ np.swapaxes(seen, -1, -2)
        return np.trace(np.linalg.solve(inner, outer), axis1=-2, axis2=-1)

    def upper_bound(self, information: Array, largest: float) -> float:
        """-t^2 / max tr(G N), t = tr(W M^-1)."""
        return -(float(self.value(information)) ** 2) / largest

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Ratio of the sums of variances, which fall as 1/m."""
        return bound / value if np.isfinite(value) else 0.0


@dataclass(frozen=True)
class A(InverseTrace):
    """Sum of the variances of the scaled parameters [mm^2]: angles times link length (doe/README.md, "Criteria").

    Not invariant to units. The paper's reason against it (a constant trace) is about tr M, not tr M^-1.
    """

    name: str = "A"

    def weight(self, parameters: int) -> Array:
        """(p, p) identity."""
        return np.eye(parameters)


@dataclass(frozen=True)
class I(InverseTrace):  # noqa: E742 (its name in the literature)
    """Mean squared position error at test poses after compensation (Klimchik's test-pose criterion).

    After m runs with noise sigma per coordinate, -Phi sigma^2 / m is the mean over the poses of E |error|^2 [mm^2]:
    Phi = -tr(W M^-1) with W = mean of B_0^T B_0. Invariant to units.

    jacobians : (k, d, p) scaled Jacobians at the test poses, `DesignProblem.scaled_jacobians(poses)`, or (k, P, c, p)
        of P measured points each
    """

    jacobians: Array
    name: str = "I"

    def __post_init__(self) -> None:
        object.__setattr__(self, "jacobians", readonly(self.jacobians))

    @property
    def points(self) -> int:
        """P."""
        return self.jacobians.shape[1] if self.jacobians.ndim == 4 else 1

    @cached_property
    def _weight(self) -> Array:
        k, *_, p = self.jacobians.shape
        return information_matrix(self.jacobians.reshape(k, -1, p)) / k

    def weight(self, parameters: int) -> Array:
        """(p, p) mean of B_0^T B_0."""
        return self._weight
