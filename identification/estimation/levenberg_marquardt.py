"""Levenberg-Marquardt for many nonlinear least-squares problems at once, with bounds.

    min |r_k(x)|^2  subject to  lower <= x <= upper,     k = 1 .. K

Each step solves min |E s - r|^2 + damping |s|^2 over the columns E of the exact Jacobian, scaled to unit length
(Marquardt 1963), undamped until one lowers |r|^2 by far less than predicted; then the damping is in proportion to how
stiff the direction of the step is, however flat the valley. Every problem has its own damping.
Parameters on a bound that the gradient or the step would leave on the wrong side are held (active set; without the
step's, a cut step need not descend); what a step takes beyond a bound from inside is cut off there. Combinations of
parameters that the data do not determine get no step: singular values below `tolerance` are zero
(`information.significant`).

Tall problems are made small by QR first (`compressed`): the triangular factor has all that a step needs. Orthogonal
transformations change neither sums of squares nor products of columns, and least squares see nothing else (A. Bjorck,
"Numerical Methods for Least Squares Problems", 1996, section 2.4).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.information import CLEAR, RANK_TOLERANCE, column_lengths, significant
from identification.status import Status

GRADIENT_TOLERANCE = 1e-9  # stationary: no column of the Jacobian has a cosine with the residuals above this
ITERATIONS = 200
SMALL_FALL = 1e-8  # of a sum of squares, relative
RIDGE = 1e-14  # of a normal matrix of unit columns: keeps its inverse alive where it is singular and not used
VANISHED = 1e-4  # of the length that a column had at the start: its parameter has no effect to speak of
MANY = 100  # parameters of one problem: singular values then take several times as long as a triangle
BLOCK = 2048  # rows at a time, which stay in the processor's cache
Index = NDArray[np.intp]
Linearize = Callable[[Array, Index], tuple[Array, Array]]


@dataclass(frozen=True)
class LeastSquares:
    """K problems with the same numbers of equations N and parameters p.

    linearize : parameters (k, p) of the problems numbered (k,) -> residuals (k, N), measured less computed, and the
        Jacobian (k, N, p) of what is computed; both may be weighted or whitened
    lower, upper : (p,) bounds
    scales : (p,) what one unit of each parameter moves, see `information.column_lengths`
    rounding : (K,) norm of residuals that are nothing but rounding
    tolerance : singular values of unit columns below this share of the largest are zero
    metric : (p,) what a step's components are multiplied by where its length counts (damping, and the shortest of
        many); None: the lengths of the Jacobian's columns
    iterations : most steps, rejected ones included
    """

    linearize: Linearize
    lower: Array
    upper: Array
    scales: Array
    rounding: Array
    tolerance: float = RANK_TOLERANCE
    metric: Array | None = None
    iterations: int = ITERATIONS


class Points(NamedTuple):
    """State of k searches; the problems by their numbers."""

    problems: Index  # (k,)
    parameters: Array  # (k, p)
    residuals: Array  # (k, N)
    jacobians: Array  # (k, N, p)
    squares: Array  # (k,)
    damping: Array  # (k,)

    def at(self, rows: NDArray[np.bool_]) -> Points:
        """Some of them."""
        return self if rows.all() else Points._make(array[rows] for array in self)


@dataclass(frozen=True, eq=False)
class Solution:
    """Ends of K searches.

    parameters : (K, p);  squares : (K,) sums of squared residuals;  active : (K, p) True where a bound is active
    status : (K,) of `Status`: converged; almost_solved where rounding or a flat valley ended the search;
        iteration_limit; solver_failed where the residuals at the start are not finite
    iterations : (K,) steps, rejected ones included
    """

    parameters: Array
    squares: Array
    active: NDArray[np.bool_]
    status: NDArray[np.object_]
    iterations: Index

    def record(self, points: Points, active: NDArray[np.bool_], status: NDArray[np.object_], iteration: int) -> None:
        """Store the results of some searches, where they are lower than those that are there."""
        self.iterations[points.problems] += iteration
        lower = points.squares < (1.0 - SMALL_FALL) * self.squares[points.problems]
        rows = points.problems[lower]
        self.parameters[rows], self.squares[rows] = points.parameters[lower], points.squares[lower]
        self.active[rows], self.status[rows] = active[lower], status[lower]


def compressed(residuals: Array, jacobians: Array) -> tuple[Array, Array]:
    """Residuals (k, q) and Jacobians (k, q, p), q = p + 1, of the same least-squares problems as tall (k, N) and
    (k, N, p); those that are not tall as they are."""
    rows = jacobians.shape[1]
    # from 20 rows per column the triangle pays: a step passes over the rows some ten times
    if rows < 20 * (jacobians.shape[2] + 1):
        return residuals, jacobians
    triangles = []
    for residual, jacobian in zip(residuals, jacobians, strict=True):
        parts = [slice(start, start + BLOCK) for start in range(0, rows, BLOCK)]
        parts_made = [np.linalg.qr(np.column_stack([jacobian[k], residual[k]]), mode="r") for k in parts]
        triangles.append(parts_made[0] if len(parts) == 1 else np.linalg.qr(np.concatenate(parts_made), mode="r"))
    triangle = np.array(triangles)
    return triangle[:, :, -1], triangle[:, :, :-1]


def levenberg_marquardt(problem: LeastSquares, starts: Array) -> Solution:
    """Stationary points of K problems from starts (K, p), which are moved inside the bounds first.

    Where a search ends with columns of the Jacobian that have vanished (a factor that is zero, on its bound say, leaves
    the other without effect), the point is stationary and may yet be no minimum: the search goes on from where those
    parameters make another one descend, see `_revived`.
    """
    count, p = starts.shape
    x = np.clip(starts, problem.lower, problem.upper)
    every = np.arange(count)
    residuals, jacobians = problem.linearize(x, every)
    points = Points(every, x, residuals, jacobians, _squares(residuals), np.zeros(count))
    failed, squares = np.full(count, Status.solver_failed, dtype=object), points.squares.copy()
    points = points.at(np.isfinite(squares))
    squares[points.problems] = np.inf  # until a search has ended
    solution = Solution(x.copy(), squares, np.zeros((count, p), dtype=bool), failed, np.zeros(count, int))
    lengths = np.sqrt(np.einsum("knp,knp->kp", jacobians, jacobians))
    while len(points.problems):
        before = solution.squares.copy()
        ended = _search(problem, points, solution)
        points = _revived(problem, ended.at(solution.squares[ended.problems] < before[ended.problems]), lengths)
    return solution


def _search(problem: LeastSquares, points: Points, solution: Solution) -> Points:
    """Where searches from these points end, recorded in the solution."""
    ends = []
    for iteration in range(problem.iterations):
        steps, stationary, active, _, stiffness = _steps(problem, points)
        ended = stationary | (points.damping > 1e12)
        status = outcomes(stationary[ended], Status.converged, Status.almost_solved)
        solution.record(points.at(ended), active[ended], status, iteration)
        ends.append(points.at(ended))
        points = points.at(~ended)
        if len(points.problems) == 0:
            break
        points = _moved(problem, points, steps[~ended], stiffness[~ended])
    else:
        # a flat curved valley (nearly undetermined combination, few rows) is left slowly: what is missing is far below
        # its standard deviation
        _, _, active, explained, _ = _steps(problem, points._replace(damping=np.zeros(len(points.problems))))
        # share of the residuals that the last step would still explain: 1e-4 sqrt(N) standard deviations
        status = outcomes(explained <= 1e-4, Status.almost_solved, Status.iteration_limit)
        solution.record(points, active, status, problem.iterations)
        ends.append(points)
    return Points._make(np.concatenate(arrays) for arrays in zip(*ends, strict=True))


def _revived(problem: LeastSquares, points: Points, lengths: Array) -> Points:
    """Of searches that ended, those with parameters that have no effect there: moved along these, within the bounds, to
    where the gradient of one parameter is the largest that leads inside.

    lengths : (K, p) of the Jacobian's columns at the start

    Second derivatives by differences of the gradient; the gradient is exactly linear in the factors of a product.
    """
    void = np.sqrt(np.einsum("knp,knp->kp", points.jacobians, points.jacobians)) <= VANISHED * lengths[points.problems]
    void &= problem.lower < problem.upper
    points, void = points.at(stuck := void.any(axis=1)), void[stuck]
    if not len(points.problems):
        return points
    x, (search, column) = points.parameters, np.nonzero(void)
    up, down = problem.upper - x, x - problem.lower
    size = np.maximum(np.abs(x), 1.0 / problem.scales)
    above, below = (np.minimum(room, size)[search, column, None] for room in (up, down))  # of each void parameter
    step = np.where(above >= below, above, -below)
    tried = x[search]
    tried[np.arange(len(search)), column] += step[:, 0]
    # one at a time: a problem is asked for one point
    parts = [problem.linearize(tried[k : k + 1], points.problems[search[k : k + 1]]) for k in range(len(search))]
    residuals, jacobians = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    gradient, tried_gradient = (
        np.einsum("knp,kn->kp", *pair) for pair in ((points.jacobians, points.residuals), (jacobians, residuals))
    )
    change = tried_gradient - gradient[search]
    sizes = np.sqrt(np.einsum("knp,knp->kp", jacobians, jacobians))
    in_mm = np.abs(change) / problem.scales
    small = in_mm <= VANISHED * np.max(in_mm, axis=1, keepdims=True)
    change[small | (np.abs(change) <= GRADIENT_TOLERANCE * sizes * np.sqrt(_squares(residuals))[:, None])] = 0.0
    bend = change / step
    moves, slopes = [], []
    for sign, room in ((1.0, up), (-1.0, down)):
        # (void parameters, p) for the gradient of each parameter
        along = np.where(bend == 0.0, 0.0, np.where(sign * bend > 0.0, above, -below))
        slope = sign * gradient
        np.add.at(slope, search, sign * along * bend)
        # that parameter, too, where it has no effect of its own: at a ratio far from 1 both would return to zero
        each = np.arange(len(search)), column
        aside = (above if sign > 0.0 else -below)[:, 0]
        along[each] = np.where(bend[each] == 0.0, aside, along[each])
        moves.append(along)
        slopes.append(np.where(room > 0.0, slope / problem.scales, 0.0))
    best = np.argmax(np.concatenate(slopes, axis=1), axis=1)
    moved = x.copy()
    moved[search, column] += np.concatenate(moves, axis=1)[np.arange(len(search)), best[search]]
    moved = np.clip(moved, problem.lower, problem.upper)
    descends = (np.max(np.concatenate(slopes, axis=1), axis=1) > 0.0) & np.any(moved != x, axis=1)
    points, moved = points.at(descends), moved[descends]
    if not len(moved):
        return points
    residuals, jacobians = problem.linearize(moved, points.problems)
    return Points(points.problems, moved, residuals, jacobians, _squares(residuals), np.zeros(len(moved)))


def outcomes(condition: NDArray[np.bool_], status: Status, other: Status) -> NDArray[np.object_]:
    """(k,) of `Status`: one where the condition holds, the other elsewhere."""
    return np.array([other, status], dtype=object)[condition.astype(int)]


def _squares(residuals: Array) -> Array:
    return np.einsum("kn,kn->k", residuals, residuals)


def _steps(problem: LeastSquares, points: Points) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_], Array, Array]:
    """(k, p) damped steps inside the bounds; (k,) stationary; (k, p) active bounds; (k,) share of the residuals' norm
    that a step explains; (k,) stiffness, see `damped_steps`."""
    x, damping, norms = points.parameters, points.damping, np.sqrt(points.squares)
    sizes = np.sqrt(np.einsum("knp,knp->kp", points.jacobians, points.jacobians))
    lengths, zero = column_lengths(sizes, problem.scales)
    if problem.metric is not None:
        lengths = np.broadcast_to(problem.metric, lengths.shape)
    columns = points.jacobians / lengths[:, None, :]
    gradient = (np.swapaxes(columns, 1, 2) @ points.residuals[:, :, None])[:, :, 0]
    low, high = x <= problem.lower, x >= problem.upper
    held = (low & (gradient < 0.0)) | (high & (gradient > 0.0))
    steps, gradient, stiffness = damped_steps(columns, points.residuals, held | zero, damping, problem.tolerance)
    limit = GRADIENT_TOLERANCE * norms + problem.rounding[points.problems]
    stationary = np.max(np.abs(gradient), axis=1, initial=0.0) <= limit
    while np.any(out := (low & (steps < 0.0) | high & (steps > 0.0)) & ~stationary[:, None]):
        held |= out
        again = np.any(out, axis=1)
        steps[again], gradient[again], stiffness[again] = damped_steps(
            columns[again], points.residuals[again], (held | zero)[again], damping[again], problem.tolerance
        )
    explained = np.sqrt(np.maximum(np.sum(gradient * steps, axis=1), 0.0)) / np.maximum(norms, np.finfo(float).tiny)
    return steps / lengths, stationary, held, explained, stiffness


def damped_steps(
    columns: Array, residuals: Array, held: NDArray[np.bool_], damping: Array, tolerance: float
) -> tuple[Array, Array, Array]:
    """(k, p) minimisers s of |E s - r|^2 + damping |s|^2, zero where held; gradients E^T r; and (k,) the stiffness
    |s|^2 / s^T (E^T E + damping)^-1 s, an eigenvalue of that matrix if s is an eigenvector: times c, and added to the
    damping, it makes s about 1 / (1 + c) times as long.

    Of `MANY` parameters by the triangle of E, else by the smaller of the normal matrices E^T E and E E^T, which square
    the condition, where that costs no digits that matter; elsewhere by singular values, of which those below
    `tolerance` are zero, in step and gradient.
    """
    columns = np.where(held[:, None, :], 0.0, columns) if held.any() else columns
    across = np.swapaxes(columns, 1, 2)
    gradient = (across @ residuals[:, :, None])[:, :, 0]
    if columns.shape[2] >= MANY and len(columns) == 1:
        regular = _by_triangle(columns[0][:, ~held[0]], residuals[0], float(damping[0]), tolerance)
        if regular is not None:
            steps, softer = np.zeros((2, *held.shape))
            steps[~held], softer[~held] = regular
            return steps, gradient, _stiffness(steps, softer)
    wide = columns.shape[1] < columns.shape[2]
    normal = columns @ across if wide else across @ columns
    diagonal = np.arange(normal.shape[1])
    normal[:, diagonal, diagonal] += RIDGE if wide else RIDGE + held
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:  # one of them has a pivot that is exactly zero
        steps, gradient, stiffness = truncated_steps(columns, residuals, damping, tolerance)
        return np.where(held, 0.0, steps), gradient, stiffness
    # in the 1-norm, which is never less than the ratio of the eigenvalues
    condition = np.linalg.norm(normal, 1, axis=(1, 2)) * np.linalg.norm(inverse, 1, axis=(1, 2))
    if (damped := damping > 0.0).any():
        inverse[damped] = np.linalg.inv(normal[damped] + damping[damped, None, None] * np.eye(len(diagonal)))
    once = inverse @ (residuals if wide else gradient)[:, :, None]
    steps, softer = ((across @ a if wide else a)[:, :, 0] for a in (once, inverse @ once))
    stiffness = _stiffness(steps, softer)
    rest = ~(condition < min(1.0 / CLEAR, tolerance**-2))
    if rest.any():
        truncated = truncated_steps(columns[rest], residuals[rest], damping[rest], tolerance)
        steps[rest], gradient[rest], stiffness[rest] = truncated
    return np.where(held, 0.0, steps), gradient, stiffness


def _by_triangle(columns: Array, residual: Array, damping: float, tolerance: float) -> tuple[Array, Array] | None:
    """(p,) minimiser s of |E s - r|^2 + damping |s|^2 of columns (N, p), and (E^T E + damping)^-1 s. None where a
    singular value may be below `tolerance` times the largest: the norms of triangle and inverse bound their ratio."""
    p = columns.shape[1]
    triangle = np.asarray(np.linalg.qr(np.column_stack([columns, residual]), mode="r"))
    if len(triangle) < p:
        return None
    try:
        inverse = np.linalg.inv(triangle[:p, :p])
        if not np.linalg.norm(triangle[:p, :p]) * np.linalg.norm(inverse) < 1.0 / tolerance:
            return None
        if damping > 0.0:
            damped = np.concatenate([triangle[:p], np.sqrt(damping) * np.eye(p, p + 1)])
            triangle = np.asarray(np.linalg.qr(damped, mode="r"))
            inverse = np.linalg.inv(triangle[:p, :p])
    except np.linalg.LinAlgError:
        return None
    step = inverse @ triangle[:p, p]
    return step, inverse @ (inverse.T @ step)


def truncated_steps(columns: Array, residuals: Array, damping: Array, tolerance: float) -> tuple[Array, Array, Array]:
    """`damped_steps` by singular values."""
    # the triangle of [E, r] holds all that the step needs; rows can be millions, columns are few
    triangle: Array = np.linalg.qr(np.concatenate([columns, residuals[:, :, None]], axis=2), mode="r")  # type: ignore[assignment]
    left, values, right = np.linalg.svd(triangle[:, :, :-1], full_matrices=False)
    rotated = (np.swapaxes(left, 1, 2) @ triangle[:, :, -1:])[:, :, 0]
    count = significant(values, tolerance)
    squares = np.where(count, values**2 + damping[:, None], 1.0)
    factors = np.where(count, values, 0.0) / squares * rotated
    directions = np.swapaxes(right, 1, 2)
    steps = directions @ factors[:, :, None]
    gradient = directions @ np.where(count, values * rotated, 0.0)[:, :, None]
    return steps[:, :, 0], gradient[:, :, 0], _stiffness(factors, factors / squares)


def _stiffness(steps: Array, softer: Array) -> Array:
    """(k,) |s|^2 / s^T N^-1 s of steps s and N^-1 s; 0 where nothing moves."""
    lengths, softness = np.sum(steps**2, axis=1), np.sum(steps * softer, axis=1)
    return np.divide(lengths, softness, out=np.zeros_like(lengths), where=softness > 0.0)


def _moved(problem: LeastSquares, points: Points, steps: Array, stiffness: Array) -> Points:
    """The points after their steps, where those descend; elsewhere as before."""
    trial = np.clip(points.parameters + steps, problem.lower, problem.upper)
    residuals, jacobians = problem.linearize(trial, points.problems)
    squares = _squares(residuals)
    # rounding of residuals and of their sum may hide the descent of the last steps
    allowance = 2.0 * np.sqrt(points.squares) * problem.rounding[points.problems] + 1e-14 * points.squares
    better = squares <= points.squares + allowance
    moved = Points(points.problems, trial, residuals, jacobians, squares, points.damping)
    damping = _next_damping(points, moved, better, stiffness)
    moved = moved._replace(damping=damping)
    if better.all():
        return moved
    before = points._replace(damping=damping)
    return Points._make(
        np.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(moved, before, strict=True)
    )


def _next_damping(before: Points, after: Points, better: NDArray[np.bool_], stiffness: Array) -> Array:
    """(k,) the damping with which the step would have ended at the minimum of a parabola along it (Hebden 1973).

    No more than before where the sum of squares falls nearly as the linear model predicts; where it falls by less than
    a quarter of that, so much that a step half as long at most comes next (More 1978).
    """
    step = (after.parameters - before.parameters)[:, :, None]
    with np.errstate(over="ignore", invalid="ignore"):  # a step may lead to where nothing is finite
        change, change_after = ((points.jacobians @ step)[:, :, 0] for points in (before, after))
        slope = np.einsum("kn,kn->k", change, before.residuals)
        predicted = before.squares - _squares(before.residuals - change)
        # a small fall drowns in rounding; the slopes at both ends of the step do not (trapezoidal rule)
        slopes = slope + np.einsum("kn,kn->k", change_after, after.residuals)
        fall = np.where(predicted > SMALL_FALL * before.squares, before.squares - after.squares, slopes)
        share = slope / np.maximum(2.0 * slope - fall, np.finfo(float).tiny)
    good = better & (fall >= np.where(before.damping > 0.0, 0.75, 0.25) * predicted)
    poor = ~(better & (fall >= 0.25 * predicted))
    # of the step's length; at least a tenth where it failed
    share = np.clip(np.where(np.isfinite(fall), share, 0.0), np.where(good, 1.0, 0.1), np.where(poor, 0.5, np.inf))
    damping = np.maximum(before.damping + (1.0 / share - 1.0) * stiffness, before.damping / 10.0)
    return np.where(damping > 0.1 * (stiffness - before.damping), damping, 0.0)  # less is none
