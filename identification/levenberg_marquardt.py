"""Levenberg-Marquardt for many nonlinear least-squares problems at once, with bounds.

    min |r_k(x)|^2  subject to  lower <= x <= upper,     k = 1 .. K

Each step solves min |E s - r|^2 + damping |s|^2 over the columns E of the exact Jacobian, scaled to unit length
(Marquardt 1963), undamped until one lowers |r|^2 by far less than predicted; then the damping is in proportion to how
stiff the direction of the step is, however flat the valley. Parameters on a bound that the gradient or the step would
leave on the wrong side are held (without the step's, a cut step need not descend); what a step takes beyond a bound
from inside is cut off there. Combinations of parameters that the data do not determine get no step.

Along a curved valley steps that must not climb its walls are as short as these are steep. A search that takes long
tries undamped steps again, and may climb by one where the next one makes up for it (R. M. Chamberlain et al., "The
watchdog technique for forcing convergence", 1982).

Beside it Newton's method, from many starts at once, for local maxima of a function of joint positions within limits.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.information import RANK_TOLERANCE, column_lengths, significant
from identification.running import Status

GRADIENT_TOLERANCE = 1e-9  # stationary: no column of the Jacobian has a cosine with the residuals above this
ITERATIONS = 200
PATIENCE = 16  # steps, more than most searches take: one that goes on is in a curved valley
SMALL_FALL = 1e-8  # of a sum of squares, relative
STEPS = 60  # of Newton's method
LONGEST = 0.7  # [rad] of such a step
Index = NDArray[np.intp]
Linearize = Callable[[Array, Index], tuple[Array, Array]]


class Points(NamedTuple):
    """Of k searches: parameters (k, p), residuals (k, N), Jacobians (k, N, p), sums of squares and damping (k,)."""

    x: Array
    residuals: Array
    jacobians: Array
    squares: Array
    damping: Array

    def at(self, rows: Index | NDArray[np.bool_]) -> Self:
        """Copies of some of them."""
        return type(self)(*(array[rows] for array in self))


@dataclass(frozen=True, eq=False)
class Solution:
    """Ends of K searches.

    parameters : (K, p), API units;  rss : (K,) weighted sums of squared residuals, [mm^2] without sigma
    status : (K,) of `Status`: converged (stationary: no free column of the Jacobian has a cosine above 1e-9 with the
        residuals; the closed form always is); almost_solved where rounding or a flat valley ended the search;
        iteration_limit; solver_failed where the residuals at the start are not finite
    active : (K, p) True where a bound is active;  iterations : (K,) steps, rejected ones included
    """

    parameters: Array
    rss: Array
    status: NDArray[np.object_]
    active: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    iterations: Index = field(default_factory=lambda: np.ones(1, dtype=int))

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(K,) True where it is stationary; False for data that are not finite."""
        return np.asarray(self.status == Status.converged)


def outcomes(condition: NDArray[np.bool_], status: Status, other: Status) -> NDArray[np.object_]:
    """(k,) of `Status`: one where the condition holds, the other elsewhere."""
    return np.array([other, status], dtype=object)[condition.astype(int)]


def compressed(residuals: Array, jacobians: Array) -> tuple[Array, Array]:
    """Residuals (k, q) and Jacobians (k, q, p), q = p + 1, of the same least-squares problems as tall (k, N) and
    (k, N, p), by QR, which changes neither sums of squares nor products of columns (A. Bjorck, "Numerical Methods for
    Least Squares Problems", 1996, section 2.4); those that are not tall as they are."""
    # from 20 rows per column the triangle pays: a step passes over the rows some ten times
    if jacobians.shape[1] < 20 * (jacobians.shape[2] + 1):
        return residuals, jacobians
    triangle: Array = np.linalg.qr(np.concatenate([jacobians, residuals[:, :, None]], axis=2), mode="r")  # type: ignore[assignment]
    return triangle[:, :, -1], triangle[:, :, :-1]


def damped_steps(
    columns: Array, residuals: Array, held: NDArray[np.bool_], damping: Array, tolerance: float
) -> tuple[Array, Array, Array]:
    """(k, p) minimisers s of |E s - r|^2 + damping |s|^2, zero where held; gradients E^T r; and (k,) the stiffness
    |s|^2 / s^T (E^T E + damping)^-1 s, an eigenvalue of that matrix if s is an eigenvector: times c, and added to the
    damping, it makes s about 1 / (1 + c) times as long.

    By the smaller of the normal matrices E^T E and E E^T, which square the condition, where that costs no digits that
    matter; elsewhere by singular values, of which those below `tolerance` are zero, in step and gradient.
    """
    columns = np.where(held[:, None, :], 0.0, columns) if held.any() else columns
    across, wide = np.swapaxes(columns, 1, 2), columns.shape[1] < columns.shape[2]
    gradient = (across @ residuals[:, :, None])[:, :, 0]
    normal = columns @ across if wide else across @ columns
    diagonal = np.arange(normal.shape[1])
    # 1e-14 of the largest keeps the inverse alive where it is singular and not used
    ridge = 1e-14 * np.maximum(normal[:, diagonal, diagonal].max(axis=1, initial=0.0), 1.0)
    normal[:, diagonal, diagonal] += ridge[:, None] if wide else ridge[:, None] + held
    try:
        inverse = np.linalg.inv(normal)
    except np.linalg.LinAlgError:  # rounding makes a pivot of one of them exactly zero
        normal[:, diagonal, diagonal] += 100.0 * ridge[:, None]
        inverse = np.linalg.inv(normal)
    # in the 1-norm, which is never less than the ratio of the eigenvalues
    condition = np.linalg.norm(normal, 1, axis=(1, 2)) * np.linalg.norm(inverse, 1, axis=(1, 2))
    if (damped := damping > 0.0).any():
        inverse[damped] = np.linalg.inv(normal[damped] + damping[damped, None, None] * np.eye(len(diagonal)))
    once = inverse @ (residuals if wide else gradient)[:, :, None]
    steps, softer = ((across @ a if wide else a)[:, :, 0] for a in (once, inverse @ once))
    # up to a condition of 1e10 the normal matrix gives four digits of the steps, and the next step mends the rest
    if (rest := ~(condition < min(1e10, tolerance**-2))).any():
        left, values, right = np.linalg.svd(columns[rest], full_matrices=False)
        count = significant(values, tolerance)
        pull = np.where(count, values * (np.swapaxes(left, 1, 2) @ residuals[rest, :, None])[:, :, 0], 0.0)
        squares = np.where(count, values**2 + damping[rest, None], 1.0)
        turned = np.stack([pull / squares, pull, pull / squares**2], axis=2)
        steps[rest], gradient[rest], softer[rest] = np.moveaxis(np.swapaxes(right, 1, 2) @ turned, 2, 0)
    steps = np.where(held, 0.0, steps)
    lengths, softness = np.sum(steps**2, axis=1), np.sum(steps * softer, axis=1)
    # nothing moves where it is zero
    return steps, gradient, np.divide(lengths, softness, out=np.zeros_like(lengths), where=softness > 0.0)


def levenberg_marquardt(
    linearize: Linearize,
    starts: Array,
    *,
    scales: Array,
    rounding: Array,
    lower: Array | float = -np.inf,
    upper: Array | float = np.inf,
    tolerance: float = RANK_TOLERANCE,
    metric: Array | None = None,
    iterations: int = ITERATIONS,
) -> Solution:
    """Stationary points of K problems with the same numbers of equations N and parameters p.

    linearize : parameters (k, p) of the problems numbered (k,) -> residuals (k, N), measured less computed, and the
        Jacobian (k, N, p) of what is computed; both may be weighted or whitened
    starts : (K, p), which are moved inside the bounds first;  lower, upper : (p,) these
    scales : (p,) what one unit of each parameter moves, see `information.column_lengths`
    rounding : (K,) norm of residuals that are nothing but rounding
    tolerance : singular values of unit columns below this share of the largest are zero
    metric : (p,) what a step's components are multiplied by where its length counts (damping, and the shortest of
        many); None: the lengths of the Jacobian's columns
    iterations : most steps, rejected ones included
    """

    def points_at(numbers: Index, x: Array, damping: Array) -> Points:
        """Of the problems numbered (k,) at x (k, p), which is moved inside the bounds."""
        x = np.clip(x, lower, upper)
        residuals, jacobians = linearize(x, numbers)
        return Points(x, np.array(residuals), np.array(jacobians), np.einsum("kn,kn->k", residuals, residuals), damping)

    def steps_from(numbers: Index, points: Points) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_], Array, Array]:
        """(k, p) damped steps inside the bounds; (k,) stationary; (k, p) active bounds; (k,) share of the residuals'
        norm that a step explains; (k,) stiffness, see `damped_steps`."""
        x, residuals, jacobians, squares, damping = points
        norms = np.sqrt(squares)
        lengths, zero = column_lengths(np.sqrt(np.einsum("knp,knp->kp", jacobians, jacobians)), scales)
        if metric is not None:
            lengths = np.broadcast_to(metric, lengths.shape)
        columns = jacobians / lengths[:, None, :]
        gradient = (np.swapaxes(columns, 1, 2) @ residuals[:, :, None])[:, :, 0]
        low, high = x <= lower, x >= upper
        active = (low & (gradient < 0.0)) | (high & (gradient > 0.0))
        steps, gradient, stiffness = damped_steps(columns, residuals, active | zero, damping, tolerance)
        stationary = np.max(np.abs(gradient), axis=1, initial=0.0) <= GRADIENT_TOLERANCE * norms + rounding[numbers]
        while np.any(out := (low & (steps < 0.0) | high & (steps > 0.0)) & ~stationary[:, None]):
            active |= out
            again = np.any(out, axis=1)
            posed = columns[again], residuals[again], (active | zero)[again], damping[again]
            steps[again], gradient[again], stiffness[again] = damped_steps(*posed, tolerance)
        explained = np.sqrt(np.maximum(np.sum(gradient * steps, axis=1), 0.0)) / np.maximum(norms, np.finfo(float).tiny)
        return steps / lengths, stationary, active, explained, stiffness

    def moved_by(
        numbers: Index, points: Points, steps: Array, stiffness: Array, *, watched: bool
    ) -> tuple[Points, NDArray[np.bool_]]:
        """The points after their steps, and where those descend, so that they are taken; all with the damping with
        which a step would have ended at the minimum of a parabola along it (Hebden 1973).

        No more damping than before where the sum of squares falls nearly as the linear model predicts; where it falls
        by less than a quarter of that, so much that a step half as long at most comes next (More 1978). A search that
        is `watched` may climb by one step if the next one makes up for it.
        """
        x, residuals, jacobians, squares, damping = points
        moved = points_at(numbers, x + steps, damping)
        # rounding of residuals and of their sum may hide the descent of the last steps
        better = moved.squares <= squares + 2.0 * np.sqrt(squares) * rounding[numbers] + 1e-14 * squares
        with np.errstate(over="ignore", invalid="ignore"):  # a step may lead to where nothing is finite
            step = (moved.x - x)[:, :, None]
            change, change_after = ((slopes @ step)[:, :, 0] for slopes in (jacobians, moved.jacobians))
            slope = np.einsum("kn,kn->k", change, residuals)
            predicted = 2.0 * slope - np.einsum("kn,kn->k", change, change)
            # a small fall drowns in rounding; the slopes at both ends of the step do not (trapezoidal rule)
            slopes = slope + np.einsum("kn,kn->k", change_after, moved.residuals)
            fall = np.where(predicted > SMALL_FALL * squares, squares - moved.squares, slopes)
            share = slope / np.maximum(2.0 * slope - fall, np.finfo(float).tiny)
        good = better & (fall >= np.where(damping > 0.0, 0.75, 0.25) * predicted)
        poor = ~(better & (fall >= 0.25 * predicted))
        # of the step's length; at least a tenth where it failed
        share = np.clip(np.where(np.isfinite(fall), share, 0.0), np.where(good, 1.0, 0.1), np.where(poor, 0.5, np.inf))
        new_damping = np.maximum(damping + (1.0 / share - 1.0) * stiffness, damping / 10.0)
        new_damping = np.where(new_damping > 0.1 * (stiffness - damping), new_damping, 0.0)  # less is none
        # in a curved valley the next step takes back what this one climbs its walls by
        if watched and len(climbs := np.flatnonzero(poor & np.isfinite(moved.squares))):
            climbed = moved.at(climbs)
            back = points_at(numbers[climbs], climbed.x + steps_from(numbers[climbs], climbed)[0], climbed.damping)
            falls = back.squares <= (squares - 0.25 * predicted)[climbs]
            for array, other in zip(moved, back, strict=True):
                array[climbs[falls]] = other[falls]
            better[climbs[falls]], new_damping[climbs[falls]] = True, damping[climbs[falls]]
        return moved._replace(damping=new_damping), better

    count = len(starts)
    points = points_at(np.arange(count), starts, np.zeros(count))
    status, active = np.full(count, Status.solver_failed, dtype=object), np.zeros(starts.shape, dtype=bool)
    taken, on = np.zeros(count, dtype=int), np.flatnonzero(np.isfinite(points.squares))  # searches that go on
    for iteration in range(iterations + 1 if len(on) else 0):
        last, watched = iteration == iterations, iteration >= PATIENCE
        # a flat curved valley (nearly undetermined combination, few rows) is left slowly, but by the whole step now and
        # then. What is missing at last is far below its standard deviation, where the next step explains less than 1e-4
        # sqrt(N) of those
        if last or (watched and iteration.bit_count() == 1):  # after 16, 32, 64 ....
            points.damping[on] = 0.0
        before = points.at(on)
        steps, stationary, held, explained, stiffness = steps_from(on, before)
        ended = stationary | (before.damping > 1e12) | last
        good = outcomes(stationary, Status.converged, Status.almost_solved)
        good = outcomes(explained <= 1e-4, Status.almost_solved, Status.iteration_limit) if last else good
        status[on[ended]], active[on[ended]], taken[on[ended]] = good[ended], held[ended], iteration
        on, before = on[~ended], before.at(~ended)
        if not len(on):
            break
        moved, better = moved_by(on, before, steps[~ended], stiffness[~ended], watched=watched)
        for array, other in zip(points, moved, strict=True):
            array[on[better]] = other[better]
        points.damping[on] = moved.damping
    return Solution(points.x, points.squares, status, active, taken)


# -- Newton's method ---------------------------------------------------------------------------------------------------
def newton_ascent(
    starts: Array,
    height: Callable[[Array, Index], Array],
    slopes: Callable[[Array, Index], tuple[Array, Array]],
    limits: tuple[Array, Array],
    units: Array,
    enough: Array | float = 0.0,
    stop: Callable[[], bool] | None = None,
) -> Array:
    """(m, n) postures reached from starts (m, n), none lower than its start.

    Directions are those of the absolute eigenvalues of the Hessian, which lead away from saddles; joints at a limit
    that would leave the box stay there. Each start has a reach of its own, which grows with success, else shrinks.

    height : postures (k, n) of the starts numbered (k,) -> (k,) values, -inf where none may be
    slopes : the same -> (k, n) gradients and (k, n, n) Hessians
    limits : (n,) lower and (n,) upper;  units : (n,) what counts as one radian of each joint
    enough : (m,) gain of a step that ends an ascent;  stop : asked before every step
    """
    lower, upper = limits
    edge = 1e-12 * (upper - lower)
    q, values = starts.copy(), height(starts, np.arange(len(starts)))
    reach, enough = np.full(len(q), LONGEST), np.broadcast_to(enough, len(q))
    moving = np.flatnonzero(np.isfinite(values))
    for _ in range(STEPS):
        if not len(moving) or (stop is not None and stop()):
            break
        slope, hessian = slopes(q[moving], moving)
        # of the absolute eigenvalues; joints at a limit that would leave the box are held
        at, slope, hessian = q[moving], slope * units, hessian * units[:, None] * units
        held = ((at >= upper - edge) & (slope > 0)) | ((at <= lower + edge) & (slope < 0))
        free = (~held).astype(float)
        hessian = hessian * free[:, :, None] * free[:, None, :] + np.eye(len(units)) * held[:, :, None]
        eigenvalues, vectors = np.linalg.eigh(hessian)
        floor = 1e-6 * np.abs(eigenvalues).max(axis=1, keepdims=True) + 1e-12
        along = np.einsum("mij,mi->mj", vectors, slope * free) / np.maximum(np.abs(eigenvalues), floor)
        step = np.einsum("mij,mj->mi", vectors, along) * free
        length = np.abs(step).max(axis=1)
        step *= np.minimum(1.0, reach[moving] / np.maximum(length, 1e-300))[:, None]
        trial = np.clip(q[moving] + step * units, lower, upper)
        heights = height(trial, moving)
        gain = heights - values[moving]
        better = gain > 0.0
        accepted = moving[better]
        q[accepted], values[accepted] = trial[better], heights[better]
        shorter = 0.25 * np.minimum(reach[moving], length)
        reach[moving] = np.where(better, np.minimum(2.0 * reach[moving], LONGEST), shorter)
        arrived = better & (gain <= 1e-14 * np.abs(heights) + enough[moving])
        moving = moving[(reach[moving] > 1e-9) & (length > 1e-10) & ~arrived]
    return q
