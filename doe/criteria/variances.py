"""A-, I- and E-optimality: a weighted sum of variances, the worst of them, and the smooth means between.

A and I: Phi(M) = -tr(W M^-1). Phi is homogeneous, t(c M) = t(M) / c for t = tr(W M^-1) > 0; the tangent at c M, c
chosen best, gives for every other design t(N) >= t(M)^2 / tr(G N), G = M^-1 W M^-1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import Factored, Factors, inverses, woodbury
from identification import Array, information_matrix, readonly


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


class DegreeOne:
    """Criteria with Phi(c M) = c Phi(M): their tangents pass through the origin."""

    def upper_bound(self, information: Array, largest: float) -> float:
        """max tr(G N); for the smallest eigenvalue with any G >= 0 of unit trace: lambda_min(N) <= tr(G N)."""
        return largest

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Ratio of the values."""
        return value / bound if np.isfinite(value) else 0.0


@dataclass(frozen=True)
class PowerMean(DegreeOne):
    """Kiefer's Phi_k(M) = (mean of lambda^-k)^(-1/k): k -> 0 is D, k = 1 is A, k -> infinity is E. Smooth, concave.

    exponent : k > 0
    """

    exponent: float = 1.0
    name: str = "power_mean"

    def value(self, information: Array) -> Array:
        """(...) Phi_k, -inf where M is singular."""
        variances, none = variances_of(information)
        ratio = variances / variances[..., -1:]
        mean = np.mean(ratio**self.exponent, axis=-1) ** (-1.0 / self.exponent) / variances[..., -1]
        return np.where(none, -np.inf, mean)

    def gradient(self, information: Array) -> Array:
        """(p, p) V diag(g) V^T, g_i = lambda_i^(-k-1) Phi^(k+1) / p."""
        values, vectors = np.linalg.eigh(information)
        return (vectors * self._slopes(values)) @ vectors.T

    def curvature(self, information: Array, directions: Array) -> Array:
        """Second derivative of a symmetric function of eigenvalues (Lewis and Sendov).

        With X~ = V^T X V:  sum_ij h_ij X~_ii Y~_jj + sum_(i != j) (g_i - g_j) / (lambda_i - lambda_j) X~_ij Y~_ij.
        """
        values, vectors = np.linalg.eigh(information)
        slopes, mean, k = self._slopes(values), float(self.value(information)), self.exponent
        turned = vectors.T @ directions @ vectors
        slope_changes = -(k + 1.0) * slopes / values
        gap = values[:, None] - values
        near = np.abs(gap) <= 1e-7 * np.abs(values[:, None] + values)  # the quotient's limit, to 1e-7 of itself
        quotient = np.where(
            near, (slope_changes[:, None] + slope_changes) / 2.0, (slopes[:, None] - slopes) / np.where(near, 1.0, gap)
        )
        np.fill_diagonal(quotient, 0.0)
        diagonal = np.diagonal(turned, axis1=-2, axis2=-1)
        full = np.diag(slope_changes) + (k + 1.0) * np.outer(slopes, slopes) / mean
        flat = turned.reshape(len(directions), -1)
        return diagonal @ full @ diagonal.T + (flat * quotient.ravel()) @ flat.T

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) Phi_k(A + B^T B), inverses by Woodbury's identity, M^-k by squaring if k is a power of two."""
        doublings = float(np.log2(self.exponent))
        if doublings < 1.0 or not doublings.is_integer():
            return self.value(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians)
        before, seen, inner = woodbury(information, jacobians)
        inverse = before[:, None] - np.swapaxes(seen, -1, -2) @ np.linalg.solve(inner, seen)
        power = inverse / np.trace(inverse, axis1=-2, axis2=-1)[..., None, None]  # against overflow
        scale = np.trace(inverse, axis1=-2, axis2=-1)
        for _ in range(int(doublings) - 1):
            power = power @ power
        mean = np.sum(power**2, axis=(-2, -1)) / power.shape[-1]
        return mean ** (-1.0 / self.exponent) / scale

    def _slopes(self, values: Array) -> Array:
        ratio = values / values[0]
        mean = np.mean(ratio**-self.exponent)
        return ratio ** (-self.exponent - 1.0) * mean ** (-1.0 / self.exponent - 1.0) / len(values)


@dataclass(frozen=True)
class E(DegreeOne):
    """Phi(M) = smallest eigenvalue of the scaled M: 1 over the largest variance of any unit combination of parameters.

    Not invariant to units (lengths in mm, angles times link length). Not differentiable where the eigenvalue is
    multiple, which an optimum usually is: the gradient is one of many there, and solvers climb a `smooth` stand-in.
    """

    name: str = "E"

    @property
    def smooth(self) -> PowerMean:
        """What gradient methods climb: within p^(1/k), 7 % for p = 8 and k = 32, of the smallest eigenvalue."""
        return PowerMean(exponent=32.0)

    @property
    def surrogate(self) -> PowerMean:
        """What exchange compares postures by: without an eigenvalue problem for each of them."""
        return PowerMean(exponent=8.0)

    def value(self, information: Array) -> Array:
        """(...) smallest eigenvalue, -inf where M is singular."""
        variances, none = variances_of(information)
        return np.where(none, -np.inf, 1.0 / variances[..., -1])

    def gradient(self, information: Array) -> Array:
        """(p, p) v v^T of the eigenvector v of the smallest eigenvalue (one of its supergradients if multiple)."""
        vector = np.linalg.eigh(information)[1][:, 0]
        return np.outer(vector, vector)


def variances_of(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(..., p) eigenvalues of M^-1, smallest first, ones where M is singular; and (...) where it is."""
    inverse = inverses(information)
    none = np.isinf(inverse[..., 0, 0])
    return np.asarray(np.linalg.eigvalsh(np.where(none[..., None, None], np.eye(inverse.shape[-1]), inverse))), none
