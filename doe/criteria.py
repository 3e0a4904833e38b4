"""Criteria of optimality. Every one is MAXIMISED and is a concave function of the information matrix: sums of
log-determinants of principal submatrices (D, D_s, D*), weighted sums of variances (A, I), and
means of eigenvalues (Kiefer's, E). The bounds follow from the tangent at c M, c chosen best (doe/README.md,
"Equivalence theorem").
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification import Array, log_determinants

NAMES = ("D", "A", "E", "I", "Ds", "Dstar")
Term = tuple[float, NDArray[np.intp]]  # sign, rows


class Criterion(ABC):
    """A concave function Phi of the (p, p) scaled information matrix per run, M = sum_i w_i B_i^T B_i, sum w = 1.

    A singular M has the value -inf, not an error; `log_determinants` says which are.
    name : as in `--criterion`;  power : Phi(c M) = c^power Phi(M), or if it is 0, Phi(M) + degree log c
    """

    name: str
    power: int

    @abstractmethod
    def value(self, information: Array) -> Array:
        """(...) Phi(M) of matrices (..., p, p); -inf where M is singular."""

    @abstractmethod
    def gradient(self, information: Array) -> Array:
        """(..., p, p) G = dPhi/dM, an analytic function of the entries of M: see `curvature`.

        Equivalence theorem: w is optimal iff max_q tr(G B(q)^T B(q)) = tr(G M).
        """

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative D^2 Phi(M)[X_a, X_b] for symmetric directions X (k, p, p); never positive.

        Exact to rounding: the imaginary part of G(M + i h X) / h has no difference in it that could cancel.
        """
        step = 1e-60
        beside: Any = information + 1j * step * directions
        changes = np.imag(self.gradient(beside)) / step
        half = 0.5 * changes.reshape(len(directions), -1) @ directions.reshape(len(directions), -1).T
        return np.asarray(half + half.T)

    def degree(self, parameters: int) -> float:
        """Of homogeneity, where the power is 0."""
        return float(parameters)

    def upper_bound(self, information: Array, largest: float) -> float:
        """No design has a greater value than this, given `largest` >= max_q tr(G B(q)^T B(q)) over the design space."""
        if self.power == 1:
            return largest  # of the smallest eigenvalue with any G >= 0 of unit trace: lambda_min(N) <= tr(G N)
        value, s = float(self.value(information)), self.degree(len(information))
        return -(value**2) / largest if self.power else value + s * float(np.log(largest / s))

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Fraction 0..1 of the runs that an optimal design would need for the same accuracy; 0 of an infinite bound."""
        if not np.isfinite([value, bound]).all():
            return 0.0
        if self.power == 0:
            return float(np.exp((value - bound) / self.degree(parameters)))
        return float((value / bound) ** self.power)

    @property
    def smooth(self) -> Criterion:
        """What searches climb and compare postures by: another one where the criterion has no second derivatives."""
        return self

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """(s, c) Phi(A_s + B_sc^T B_sc), but for a number that depends on s only: enough to choose a posture.

        information : (s, p, p) matrices A of plans that lack one run;  jacobians : (s, c, d, p) candidates for it
        """
        return np.asarray(self.value(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians))

    def ranking(self, information: Array, jacobians: Array) -> Ranking:
        """Of candidates (c, d, p) for the runs of a plan with the (p, p) matrix M."""
        return Ranking(self, information, jacobians)


class Ranking:
    """What each of many candidates B (c, d, p) is worth in the place of a run of a plan, whose runs are exchanged."""

    def __init__(self, criterion: Criterion, information: Array, jacobians: Array) -> None:
        self.criterion, self.information, self.jacobians = criterion, information, jacobians

    def instead_of(self, run: Array) -> Array:
        """(c,) `values_after_adding` where the plan lacks a run J (d, p)."""
        return self.criterion.values_after_adding((self.information - run.T @ run)[None], self.jacobians[None])[0]

    def exchange(self, old: Array, new: Array) -> None:
        """The plan has another run (d, p) in the place of one."""
        self.information = self.information - old.T @ old + new.T @ new


# -- log-determinants --------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class D(Criterion):
    """Phi(M) = log det M: the volume of the confidence ellipsoid (paper, Section V).

    Invariant to units and to linear changes of the parameters (doe/README.md, "Criteria"). The other criteria of this
    kind are sums over their terms, G = sum_t s_t M_t^-1 with each inverse in its place.
    """

    name, power = "D", 0

    def terms(self, parameters: int) -> list[Term]:
        """Signs and rows (from 0) of the submatrices of a (p, p) matrix: all of M."""
        return [(1.0, np.arange(parameters))]

    def degree(self, parameters: int) -> float:
        return float(sum(sign * len(rows) for sign, rows in self.terms(parameters)))

    def value(self, information: Array) -> Array:
        terms = self.terms(information.shape[-1])
        with np.errstate(invalid="ignore"):  # none less none is NaN
            total = sum(sign * log_determinants(information[..., rows[:, None], rows]) for sign, rows in terms)
        return np.where(np.isfinite(total), total, -np.inf)

    def gradient(self, information: Array) -> Array:
        total = np.zeros_like(information)
        for sign, rows in self.terms(information.shape[-1]):
            total[..., rows[:, None], rows] += sign * np.linalg.inv(information[..., rows[:, None], rows])
        return total

    def curvature(self, information: Array, directions: Array) -> Array:
        """-sum_t s_t tr(M_t^-1 X_a M_t^-1 X_b), with real inverses only."""
        total = np.zeros((len(directions), len(directions)))
        for sign, rows in self.terms(len(information)):
            root = np.linalg.inv(np.linalg.cholesky(information[rows[:, None], rows]))
            whitened = (root @ directions[:, rows[:, None], rows] @ root.T).reshape(len(directions), -1)
            total -= sign * (whitened @ whitened.T)
        return total

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """Less Phi(A_s), by the determinant lemma: log det(I_d + B_t A_t^-1 B_t^T)."""
        total = np.zeros(jacobians.shape[:2])
        for sign, rows in self.terms(information.shape[-1]):
            root = np.linalg.inv(np.linalg.cholesky(ridged(information[..., rows[:, None], rows])))
            parts = jacobians if len(rows) == jacobians.shape[-1] else jacobians[..., rows]
            s, c, d, p = parts.shape
            whitened = (parts.reshape(s, c * d, p) @ np.swapaxes(root, -1, -2)).reshape(s, c, d, p)
            total += sign * np.linalg.slogdet(np.eye(d) + whitened @ np.swapaxes(whitened, -1, -2))[1]
        return total


@dataclass(frozen=True)
class Ds(D):
    """Phi(M) = log det M - log det M_22 = -log det of the covariance of the `subset` (M_22: all other parameters).

    The confidence ellipsoid of some parameters, the others being estimated as well. Invariant to units.
    subset : indices (from 0) of the parameters that matter
    """

    subset: tuple[int, ...]
    name = "Ds"

    def terms(self, parameters: int) -> list[Term]:
        everything = np.arange(parameters)
        return [(1.0, everything), (-1.0, np.setdiff1d(everything, self.subset))]


@dataclass(frozen=True)
class DStar(D):
    """Phi(M) = sum of the log-determinants of the groups' own principal submatrices; -inf where M is singular.

    The paper maximises det C' and asks for det S' = 0, C' and S' being the diagonal and off-diagonal blocks of M'
    (eq. 20). Of the base model both diagonal blocks are C', so Phi = 2 log det C' >= log det M', with equality when
    S' = 0. It ignores the correlation between lengths and angles: prefer D (doe/README.md, "Criteria"). det S' = 0
    alone says nothing for odd n, where every antisymmetric matrix has it, and little for even n >= 4, where such a
    matrix may be singular without being zero: D* agrees with D for 2 links only.

    groups : indices (from 0) of the parameters of each group, say lengths and angles
    """

    groups: tuple[tuple[int, ...], ...]
    name = "Dstar"

    @classmethod
    def by_unit(cls, units: Sequence[str]) -> DStar:
        """One group per unit of the p parameters, as the paper argues."""
        return cls(tuple(tuple(k for k, u in enumerate(units) if u == unit) for unit in dict.fromkeys(units)))

    def terms(self, parameters: int) -> list[Term]:
        return [(1.0, np.array(group)) for group in self.groups]

    def value(self, information: Array) -> Array:
        return np.where(np.isneginf(log_determinants(information)), -np.inf, super().value(information))

    # exchanges that look at the blocks alone would end in plans with a singular M
    values_after_adding = Criterion.values_after_adding

    def upper_bound(self, information: Array, largest: float) -> float:
        """Of the blocks alone: they are regular where M is not, as it may be at the best weights."""
        s = self.degree(len(information))
        return float(super().value(information)) + s * float(np.log(largest / s))


# -- variances ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class A(Criterion):
    """Sum of the variances of the scaled parameters [mm^2]: angles times link length (doe/README.md, "Criteria").

    Phi(M) = -tr(W M^-1), with G = M^-1 W M^-1 and W = I; criteria of this kind differ in the weight matrix W, positive
    semidefinite. Not invariant to units. The paper's reason against it (a constant trace) is about tr M, not tr M^-1.
    """

    name, power = "A", -1

    def weight(self, parameters: int) -> Array:
        """(p, p) W."""
        return np.eye(parameters)

    def value(self, information: Array) -> Array:
        inverse, singular = inverses(information)
        return np.where(singular, -np.inf, -np.sum(inverse * self.weight(information.shape[-1]), axis=(-2, -1)))

    def gradient(self, information: Array) -> Array:
        inverse = np.linalg.inv(information)
        return np.asarray(inverse @ self.weight(information.shape[-1]) @ inverse)

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """tr(W A^-1) - tr(W (A + B^T B)^-1), by Woodbury's identity: d x d inverses only."""
        s, c, d, p = jacobians.shape
        _, seen, inner = _woodbury(information, jacobians)
        outer = (seen.reshape(s, c * d, p) @ self.weight(p)).reshape(s, c, d, p) @ np.swapaxes(seen, -1, -2)
        return np.trace(np.linalg.solve(inner, outer), axis1=-2, axis2=-1)

    def ranking(self, information: Array, jacobians: Array) -> Ranking:
        return RankingByTrace(self, information, jacobians)


class RankingByTrace(Ranking):
    """The same for -tr(W M^-1), in a small part of the time: kept are M^-1 and the d x d matrices S = B M^-1 B^T and
    T = B M^-1 W M^-1 B^T, since a candidate gains tr((I + S)^-1 T).

    Runs R that come and go, M' = M + R^T s R with signs s, change them by few columns, B R' and B M^-1 W R' with
    R' = M^-1 R^T: M'^-1 = M^-1 - R' C R'^T,  C = (1/s + R R')^-1.
    """

    def __init__(self, criterion: A, information: Array, jacobians: Array) -> None:
        super().__init__(criterion, information, jacobians)
        self.weight, self.rows = criterion.weight(len(information)), jacobians.reshape(-1, len(information))
        before, seen, inner = _woodbury(information[None], jacobians[None])
        self.inverse, self.covariance = before[0], inner[0] - np.eye(jacobians.shape[1])
        self.spread = (seen[0] @ self.weight) @ np.swapaxes(seen[0], -1, -2)

    def _after(self, runs: Array, signs: Array) -> tuple[Array, Array, Array]:
        """M^-1, S and T with runs (r, p) of these signs."""
        right = self.inverse @ runs.T
        core = np.linalg.inv(np.diag(1.0 / signs) + runs @ right)
        weighted = self.weight @ right
        seen, errors = (
            (self.rows @ np.hstack([right, self.inverse @ weighted]))
            .reshape(*self.jacobians.shape[:2], 2, -1)
            .transpose(2, 0, 1, 3)
        )
        back = core @ np.swapaxes(seen, -1, -2)
        mixed = (errors - 0.5 * seen @ (core @ (right.T @ weighted))) @ back
        return (
            self.inverse - right @ core @ right.T,
            self.covariance - seen @ back,
            self.spread - mixed - mixed.swapaxes(1, 2),
        )

    def instead_of(self, run: Array) -> Array:
        # nearly all of the run: without it M may be singular, and this keeps the ranking right
        _, covariance, spread = self._after(run, np.full(len(run), 1e-9 - 1.0))
        return np.trace(np.linalg.solve(np.eye(len(run)) + covariance, spread), axis1=-2, axis2=-1)

    def exchange(self, old: Array, new: Array) -> None:
        signs = np.repeat([-1.0, 1.0], len(old))
        self.inverse, self.covariance, self.spread = self._after(np.concatenate([old, new]), signs)


@dataclass(frozen=True)
class I(A):  # noqa: E742 (its name in the literature)
    """Mean squared position error at test poses after compensation (Klimchik's test-pose criterion).

    After m runs with noise sigma per coordinate, -Phi sigma^2 / m is the mean over the poses of E |error|^2 [mm^2]:
    Phi = -tr(W M^-1) with W = mean of B_0^T B_0. Invariant to units.

    jacobians : (k, d, p) scaled Jacobians at the test poses, `DesignProblem.scaled_jacobians(poses)`, or (k, P, c, p)
        of P measured points each
    """

    jacobians: Array
    name = "I"

    @property
    def points(self) -> int:
        """P."""
        return self.jacobians.shape[1] if self.jacobians.ndim == 4 else 1

    @cached_property
    def _weight(self) -> Array:
        k, *_, p = self.jacobians.shape
        return information_matrix(self.jacobians.reshape(k, -1, p)) / k

    def weight(self, parameters: int) -> Array:
        return self._weight


# -- eigenvalues -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class PowerMean(Criterion):
    """Kiefer's Phi_k(M) = (mean of lambda^-k)^(-1/k), concave and smooth; k = 1 orders as A, k -> infinity is E.

    With N = M^-1 / c for any c: Phi = (tr N^k / p)^(-1/k) / c and G = (tr N^k / p)^(-1/k - 1) N^(k+1) / p; here c is
    tr M^-1, against overflow.

    exponent : k, whole, >= 1
    """

    exponent: int = 1
    name, power = "power_mean", 1

    def value(self, information: Array) -> Array:
        inverse, singular = inverses(information)
        return np.where(singular, -np.inf, self._of(inverse))

    def _of(self, inverse: Array) -> Array:
        scale = np.trace(inverse, axis1=-2, axis2=-1)
        power = np.linalg.matrix_power(inverse / scale[..., None, None], self.exponent)
        return np.asarray((np.trace(power, axis1=-2, axis2=-1) / power.shape[-1]) ** (-1.0 / self.exponent) / scale)

    def gradient(self, information: Array) -> Array:
        inverse = np.linalg.inv(information)
        scaled = inverse / np.real(np.trace(inverse, axis1=-2, axis2=-1))[..., None, None]
        power = np.linalg.matrix_power(scaled, self.exponent)
        mean = np.trace(power, axis1=-2, axis2=-1) / power.shape[-1]
        return np.asarray((mean ** (-1.0 / self.exponent - 1.0) / scaled.shape[-1])[..., None, None] * (power @ scaled))

    def values_after_adding(self, information: Array, jacobians: Array) -> Array:
        """Of inverses by Woodbury's identity."""
        before, seen, inner = _woodbury(information, jacobians)
        return self._of(before[:, None] - np.swapaxes(seen, -1, -2) @ np.linalg.solve(inner, seen))


@dataclass(frozen=True)
class E(Criterion):
    """Phi(M) = smallest eigenvalue of the scaled M: 1 over the largest variance of any unit combination of parameters.

    Not invariant to units (lengths in mm, angles times link length). Not differentiable where the eigenvalue is
    multiple, which an optimum usually is: the gradient, v v^T of its eigenvector, is one of many there. Solvers climb
    the power mean of k = 32, within p^(1/k) of it, 7 % for p = 8.
    """

    name, power = "E", 1

    @property
    def smooth(self) -> Criterion:
        return PowerMean(32)

    def value(self, information: Array) -> Array:
        inverse, singular = inverses(information)
        return np.where(singular, -np.inf, 1.0 / np.linalg.eigvalsh(inverse)[..., -1])

    def gradient(self, information: Array) -> Array:
        vector = np.linalg.eigh(information)[1][..., 0]
        return np.asarray(vector[..., :, None] * vector[..., None, :])


# -- matrices ----------------------------------------------------------------------------------------------------------
def ridged(information: Array) -> Array:
    """(..., p, p) the matrices, whose diagonals are about one, with a little added: they have an inverse."""
    p = information.shape[-1]
    # of the mean eigenvalue: where a run is lacking M may be singular, and this keeps the ranking right
    ridge = 1e-9 * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)
    return np.asarray(information + ridge[..., None, None] * np.eye(p))


def _woodbury(information: Array, jacobians: Array) -> tuple[Array, Array, Array]:
    """(s, p, p) A^-1, (s, c, d, p) B A^-1 and (s, c, d, d) I + B A^-1 B^T of candidates B (s, c, d, p).

    (A + B^T B)^-1 = A^-1 - A^-1 B^T (I + B A^-1 B^T)^-1 B A^-1.
    """
    s, c, d, p = jacobians.shape
    inverse = np.asarray(np.linalg.inv(ridged(information)), dtype=np.float64)
    seen = (jacobians.reshape(s, c * d, p) @ inverse).reshape(s, c, d, p)
    return inverse, seen, np.asarray(np.eye(d) + seen @ np.swapaxes(jacobians, -1, -2))


def information_matrix(jacobian: Array, weights: Array | None = None) -> Array:
    """(..., p, p) sum_i w_i J_i^T J_i of Jacobians (..., m, d, p); weights (m,) default to one."""
    *batch, m, d, p = jacobian.shape
    rows = jacobian if weights is None else jacobian * np.sqrt(np.asarray(weights))[:, None, None]
    rows = rows.reshape(*batch, m * d, p)
    return np.swapaxes(rows, -1, -2) @ rows


def inverses(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(..., p, p) inverses of information matrices of scaled parameters, the unit matrix where one is singular; and
    (...) where that is, by `log_determinants`."""
    singular = np.isneginf(log_determinants(information))
    matrices = np.where(singular[..., None, None], np.eye(information.shape[-1]), information)
    lengths = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
    inverse = np.linalg.inv(matrices / lengths[..., :, None] / lengths[..., None, :])
    return inverse / lengths[..., :, None] / lengths[..., None, :], singular
