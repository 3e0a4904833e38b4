"""What a criterion is. Every criterion is MAXIMISED and is a concave function of the information matrix."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from identification.arrays import Array

RIDGE = 1e-9  # a plan that lacks one run may be singular; this part of the mean eigenvalue keeps the ranking right


class Criterion(Protocol):
    """A concave function Phi of the (p, p) scaled information matrix per run, M = sum_i w_i B_i^T B_i, sum w = 1.

    A singular M has the value -inf, not an error; `identification.information.log_determinants` says which are.
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

    def curvature(self, information: Array, directions: Array) -> Array:
        """(k, k) second derivative D^2 Phi(M)[X_a, X_b] for symmetric directions X (k, p, p); never positive."""
        ...

    def upper_bound(self, information: Array, largest: float) -> float:
        """No design has a greater value than this, given `largest` >= max_q tr(G B(q)^T B(q)) over the design space."""
        ...

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Fraction 0..1 of the runs that an optimal design would need for the same accuracy."""
        ...


def smooth(criterion: Criterion) -> Criterion:
    """What gradient methods climb instead of a criterion that is not smooth; the criterion itself if it is."""
    return getattr(criterion, "smooth", criterion)


def surrogate(criterion: Criterion) -> Criterion:
    """What many postures are compared by instead of a criterion that is slow to compute; itself if it is not."""
    return getattr(criterion, "surrogate", criterion)


def values_after_adding(criterion: Criterion, information: Array, jacobians: Array) -> Array:
    """(s, c) Phi(A_s + B_sc^T B_sc), but for a number that depends on s only: enough to choose a posture.

    information : (s, p, p) matrices A of plans that lack one run;  jacobians : (s, c, d, p) candidates for it
    A criterion may have a faster `values_after_adding` of its own (D: the determinant lemma).
    """
    own = getattr(criterion, "values_after_adding", None)
    if own is not None:
        return own(information, jacobians)
    return np.asarray(criterion.value(information[:, None] + np.swapaxes(jacobians, -1, -2) @ jacobians))


def curvature_factors(criterion: Criterion, information: Array) -> tuple[Array, Array] | None:
    """(p, p) symmetric L and R with D^2 Phi(M)[X, Y] = -tr(L X R Y), of criteria that have `curvature_factors`."""
    own = getattr(criterion, "curvature_factors", None)
    return None if own is None else own(information)


def ridged(information: Array) -> Array:
    """(..., p, p) the matrices, whose diagonals are about one, with a little added: they have an inverse."""
    p = information.shape[-1]
    ridge = RIDGE * (1e-3 + np.trace(information, axis1=-2, axis2=-1) / p)
    return np.asarray(information + ridge[..., None, None] * np.eye(p))
