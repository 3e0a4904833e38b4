"""Optimal weights on few postures: maximise Phi(M(w)), M(w) = sum_i w_i F_i, subject to w >= 0, sum w = 1.

*Interior point*, of second order and accurate to rounding. With g_i = tr(G F_i), G = dPhi/dM, and the slack
s_i = nu - g_i >= 0, w is optimal if and only if w_i s_i = 0 for all i (the equivalence theorem on these postures).
Newton's method on w_i s_i = mu, mu -> 0, takes some twenty steps, each one Cholesky factorisation of the size of the
support, to a gap of 1e-13. Accuracy here saves work elsewhere: at the optimum the sensitivity of the base model is a
sum of waves of separate joints, whose maximum is proven immediately.

*Multiplicative*, for hundreds of parameters, to a gap of a percent: w_i <- w_i tr(G B_i^T B_i)^power, made to sum to
one (S. D. Silvey, D. M. Titterington, B. Torsney, 1978); the criterion never falls for D with power 1 and for A and I
with power 1/2 (Y. Yu, Annals of Statistics 38, 2010). A step costs one pass over the postures.

*One convex program* in cvxpy with Clarabel or SCS, independent of all else. The textbook's V diag(w) V^T takes 1.2 GB
at a thousand candidates. Here M is a variable, tied to the weights by as many equations as the F_i have dimensions (13
for four links), after a change of coordinates in which the average posture has the unit matrix.
"""

import warnings
from contextlib import suppress
from typing import Any

import numpy as np

from doe.criteria import A, Criterion, log_determinants
from doe.problem.problem import PriorInformation, Stop, information_of_each, never
from identification import Array, InputError, JobError, spectrum

EXACT = 1e-14  # gap of the weights: rounding
# of each solver, tried in turn: Clarabel fails on some programs with its own scaling of the rows, on others without it
SETTINGS: dict[str, tuple[dict[str, Any], ...]] = {
    "clarabel": ({"equilibrate_enable": False}, {}),
    "scs": ({"eps": 1e-8, "max_iters": 20_000},),
}


def optimal_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, accuracy: float = EXACT, stop: Stop = never
) -> tuple[Array, Array]:
    """Weights (k,) for scaled Jacobians (k, d, p), and (p, p) G there, by the method that criterion and gap allow."""
    if criterion.name == "E":  # no gradient of its own: that of the dual
        on_support, status, dual = solve_program(prior.information(information_of_each(jacobians)), criterion)
        if on_support is None or dual is None:
            raise JobError(f"clarabel: status {status} on the restricted master of {len(jacobians)} postures")
        return on_support, dual
    if accuracy < 1e-2:
        return interior_point_weights(jacobians, criterion, prior, accuracy)
    # multiplicative, until max tr(G F) is within `accuracy` of tr(G M)
    weights, rows = np.full(len(jacobians), 1.0 / len(jacobians)), jacobians.reshape(-1, jacobians.shape[2])
    power = 1.0 if criterion.power == 0 else 0.5
    for _ in range(2000):
        information = prior.mixture(jacobians, weights)
        gradient = criterion.gradient(information)
        each = np.einsum("ia,ia->i", rows @ gradient, rows).reshape(len(jacobians), -1).sum(axis=1)
        if prior.mixed(each, gradient).max() <= (1.0 + accuracy) * float(np.sum(gradient * information)) or stop():
            break
        weights = weights * each**power
        weights /= weights.sum()
    return np.where(weights > 1e-6 * weights.max(), weights, 0.0), gradient  # the others are left out


def interior_point_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, tolerance: float = EXACT
) -> tuple[Array, Array]:
    """Weights (k,) for scaled Jacobians (k, d, p), to a gap of `tolerance` times tr(G M) where rounding allows; and
    (p, p) G there."""
    from scipy.linalg import cho_factor, cho_solve  # 0.1 s to import

    def judged(w: Array) -> tuple[Array, Array]:
        """G and g."""
        gradient = criterion.gradient(prior.mixture(jacobians, w))
        return gradient, prior.sensitivities(jacobians, gradient)

    def to_boundary(values: Array, change: Array) -> float:
        falling = change < 0.0
        return float(np.min(-values[falling] / change[falling], initial=np.inf))

    each, w = prior.information(information_of_each(jacobians)), np.full(len(jacobians), 1.0 / len(jacobians))
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
        curvature = -criterion.smooth.curvature(prior.mixture(jacobians, w), each)
        mu, residual = 0.1 * float(w @ s) / len(w), g + s - nu  # of the complementarity
        try:
            factor = cho_factor(curvature + np.diag(s / w), lower=True)
        except np.linalg.LinAlgError:  # indefinite by rounding, which happens when the gap is down to rounding too
            break
        right = cho_solve(factor, np.stack([mu / w - s + residual, np.ones(len(w))], axis=1))
        dnu = float(right[:, 0].sum() / right[:, 1].sum())
        dw = right[:, 0] - dnu * right[:, 1]
        ds = curvature @ dw + dnu - residual
        step = min(1.0, 0.99 * min(to_boundary(w, dw), to_boundary(s, ds)))
        w, s, nu = w + step * dw, s + step * ds, nu + step * dnu
        w = w / w.sum()
        gradient, g = judged(w)
    return best


def sparsest(jacobians: Array, weights: Array) -> Array:
    """Weights (k,) of the same information matrix on as few postures as the F_i have dimensions (Caratheodory): of
    nonnegative least squares, whose active set is independent. Large problems stay as they are."""
    from scipy.optimize import nnls  # 0.1 s to import

    weights = np.where(weights > 1e-10, weights, 0.0)  # less is as good as none
    support, upper = np.flatnonzero(weights), np.triu_indices(jacobians.shape[2])
    if len(support) * len(upper[0]) > 300_000:
        return weights / weights.sum()
    entries = information_of_each(jacobians[support])[:, upper[0], upper[1]]
    equations = np.vstack([entries.T / np.abs(entries).max(), np.ones(len(support))])
    sparse, right = np.zeros_like(weights), equations @ weights[support]
    with suppress(RuntimeError):  # of equations that are nearly dependent it may find no end
        sparse[support], left = nnls(equations, right)
        if left <= 1e-13 * np.linalg.norm(right):
            return sparse / sparse.sum()
    return weights / weights.sum()


def solve_program(
    posture_information: Array, criterion: Criterion, solver: str = "clarabel"
) -> tuple[Array | None, str, Array | None]:
    """A solver's weights (N,) for F_i (N, p, p), None if it returned none; its own name for its status; and for E
    (p, p) G >= 0 of unit trace from the dual: any such G bounds the smallest eigenvalue, lambda_min(N) <= tr(G N)."""
    import cvxpy as cp

    mean = posture_information.mean(axis=0)
    if np.isneginf(log_determinants(mean)):
        raise JobError(
            "relaxation: the candidates do not identify all parameters; drop an effect or allow more postures"
        )
    root = np.linalg.inv(np.linalg.cholesky(mean))
    n, p = posture_information.shape[:2]
    rows, columns = np.triu_indices(p)
    entries = (root @ posture_information @ root.T)[:, rows, columns]
    span = spectrum(entries, np.ones(len(rows)))
    directions = span.directions[:, : span.rank]
    basis, coordinates = span.lengths[:, None] * directions, (entries / span.lengths) @ directions
    square = np.zeros((p, p, basis.shape[1]))
    square[rows, columns], square[columns, rows] = basis, basis
    weights, place = cp.Variable(n, nonneg=True), cp.Variable(basis.shape[1])
    matrix = cp.reshape(square.reshape(p * p, -1) @ place, (p, p), order="C")
    tied, floor = [place == coordinates.T @ weights, cp.sum(weights) == 1.0], None
    if criterion.name == "D":
        objective = cp.log_det(matrix)
    elif isinstance(criterion, A):
        values, vectors = np.linalg.eigh(criterion.weight(p))
        objective = -cp.matrix_frac(root @ (vectors * np.sqrt(np.maximum(values, 0.0))), matrix)
    elif criterion.name == "E":
        objective = cp.Variable()
        # in units of the mean's smallest eigenvalue
        floor = matrix - objective * (root @ root.T / np.linalg.norm(root, 2) ** 2) >> 0
        tied.append(floor)
    else:
        reason = f"{criterion.name} has no program for this solver"
        raise InputError(f"criterion: {reason}, allowed: D, A, I, E; column_generation knows more")
    program, status = cp.Problem(cp.Maximize(objective), tied), "solver_error"
    for settings in SETTINGS[solver]:
        with warnings.catch_warnings(), suppress(cp.error.SolverError):
            warnings.simplefilter("ignore")  # what cvxpy warns of is the status, which is reported
            program.solve(solver=solver.upper(), **settings)
            status = str(program.status)
            break
    found = np.maximum(np.zeros(n) if weights.value is None else weights.value, 0.0)  # rounding leaves negative ones
    if not 0.0 < found.sum() < np.inf:
        return None, status, None
    found = found / found.sum()
    if floor is None:
        return found, status, None
    values, vectors = np.linalg.eigh(root.T @ (floor.dual_value + floor.dual_value.T) @ root)
    positive = np.maximum(values, 0.0)
    return found, status, (vectors * (positive / positive.sum())) @ vectors.T
