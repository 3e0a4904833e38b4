"""Optimal weights on few postures: maximise Phi(M(w)), M(w) = sum_i w_i F_i, subject to w >= 0, sum w = 1.

*Interior point*, of second order and accurate to rounding. With g_i = tr(G F_i), G = dPhi/dM, and the slack
s_i = nu - g_i >= 0, w is optimal if and only if w_i s_i = 0 for all i (the equivalence theorem on these postures).
Newton's method on w_i s_i = mu, mu -> 0, takes some twenty steps, each one Cholesky factorisation of the size of the
support, to a gap of 1e-13. Accuracy here saves work elsewhere: at the optimum the sensitivity of the base model is a
sum of waves of separate joints, whose maximum is proven immediately.

*Multiplicative*, for very many parameters, to a gap of a percent: w_i <- w_i tr(G B_i^T B_i)^power, made to sum to one
(S. D. Silvey, D. M. Titterington, B. Torsney, 1978); the criterion never falls for D with power 1 and for A and I with
power 1/2 (Y. Yu, "Monotonic convergence of a general algorithm for computing optimal designs", Annals of Statistics 38,
2010). A step costs one pass over the postures, whatever the number of those that carry weight.

The relaxation as one convex program in cvxpy, with Clarabel or SCS: independent of column generation.

    maximise Phi(M),  M = sum_i w_i F_i,  w >= 0, sum w = 1

The textbook's V diag(w) V^T takes 1.2 GB at a thousand candidates. Here M is a variable, tied to the weights by as many
equations as the F_i have dimensions (13 for four links), after a change of coordinates in which the average posture has
the unit matrix.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import combinations_with_replacement
from types import MappingProxyType
from typing import Any

import numpy as np

from doe.criteria import Criterion
from doe.criteria.criterion import Factored, log_determinants, smooth
from doe.criteria.variances import InverseTrace
from doe.problem.problem import PriorInformation, Stop, never
from identification import Array, InputError, JobError
from identification.information import CLEAR, PRODUCT_TOLERANCE, significant
from identification.vectorize import PART

POWERS = {"D": 1.0, "A": 0.5, "I": 0.5}


def interior_point_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, tolerance: float = 1e-14
) -> tuple[Array, Array]:
    """Weights (k,) for scaled Jacobians (k, d, p), to a gap of `tolerance` times tr(G M) where rounding allows; and
    (p, p) G there."""
    from scipy.linalg import cho_factor, cho_solve  # 0.1 s to import

    def judged(w: Array) -> tuple[Array, Array]:
        """G and g."""
        gradient = criterion.gradient(prior.mixture(jacobians, w))
        return gradient, prior.sensitivities(jacobians, gradient)

    w = np.full(len(jacobians), 1.0 / len(jacobians))
    gradient, g = judged(w)
    nu = float(g.max()) + 0.1 * abs(float(w @ g))
    s = nu - g
    best, smallest, stalled = (w, gradient), np.inf, 0
    for _ in range(100):
        gap = float(g.max() - w @ g)
        stalled += 1
        if gap < 0.9 * smallest:
            best, smallest, stalled = (w, gradient), gap, 0
        if gap <= tolerance * abs(float(w @ g)) or stalled > 5:  # steps without a smaller gap: rounding is reached
            break
        curvature, mu, residual = (
            minus_hessian(jacobians, w, criterion, prior),
            0.1 * float(w @ s) / len(w),  # of the complementarity
            g + s - nu,
        )
        try:
            factor = cho_factor(curvature + np.diag(s / w), lower=True)
        except np.linalg.LinAlgError:  # indefinite by rounding, which happens when the gap is down to rounding too
            break
        right = cho_solve(factor, np.stack([mu / w - s + residual, np.ones(len(w))], axis=1))
        dnu = float(right[:, 0].sum() / right[:, 1].sum())
        dw = right[:, 0] - dnu * right[:, 1]
        ds = curvature @ dw + dnu - residual
        step = min(1.0, 0.99 * min(_to_boundary(w, dw), _to_boundary(s, ds)))
        w, s, nu = w + step * dw, s + step * ds, nu + step * dnu
        w = w / w.sum()
        gradient, g = judged(w)
    return best


def _to_boundary(values: Array, change: Array) -> float:
    falling = change < 0.0
    return float(np.min(-values[falling] / change[falling], initial=np.inf))


def minus_hessian(jacobians: Array, weights: Array, criterion: Criterion, prior: PriorInformation) -> Array:
    """(k, k) minus the Hessian of Phi with respect to the weights; with factors L and R sum c tr(L F_i R F_j),
    F = (B^T B + K) / (1 + k), without any F.

    tr(L B_i^T B_i R B_j^T B_j) is the scalar product of B_j L B_i^T and B_j R B_i^T: products of (k d, p) by (p, k d).
    """
    information = prior.mixture(jacobians, weights)
    if not isinstance(criterion, Factored):
        return -smooth(criterion).curvature(information, prior.posture_information(jacobians))
    k, d, _ = jacobians.shape
    total = np.zeros((k, k))
    for factor, left, right in criterion.curvature_factors(information):
        halves = [jacobians @ side for side in ([left] if right is left else [left, right])]
        for one, other in combinations_with_replacement(range(d), 2):
            products = [half[:, one] @ jacobians[:, other].T for half in halves]
            pairs = products[0] * products[-1]
            total += factor * (pairs if one == other else pairs + pairs.T)
        if not prior.empty:
            prior_part = left @ prior.total @ right
            each = np.einsum("kda,ab,kdb->k", jacobians, 0.5 * (prior_part + prior_part.T), jacobians, optimize=True)
            total += factor * (each[:, None] + each + np.sum(prior_part * prior.total))
    return np.asarray(total * prior.new_fraction**2)


def multiplicative_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, gap: float, stop: Stop = never
) -> Array:
    """(k,) weights for scaled Jacobians (k, d, p) from equal ones, until max tr(G F) is within `gap` of tr(G M)."""
    k, d, p = jacobians.shape
    parts = [jacobians[start : start + PART].reshape(-1, p) for start in range(0, k, PART)]
    weights = np.full(k, 1.0 / k)
    for _ in range(2000):
        information = prior.mixture(jacobians, weights)
        gradient = criterion.gradient(information)
        each = np.concatenate([np.einsum("ia,ia->i", rows @ gradient, rows) for rows in parts])
        each = each.reshape(k, d).sum(axis=1)
        if prior.mixed(each, gradient).max() <= (1.0 + gap) * float(np.sum(gradient * information)) or stop():
            break
        weights = weights * each ** POWERS[criterion.name]
        weights /= weights.sum()
    return weights


def proper_weights(weights: Array) -> Array:
    """A solver's weights made into a design: negative ones (rounding) to zero, sum to one.

    Raises InputError where nothing positive is left.
    """
    clipped = np.maximum(np.asarray(weights, dtype=float), 0.0)
    total = float(clipped.sum())
    if not np.isfinite(total) or total <= 0.0:
        raise InputError(f"weights: their sum is {total}, allowed: finite weights >= 0 that sum to one")
    return clipped / total


def sparsest(jacobians: Array, weights: Array) -> Array:
    """Weights (k,) of the same information matrix on at most p (p + 1) / 2 + 1 postures (Caratheodory).

    Along a combination c with sum c_i F_i = 0 and sum c_i = 0 the information does not change: follow it until a
    weight is zero, and again.
    """
    from scipy.linalg import null_space  # 0.1 s to import

    upper = np.triu_indices(jacobians.shape[2])
    support = np.flatnonzero(weights > 0.0)
    carried = jacobians[support]
    if clearly_independent(carried):
        return weights / weights.sum()
    posture_information = (np.swapaxes(carried, 1, 2) @ carried)[:, upper[0], upper[1]]
    w, alive = weights[support].copy(), np.ones(len(support), dtype=bool)
    nothing = null_space(
        np.vstack([posture_information.T / np.abs(posture_information).max(), np.ones(len(support))]),
        rcond=PRODUCT_TOLERANCE,
    )
    while nothing.shape[1]:
        direction = nothing[:, 0] if nothing[:, 0].min() < 0.0 else -nothing[:, 0]
        falling = np.flatnonzero(alive & (direction < 0.0))
        reach = -w[falling] / direction[falling]
        gone = falling[int(np.argmin(reach))]
        w = np.maximum(w + reach.min() * direction, 0.0)
        w[gone], alive[gone] = 0.0, False
        pivot = int(np.argmax(np.abs(nothing[gone])))  # combinations that leave the posture gone untouched
        others = np.delete(nothing, pivot, axis=1)
        nothing = others - np.outer(nothing[:, pivot], others[gone] / nothing[gone, pivot])
        nothing[~alive] = 0.0
    sparse = np.zeros_like(weights)
    sparse[support] = w / w.sum()
    return sparse


def clearly_independent(jacobians: Array) -> bool:
    """True where the F_i = B_i^T B_i of (k, d, p) are clearly independent: no combination of them is zero.

    Their scalar products are tr(F_i F_j) = |B_i B_j^T|^2 (Frobenius): a matrix of k, not of p (p + 1) / 2 rows, which
    holds half the digits; what is not clear by far is left to the singular values.
    """
    k, d, p = jacobians.shape
    rows = jacobians.reshape(k * d, p)
    products = np.square(rows @ rows.T).reshape(k, d, k, d).sum(axis=(1, 3))
    lengths = np.sqrt(np.diag(products))
    if not np.all(lengths > 0.0):
        return False
    return bool(np.linalg.eigvalsh(products / lengths / lengths[:, None])[0] > CLEAR)


# -- one convex program ------------------------------------------------------------------------------------------------
# Clarabel fails on some of these programs with its own scaling of the rows and on others without it
SETTINGS: Mapping[str, Sequence[Mapping[str, Any]]] = MappingProxyType(
    {
        "clarabel": ({"equilibrate_enable": False}, {}),
        "scs": ({"eps": 1e-8, "max_iters": 20_000},),
    }
)


def solve_program(
    posture_information: Array, criterion: Criterion, solver: str
) -> tuple[Array | None, str, Array | None]:
    """The solver's weights (N,) for F_i (N, p, p), None if it returned none; its own name for its status; and for E
    (p, p) G >= 0 of unit trace from the dual: any such G bounds the smallest eigenvalue, lambda_min(N) <= tr(G N)."""
    import cvxpy as cp

    mean = posture_information.mean(axis=0)
    if np.isneginf(log_determinants(mean)):
        raise JobError(
            "relaxation: the candidates do not identify all parameters; drop an effect or allow more postures"
        )
    unroot = np.linalg.cholesky(mean)
    root = np.linalg.inv(unroot)
    n, p = posture_information.shape[:2]
    rows, columns = np.triu_indices(p)
    entries = (root @ posture_information @ root.T)[:, rows, columns]
    # a basis of their span, and their coordinates in it, by the smaller of the two normal matrices
    if n < len(rows):
        values, vectors = np.linalg.eigh(entries @ entries.T)
        seen = significant(values, PRODUCT_TOLERANCE)
        lengths = np.sqrt(values[seen])
        basis, coordinates = entries.T @ (vectors[:, seen] / lengths), vectors[:, seen] * lengths
    else:
        values, vectors = np.linalg.eigh(entries.T @ entries)
        basis = vectors[:, significant(values, PRODUCT_TOLERANCE)]
        coordinates = entries @ basis
    square = np.zeros((p, p, basis.shape[1]))
    square[rows, columns], square[columns, rows] = basis, basis
    weights, place = cp.Variable(n, nonneg=True), cp.Variable(basis.shape[1])
    matrix = cp.reshape(square.reshape(p * p, -1) @ place, (p, p), order="C")
    tied, floor = [place == coordinates.T @ weights, cp.sum(weights) == 1.0], None
    if criterion.name == "D":
        objective = cp.log_det(matrix)
    elif isinstance(criterion, InverseTrace):
        values, vectors = np.linalg.eigh(criterion.weight(p))
        objective = -cp.matrix_frac(root @ (vectors * np.sqrt(np.maximum(values, 0.0))), matrix)
    elif criterion.name == "E":
        objective = cp.Variable()
        floor = matrix - objective * (root @ root.T) >> 0
        tied.append(floor)
    else:
        reason = f"{criterion.name} has no program for this solver"
        raise InputError(f"criterion: {reason}, allowed: D, A, I, E; column_generation knows more")
    status = _run(cp.Problem(cp.Maximize(objective), tied), solver)
    if weights.value is None or not np.all(np.isfinite(weights.value)):
        return None, status, None
    if floor is None:
        return np.asarray(weights.value), status, None
    values, vectors = np.linalg.eigh(root.T @ (floor.dual_value + floor.dual_value.T) @ root)
    positive = np.maximum(values, 0.0)
    return np.asarray(weights.value), status, (vectors * (positive / positive.sum())) @ vectors.T


def _run(program: Any, solver: str) -> str:
    import cvxpy as cp

    for settings in SETTINGS[solver]:
        with warnings.catch_warnings(), suppress(cp.error.SolverError):
            warnings.simplefilter("ignore")  # what cvxpy warns of is the status, which is reported
            program.solve(solver=solver.upper(), **settings)
            return str(program.status)
    return "solver_error"
