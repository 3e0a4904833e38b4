"""Several arms at once: D-optimality on average, or at worst, over a prior (`doe.problem.bayesian`).

M is block diagonal, M_k the information of arm k. Everything is computed block by block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria.criterion import ridged
from doe.criteria.log_determinants import D, LogDeterminants, Term
from identification.arrays import Array


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
