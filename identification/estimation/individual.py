"""Damped Gauss-Newton for many data sets at once, each with its own normal matrix, damping and active bounds.

Slower than the shared steps of `batch`, and for what they cannot do. Normal matrices of columns scaled to unit length
square the condition number; the gradient, which decides about convergence, is computed from residuals all the same.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.gauss_newton import MAX_DAMPING, MAX_ITERATIONS
from identification.estimation.problem import GRADIENT_TOLERANCE, ROUNDING, Problem
from identification.measurements import Conditions

RIDGE = 1e-14  # keeps the factorisation alive when a bound leaves a singular rest


class Plans(NamedTuple):
    """Postures (m, n) [rad] and conditions that all data sets share, or (k, m, n) with one plan for each."""

    postures: Array
    conditions: Conditions

    def rows(self, index: NDArray[np.int_]) -> Plans:
        """The plans of some data sets."""
        return self if self.postures.ndim == 2 else Plans(self.postures[index], self.conditions.rows(index))


def individual(
    problem: Problem, measured: Array, starts: Array, plans: Plans | None = None
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Parameters (k, p), weighted sums of squares (k,) and converged (k,) of data sets (k, m, 2) from starts (k, p).

    plans : None: the problem's plan for all data sets
    """
    plans = plans or Plans(problem.measurements.postures, problem.conditions)
    lower, upper = problem.bounds
    x = np.clip(starts, lower, upper)
    cost = _cost(problem, plans, measured, x)
    converged = np.zeros(len(x), dtype=bool)
    damping = np.zeros(len(x))
    rounding = ROUNDING * np.sqrt(np.einsum("kmd,m->k", measured**2, problem.weights))
    active = np.arange(len(x))
    for _ in range(2 * MAX_ITERATIONS):
        normal, gradient, lengths = _normal_equations(problem, plans.rows(active), measured[active], x[active])
        held = ((x[active] <= lower) & (gradient < 0.0)) | ((x[active] >= upper) & (gradient > 0.0))
        gradient = np.where(held, 0.0, gradient)
        small = GRADIENT_TOLERANCE * np.sqrt(cost[active]) + rounding[active]
        done = np.max(np.abs(gradient), axis=1) <= small
        converged[active[done]] = True
        going = ~done & (damping[active] <= MAX_DAMPING)
        active = active[going]
        if active.size == 0:
            break
        blocked = (x[active] <= lower) * -1 + (x[active] >= upper)
        step = _step_inside(normal[going], gradient[going], held[going], damping[active], blocked)
        trial = np.clip(x[active] + step / lengths[going], lower, upper)
        trial_cost = _cost(problem, plans.rows(active), measured[active], trial)
        better = trial_cost <= cost[active] + 2.0 * np.sqrt(cost[active]) * rounding[active]
        x[active[better]], cost[active[better]] = trial[better], trial_cost[better]
        relaxed = np.where(damping[active] > 1e-6, damping[active] / 10.0, 0.0)
        damping[active] = np.where(better, relaxed, np.maximum(10.0 * damping[active], 1e-4))
    return x, cost, converged


def _cost(problem: Problem, plans: Plans, measured: Array, parameters: Array) -> Array:
    position = problem.model.position(plans.postures, parameters, plans.conditions)
    return np.einsum("kmd,m->k", (measured - position) ** 2, problem.weights)


def _normal_equations(problem: Problem, plans: Plans, measured: Array, parameters: Array) -> tuple[Array, Array, Array]:
    """(k, p, p) E^T E, (k, p) E^T r and (k, p) column lengths of the weighted Jacobian, E of unit columns."""
    position, jacobian = problem.model.linearize(plans.postures, parameters, plans.conditions)
    k, m, d, p = jacobian.shape
    rows = (problem.root_weights[:, :, None] * jacobian).reshape(k, m * d, p)
    residuals = (problem.root_weights * (measured - position)).reshape(k, m * d)
    lengths = np.sqrt(np.einsum("kip,kip->kp", rows, rows))
    lengths = np.maximum(lengths, np.finfo(float).tiny ** 0.25)
    rows /= lengths[:, None, :]
    across = np.swapaxes(rows, 1, 2)
    return across @ rows, (across @ residuals[:, :, None])[:, :, 0], lengths


def _step_inside(
    normal: Array, gradient: Array, held: NDArray[np.bool_], damping: Array, blocked: NDArray[np.int_]
) -> Array:
    """`_step`, holding also what it would push over a bound: blocked (k, p) is -1 on a lower, +1 on an upper bound."""
    held = held.copy()
    step = _step(normal, gradient, held, damping)
    while np.any(out := (step * blocked > 0.0) & ~held):
        again = np.any(out, axis=1)
        held |= out
        step[again] = _step(normal[again], gradient[again], held[again], damping[again])
    return step


def _step(normal: Array, gradient: Array, held: NDArray[np.bool_], damping: Array) -> Array:
    """(k, p) solution of (E^T E + damping) s = E^T r over the parameters that are not held, zero for those that are."""
    p = gradient.shape[1]
    free = ~held
    matrix = np.where(free[:, :, None] & free[:, None, :], normal, 0.0)
    diagonal = np.arange(p)
    matrix[:, diagonal, diagonal] += np.where(held, 1.0, damping[:, None] + RIDGE)
    return np.linalg.solve(matrix, np.where(held, 0.0, gradient)[:, :, None])[:, :, 0]
