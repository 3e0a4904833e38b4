"""D-, D_s- and D*-optimality, and D-optimality of several arms at once: criteria made of log-determinants of principal
submatrices of M.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import Factored, Factors, log_determinants, ridged
from identification import Array

Term = tuple[float, NDArray[np.intp]]  # sign, rows


class LogDeterminants(Factored):
    """Phi(M) = sum_t sign_t log det M[rows_t, rows_t]; the criteria of this kind differ in their terms.

    Each of them has Phi(c M) = Phi(M) + s log c, s = sum_t sign_t |rows_t|; with Phi concave that gives the bound
    Phi(N) <= Phi(M) + s log( tr(G N) / s )  (tangent at c M, c chosen best).
    """

    @abstractmethod
    def terms(self, parameters: int) -> list[Term]:
        """Signs and rows (from 0) of the submatrices of a (p, p) matrix."""

    def degree(self, parameters: int) -> float:
        """s, the degree of homogeneity."""
        return float(sum(sign * len(rows) for sign, rows in self.terms(parameters)))

    def value(self, information: Array) -> Array:
        """(...) Phi(M), -inf where a submatrix is singular."""
        total, regular = np.zeros(information.shape[:-2]), np.ones(information.shape[:-2], dtype=bool)
        for sign, rows in self.terms(information.shape[-1]):
            log_det = log_determinants(information[..., rows[:, None], rows])
            regular &= np.isfinite(log_det)
            total = total + sign * np.where(regular, log_det, 0.0)
        return np.where(regular, total, -np.inf)

    def gradient(self, information: Array) -> Array:
        """(p, p) sum_t sign_t inverse of the submatrix, in its place."""
        return np.asarray(sum(sign * inverse for sign, inverse, _ in self.curvature_factors(information)))

    def curvature_factors(self, information: Array) -> Factors:
        """-sum_t sign_t tr(M_t^-1 X_t M_t^-1 Y_t)."""
        factors: Factors = []
        for sign, rows in self.terms(len(information)):
            inverse, place = np.zeros_like(information), np.ix_(rows, rows)
            inverse[place] = np.linalg.inv(information[place])
            factors.append((sign, inverse, inverse))
        return factors

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) Phi(A_s + B_sc^T B_sc) - Phi(A_s), by the determinant lemma: log det(I_d + B_t A_t^-1 B_t^T)."""
        s, c, d, columns = jacobians.shape
        total = np.zeros((s, c))
        for sign, rows in self.terms(columns):
            p = len(rows)
            root = np.linalg.inv(np.linalg.cholesky(ridged(information[..., rows[:, None], rows])))
            parts = jacobians if p == columns else jacobians[..., rows]
            whitened = (parts.reshape(s, c * d, p) @ np.swapaxes(root, -1, -2)).reshape(s, c, d, p)
            small = np.eye(d) + whitened @ np.swapaxes(whitened, -1, -2)
            if d == 2:  # the planar case, without a factorisation
                total += sign * np.log(small[..., 0, 0] * small[..., 1, 1] - small[..., 0, 1] * small[..., 1, 0])
            else:
                total += sign * np.linalg.slogdet(small)[1]
        return total

    def upper_bound(self, information: Array, largest: float) -> float:
        """Phi(M) + s log(max tr(G N) / s)."""
        s = self.degree(len(information))
        return float(self.value(information)) + s * float(np.log(largest / s))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / s)."""
        return float(np.exp((value - bound) / self.degree(parameters))) if np.isfinite(value) else 0.0


@dataclass(frozen=True)
class D(LogDeterminants):
    """Phi(M) = log det M: the volume of the confidence ellipsoid (paper, Section V).

    Invariant to units and to linear changes of the parameters (doe/README.md, "Criteria").
    """

    name: str = "D"

    def terms(self, parameters: int) -> list[Term]:
        """All of M."""
        return [(1.0, np.arange(parameters))]


@dataclass(frozen=True)
class Ds(LogDeterminants):
    """Phi(M) = log det M - log det M_22 = -log det of the covariance of the `subset` (M_22: all other parameters).

    The confidence ellipsoid of some parameters, the others being estimated as well. Invariant to units.

    subset : indices (from 0) of the parameters that matter
    """

    subset: tuple[int, ...]
    name: str = "Ds"

    def terms(self, parameters: int) -> list[Term]:
        """All of M, minus the block of the nuisance parameters."""
        everything = np.arange(parameters)
        return [(1.0, everything), (-1.0, np.setdiff1d(everything, self.subset))]


@dataclass(frozen=True)
class DStar(LogDeterminants):
    """Phi(M) = sum of the log-determinants of the groups' own principal submatrices.

    The paper maximises det C' and asks for det S' = 0, C' and S' being the diagonal and off-diagonal blocks of M'
    (eq. 20). Of the base model both diagonal blocks are C', so Phi = 2 log det C' >= log det M', with equality when
    S' = 0. It ignores the correlation between lengths and angles: prefer D, whose units do not matter either
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

    def terms(self, parameters: int) -> list[Term]:
        """The groups."""
        return [(1.0, np.array(group)) for group in self.groups]

    def value(self, information: Array) -> Array:
        """(...) Phi(M), -inf where M is singular, even if no group's submatrix is."""
        return np.where(np.isneginf(log_determinants(information)), -np.inf, super().value(information))


# -- several arms at once (`doe.problem.uncertain`): M is block diagonal, M_k the information of arm k -----------------
@dataclass(frozen=True)
class Average(LogDeterminants):
    """log det M = sum_k log det M_k: D-optimality of the whole, K^2 times cheaper.

    Its efficiency, exp((value - bound) / p) with p of all arms together, is the geometric mean of the arms'.

    count : K blocks on the diagonal of M
    """

    count: int
    name: str = "average"

    def terms(self, parameters: int) -> list[Term]:
        """The blocks."""
        return [(1.0, rows) for rows in np.split(np.arange(parameters), self.count)]

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) as of D, the sum over the arms."""
        return np.sum(gains(information, jacobians, self.count), axis=0)


@dataclass(frozen=True)
class SoftWorst:
    """-(1/t) log sum_k exp(-t log det M_k) = -(1/t) log sum_k det(M_k)^-t: smooth, concave, below the smallest by at
    most log(K) / t.

    count : K blocks on the diagonal of M;  sharpness : t
    """

    count: int
    sharpness: float = 20.0
    name: str = "soft_worst"

    def value(self, information: Array) -> Array:
        """(...) soft minimum of log det M_k, -inf where one of them is singular."""
        return self._soft_minimum(D().value(diagonal_blocks(information, self.count)))

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) soft minimum of log det (M_k + B_k^T B_k); a singular M_k counts as nearly so."""
        before = D().value(ridged(diagonal_blocks(information, self.count)))
        return self._soft_minimum(before[..., None] + gains(information, jacobians, self.count))

    def _soft_minimum(self, each: Array) -> Array:
        """(...) of (K, ...)."""
        lowest = each.min(axis=0)
        safe = np.where(np.isfinite(lowest), lowest, 0.0)
        with np.errstate(invalid="ignore"):
            total = np.sum(np.exp(-self.sharpness * (each - safe)), axis=0)
        return np.where(np.isfinite(lowest), safe - np.log(total) / self.sharpness, -np.inf)

    def block_weights(self, information: Array) -> Array:
        """(K,) weights of the blocks in the gradient: the worse, the more."""
        each = D().value(diagonal_blocks(information, self.count))
        raised = np.exp(-self.sharpness * (each - each.min()))
        return np.asarray(raised / raised.sum())

    def gradient(self, information: Array) -> Array:
        """(p, p) block diagonal of s_k M_k^-1, s the weights of the blocks."""
        size, total = len(information) // self.count, np.zeros_like(information)
        inverses = np.linalg.inv(diagonal_blocks(information, self.count))
        for k, weight in enumerate(self.block_weights(information)):
            place = slice(k * size, (k + 1) * size)
            total[place, place] = weight * inverses[k]
        return total

    def curvature(self, information: Array, directions: Array) -> Array:
        """sum_k s_k phi_k'' - t (sum_k s_k phi_k' phi_k'^T - (sum_k s_k phi_k') (sum_k s_k phi_k')^T)."""
        weights = self.block_weights(information)
        parts, moves = diagonal_blocks(information, self.count), diagonal_blocks(directions, self.count)
        slopes = np.array([np.tensordot(x, D().gradient(m), axes=2) for x, m in zip(moves, parts, strict=True)])
        bends = sum(s * D().curvature(m, x) for s, m, x in zip(weights, parts, moves, strict=True))
        mean = weights @ slopes
        return np.asarray(bends - self.sharpness * ((slopes.T * weights) @ slopes - np.outer(mean, mean)))

    def upper_bound(self, information: Array, largest: float) -> float:
        """Tangent of sum_k s_k log det M_k, which no design's smallest log det exceeds: its value + largest - p / K."""
        mean = self.block_weights(information) @ D().value(diagonal_blocks(information, self.count))
        return float(mean + largest - len(information) / self.count)

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p) of one arm's p."""
        return float(np.exp((value - bound) / (parameters / self.count))) if np.isfinite(value) else 0.0


@dataclass(frozen=True)
class Worst(SoftWorst):
    """min_k log det M_k; solvers climb its smooth stand-in, whose gradient also gives the bound."""

    sharpness: float = 200.0
    name: str = "worst"

    @property
    def smooth(self) -> SoftWorst:
        """What gradient methods climb."""
        return SoftWorst(self.count)

    surrogate = smooth

    def value(self, information: Array) -> Array:
        """(...) min_k log det M_k."""
        return np.min(D().value(diagonal_blocks(information, self.count)), axis=0)


def gains(information: Array, jacobians: Array, count: int) -> Array:
    """(K, s, c) log det(A_k + B_k^T B_k) - log det A_k of plans (s, p, p) and candidates (s, c, K d, p)."""
    d, p = jacobians.shape[-2] // count, jacobians.shape[-1] // count
    each = [jacobians[..., k * d : (k + 1) * d, k * p : (k + 1) * p] for k in range(count)]
    pairs = zip(diagonal_blocks(information, count), each, strict=True)
    return np.stack([D().values_after_adding(m, b) for m, b in pairs])


def diagonal_blocks(information: Array, count: int) -> Array:
    """(K, ..., p/K, p/K) the diagonal blocks."""
    size = information.shape[-1] // count
    return np.stack([information[..., k : k + size, k : k + size] for k in range(0, count * size, size)])
