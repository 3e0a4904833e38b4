"""Optimal weights on few postures: a primal-dual interior-point method of second order, accurate to rounding.

    maximise Phi(M(w)),  M(w) = sum_i w_i F_i,  subject to  w >= 0, sum w = 1

With g_i = tr(G F_i), G = dPhi/dM, and the slack s_i = nu - g_i >= 0, w is optimal if and only if w_i s_i = 0 for all i
(the equivalence theorem on these postures). Newton's method on w_i s_i = mu, mu -> 0, takes some twenty steps, each one
Cholesky factorisation of the size of the support, to a gap of 1e-13. Accuracy here saves work elsewhere: at the optimum
the sensitivity of the base model is a sum of waves of separate joints, whose maximum is proven immediately.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import numpy as np

from doe.bounds.weights import Weights
from doe.criteria import Criterion
from doe.criteria.criterion import curvature_factors
from doe.problem.prior import PriorInformation
from identification.arrays import Array

ITERATIONS = 100
FRACTION = 0.99  # of the way to the boundary w = 0, s = 0
SHRINK = 0.1  # of the complementarity asked for per step
STALLS = 5  # steps without a smaller gap: rounding is reached


def solve_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, *, tolerance: float = 1e-14
) -> Weights:
    """Optimal weights for scaled Jacobians (k, d, p), to a gap of `tolerance` times tr(G M) where rounding allows."""
    k = len(jacobians)
    w = np.full(k, 1.0 / k)
    gradient = criterion.gradient(prior.mixture(jacobians, w))
    g = prior.sensitivities(jacobians, gradient)
    level = float(w @ g)
    nu = float(g.max()) + 0.1 * abs(level)
    s = nu - g
    best, stalled = Weights(w, gradient, np.inf, 0), 0
    for iteration in range(ITERATIONS):
        gap = float(g.max() - w @ g)
        best, stalled = (Weights(w, gradient, gap, iteration), 0) if gap < 0.9 * best.gap else (best, stalled + 1)
        if gap <= tolerance * abs(level) or stalled > STALLS:
            break
        change = _newton(_curvature(jacobians, w, criterion, prior), w, s, g + s - nu)
        if change is None:
            break
        dw, ds, dnu = change
        step = min(1.0, FRACTION * _to_boundary(w, dw), FRACTION * _to_boundary(s, ds))
        w, s, nu = w + step * dw, s + step * ds, nu + step * dnu
        w = w / w.sum()
        gradient = criterion.gradient(prior.mixture(jacobians, w))
        g = prior.sensitivities(jacobians, gradient)
        level = float(w @ g)
    return best


def _newton(curvature: Array, w: Array, s: Array, residual: Array) -> tuple[Array, Array, float] | None:
    """Step (dw, ds, dnu) towards w s = mu with sum dw = 0; `curvature` (k, k) is minus the Hessian of Phi.

    None where rounding has made the matrix indefinite, which happens when the gap is down to rounding too.
    """
    from scipy.linalg import cho_factor, cho_solve  # 0.1 s to import

    mu = SHRINK * float(w @ s) / len(w)
    try:
        factor = cho_factor(curvature + np.diag(s / w), lower=True)
    except np.linalg.LinAlgError:
        return None
    right = cho_solve(factor, np.stack([mu / w - s + residual, np.ones(len(w))], axis=1))
    dnu = float(right[:, 0].sum() / right[:, 1].sum())
    dw = right[:, 0] - dnu * right[:, 1]
    return dw, curvature @ dw + dnu - residual, dnu


def _to_boundary(values: Array, change: Array) -> float:
    falling = change < 0.0
    return float(np.min(-values[falling] / change[falling], initial=np.inf))


def _curvature(jacobians: Array, weights: Array, criterion: Criterion, prior: PriorInformation) -> Array:
    """(k, k) minus the Hessian of Phi with respect to the weights."""
    information = prior.mixture(jacobians, weights)
    if (factors := curvature_factors(criterion, information)) is None:
        return -criterion.curvature(information, prior.posture_information(jacobians))
    return paired(*factors, jacobians, prior)


def paired(left: Array, right: Array, jacobians: Array, prior: PriorInformation) -> Array:
    """(k, k) tr(L F_i R F_j), F = (B^T B + K) / (1 + k), without any F: products of (k d, p) by (p, k d).

    tr(L B_i^T B_i R B_j^T B_j) is the scalar product of B_j L B_i^T and B_j R B_i^T.
    """
    k, d, _ = jacobians.shape
    halves = [jacobians @ side for side in ([left] if right is left else [left, right])]
    pairs = np.zeros((k, k))
    for one, other in combinations_with_replacement(range(d), 2):
        products = [half[:, one] @ jacobians[:, other].T for half in halves]
        both = products[0] * products[-1]
        pairs += both if one == other else both + both.T
    if prior.empty:
        return np.asarray(pairs)
    known = left @ prior.total @ right
    each = np.einsum("kda,ab,kdb->k", jacobians, 0.5 * (known + known.T), jacobians, optimize=True)
    pairs += each[:, None] + each + np.sum(known * prior.total)
    return np.asarray(pairs * prior.new_fraction**2)
