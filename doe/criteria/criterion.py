"""What a criterion is. Every criterion is MAXIMISED and is a concave function of the information matrix."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np

from identification import Array
from identification.information import column_lengths, rounding_share, significant

Factors = list[tuple[float, Array, Array]]  # number c, and symmetric (p, p) L and R


class Criterion(Protocol):
    """A concave function Phi of the (p, p) scaled information matrix per run, M = sum_i w_i B_i^T B_i, sum w = 1.

    A singular M has the value -inf, not an error; `log_determinants` says which are. What gradient methods climb
    instead of a criterion that is not smooth is its attribute `smooth`, what many postures are compared by instead of
    one that is slow to compute its `surrogate`.
    """

    @property
    def name(self) -> str:
        """As in `--criterion`."""
        ...

    def value(self, information: Array) -> Array:
        """(...) Phi(M) of matrices (..., p, p); -inf where M is singular."""
        ...

    def gradient(self, information: Array) -> Array:
        """(p, p) G = dPhi/dM. Equivalence theorem: w is optimal iff max_q tr(G B(q)^T B(q)) = tr(G M)."""
        ...

    def upper_bound(self, information: Array, largest: float) -> float:
        """No design has a greater value than this, given `largest` >= max_q tr(G B(q)^T B(q)) over the design space."""
        ...

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Fraction 0..1 of the runs that an optimal design would need for the same accuracy."""
        ...


class SmoothCriterion(Criterion, Protocol):
    """One with second derivatives."""

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative D^2 Phi(M)[X_a, X_b] for symmetric directions X (k, p, p); never positive."""
        ...


class Factored(ABC):
    """Criteria with D^2 Phi(M)[X, Y] = -sum c tr(L X R Y)."""

    @abstractmethod
    def curvature_factors(self, information: Array) -> Factors:
        """c, L and R."""

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) D^2 Phi(M)[X_a, X_b]."""
        k, total = len(directions), np.zeros((len(directions),) * 2)
        for factor, left, right in self.curvature_factors(information):
            one, other = left @ directions, right @ directions
            total -= factor * (one.reshape(k, -1) @ np.swapaxes(other, 1, 2).reshape(k, -1).T)
        return np.asarray(0.5 * (total + total.T))


def smooth(criterion: Criterion) -> SmoothCriterion:
    """What gradient methods climb."""
    return getattr(criterion, "smooth", criterion)  # type: ignore[arg-type]


def surrogate(criterion: Criterion) -> Criterion:
    """What many postures are compared by."""
    return getattr(criterion, "surrogate", criterion)


def values_after_adding(criterion: Criterion, information: Array, jacobians: Array) -> Array:
    """(s, c) Phi(A_s + B_sc^T B_sc), but for a number that depends on s only: enough to choose a posture.

    information : (s, p, p) matrices A of plans that lack one run;  jacobians : (s, c, d, p) candidates for it
    A criterion may have a faster `values_after_adding` of its own (D: the determinant lemma).
    """
    faster = getattr(criterion, "values_after_adding", None)
    if faster is not None:
        return faster(information, jacobians)
    return np.asarray(criterion.value(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians))


def ridged(information: Array) -> Array:
    """(..., p, p) the matrices, whose diagonals are about one, with a little added: they have an inverse."""
    p = information.shape[-1]
    # of the mean eigenvalue: where a run is lacking M may be singular, and this keeps the ranking right
    ridge = 1e-9 * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)
    return np.asarray(information + ridge[..., None, None] * np.eye(p))


def woodbury(information: Array, jacobians: Array) -> tuple[Array, Array, Array]:
    """(s, p, p) A^-1, (s, c, d, p) B A^-1 and (s, c, d, d) I + B A^-1 B^T of candidates B (s, c, d, p).

    (A + B^T B)^-1 = A^-1 - A^-1 B^T (I + B A^-1 B^T)^-1 B A^-1.
    """
    s, c, d, p = jacobians.shape
    inverse = np.asarray(np.linalg.inv(ridged(information)), dtype=np.float64)
    seen = (jacobians.reshape(s, c * d, p) @ inverse).reshape(s, c, d, p)
    return inverse, seen, np.asarray(np.eye(d) + seen @ np.swapaxes(jacobians, -1, -2))


def log_determinants(information: Array) -> Array:
    """(...) log det of information matrices (..., p, p) of scaled parameters; -inf where the rule calls them singular.

    The determinant of a matrix of trace p is at most e times its smallest eigenvalue, and spares most matrices their
    eigenvalues.
    """
    p = information.shape[-1]
    sizes = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 0.0))
    usable = np.array(np.all(np.isfinite(information), axis=(-2, -1)))
    lengths, zero = column_lengths(np.where(usable[..., None], sizes, 1.0), np.ones(p))
    usable &= ~np.any(zero, axis=-1)
    scaled = information / lengths[..., :, None] / lengths[..., None, :]
    unit = np.where(usable[..., None, None], scaled, np.eye(p))
    signs, logs = np.linalg.slogdet(unit)
    usable &= signs > 0
    close = usable & (logs <= 1.0 + np.log(p * rounding_share(p)))
    if np.any(close):
        usable[close] = np.all(significant(np.linalg.eigvalsh(unit[close]), rounding_share(p)), axis=-1)
    return np.where(usable, logs + 2.0 * np.sum(np.log(lengths), axis=-1), -np.inf)


def inverses(information: Array) -> Array:
    """(..., p, p) inverses of information matrices of scaled parameters, infinite where `log_determinants` is -inf."""
    p = information.shape[-1]
    singular = np.isneginf(log_determinants(information))[..., None, None]
    matrices = np.where(singular, np.eye(p), information)
    lengths = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
    inverse = np.linalg.inv(matrices / lengths[..., :, None] / lengths[..., None, :])
    return np.where(singular, np.inf, inverse / lengths[..., :, None] / lengths[..., None, :])
