"""Several arms at once: D-optimality on average, or at worst, over a prior (`doe.problem.bayesian`).

M is block diagonal, M_k the information of arm k. Everything is done block by block.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria.d import D
from doe.criteria.principal_submatrices import RIDGE
from identification.arrays import Array


@dataclass(frozen=True)
class Average:
    """log det M = sum_k log det M_k: D-optimality of the whole, K^2 times cheaper.

    count : K blocks on the diagonal of M
    """

    count: int
    name: str = "average"

    def value(self, information: Array) -> Array:
        """(...) sum of log det M_k, -inf where one of them is singular."""
        return np.sum([D().value(part) for part in split(information, self.count)], axis=0)

    def gradient(self, information: Array) -> Array:
        """(p, p) block diagonal of M_k^-1."""
        return block_diagonal([D().gradient(part) for part in split(information, self.count)])

    def curvature(self, information: Array, directions: Array) -> Array:
        """Sum of the blocks' own."""
        pairs = zip(split(information, self.count), split(directions, self.count), strict=True)
        return np.sum([D().curvature(part, moves) for part, moves in pairs], axis=0)

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) as of D, the sum over the arms."""
        return np.sum(gains(information, jacobians, self.count), axis=0)

    def upper_bound(self, information: Array, largest: float) -> float:
        """As of D."""
        p = information.shape[-1]
        return float(self.value(information)) + p * float(np.log(largest / p))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """exp((value - bound) / p), p of all arms together: the geometric mean of the arms' efficiencies."""
        return float(np.exp((value - bound) / parameters)) if np.isfinite(value) else 0.0


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
        each = np.stack([D().value(part) for part in split(information, self.count)], axis=-1)
        lowest = each.min(axis=-1)
        safe = np.where(np.isfinite(lowest), lowest, 0.0)
        with np.errstate(invalid="ignore"):
            total = np.sum(np.exp(-self.sharpness * (each - safe[..., None])), axis=-1)
        return np.where(np.isfinite(lowest), safe - np.log(total) / self.sharpness, -np.inf)

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) soft minimum of log det (M_k + B_k^T B_k); a singular M_k counts as nearly so."""
        parts = split(information, self.count)
        ridge = [
            m + RIDGE * (1e-3 + np.trace(m, axis1=-2, axis2=-1)[..., None, None]) * np.eye(m.shape[-1]) for m in parts
        ]
        before = np.stack([D().value(m) for m in ridge])
        each = before[..., None] + gains(information, jacobians, self.count)
        lowest = each.min(axis=0)
        return lowest - np.log(np.sum(np.exp(-self.sharpness * (each - lowest)), axis=0)) / self.sharpness

    def shares(self, information: Array) -> Array:
        """(K,) weights of the blocks in the gradient: the worse, the more."""
        each = np.array([float(D().value(part)) for part in split(information, self.count)])
        raised = np.exp(-self.sharpness * (each - each.min()))
        return np.asarray(raised / raised.sum())

    def gradient(self, information: Array) -> Array:
        """(p, p) block diagonal of shares_k M_k^-1."""
        return block_diagonal(
            [s * D().gradient(m) for s, m in zip(self.shares(information), split(information, self.count), strict=True)]
        )

    def curvature(self, information: Array, directions: Array) -> Array:
        """sum_k s_k phi_k'' - t (sum_k s_k phi_k' phi_k'^T - (sum_k s_k phi_k') (sum_k s_k phi_k')^T)."""
        shares, parts = self.shares(information), split(information, self.count)
        moves = split(directions, self.count)
        slopes = np.array([np.tensordot(x, D().gradient(m), axes=2) for x, m in zip(moves, parts, strict=True)])
        bends = sum(s * D().curvature(m, x) for s, m, x in zip(shares, parts, moves, strict=True))
        mean = shares @ slopes
        return np.asarray(bends - self.sharpness * ((slopes.T * shares) @ slopes - np.outer(mean, mean)))

    def upper_bound(self, information: Array, largest: float) -> float:
        """Tangent of sum_k s_k log det M_k, which no design's smallest log det exceeds: its value + largest - p / K."""
        parts = split(information, self.count)
        mean = sum(s * float(D().value(m)) for s, m in zip(self.shares(information), parts, strict=True))
        return float(mean + largest - parts[0].shape[-1])

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

    @property
    def surrogate(self) -> SoftWorst:
        """What exchange compares by."""
        return SoftWorst(self.count)

    def value(self, information: Array) -> Array:
        """(...) min_k log det M_k."""
        return np.min([D().value(part) for part in split(information, self.count)], axis=0)


def gains(information: Array, jacobians: Array, count: int) -> Array:
    """(K, s, c) log det(A_k + B_k^T B_k) - log det A_k of plans (s, p, p) and candidates (s, c, K d, p)."""
    d, p = jacobians.shape[-2] // count, jacobians.shape[-1] // count
    own = [jacobians[..., k * d : (k + 1) * d, k * p : (k + 1) * p] for k in range(count)]
    return np.stack([D().values_after_adding(m, b) for m, b in zip(split(information, count), own, strict=True)])


def split(information: Array, count: int) -> list[Array]:
    """The K diagonal blocks (..., p/K, p/K)."""
    size = information.shape[-1] // count
    return [information[..., k * size : (k + 1) * size, k * size : (k + 1) * size] for k in range(count)]


def block_diagonal(parts: list[Array]) -> Array:
    """(p, p) block-diagonal matrix."""
    size = parts[0].shape[0]
    matrix = np.zeros((size * len(parts), size * len(parts)))
    for k, part in enumerate(parts):
        matrix[k * size : (k + 1) * size, k * size : (k + 1) * size] = part
    return matrix
