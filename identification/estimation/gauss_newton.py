"""Gauss-Newton with Levenberg-Marquardt damping, physical bounds and rank truncation, for every model.

Each step solves min |E s - r|^2 + damping |s|^2 over the columns E of the exact CasADi Jacobian, scaled to unit
length, by a singular value decomposition of its triangle. Undamped unless a step fails to descend. Parameters on a
bound that the gradient or the step presses against are held (active set; without the step's, a cut step need not
descend); what a step takes beyond a bound from inside is cut off there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.planar_linear import linear
from identification.estimation.problem import GRADIENT_TOLERANCE, Fit, Problem
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status

MAX_ITERATIONS = 100
MAX_DAMPING = 1e12
FLAT = 1e-4  # share of the residuals that the last undamped step would still explain: 1e-4 sqrt(2m) deviations


class Step(NamedTuple):
    """The linearised problem at one point: E = U diag(s) V^T over the free parameters."""

    free: NDArray[np.intp]
    lengths: Array  # of the free columns
    values: Array  # s, those that count
    directions: Array  # V, columns
    rotated: Array  # U^T r

    def stationary(self, threshold: float) -> bool:
        """True if the gradient V s U^T r is below the threshold in every free parameter."""
        return bool(np.all(np.abs(self.directions @ (self.values * self.rotated)) <= threshold))

    def move(self, parameters: Array, damping: float) -> Array:
        """The parameters after the damped step."""
        moved = parameters.copy()
        step = self.directions @ (self.values / (self.values**2 + damping) * self.rotated)
        moved[self.free] += step / self.lengths
        return moved


def gauss_newton(problem: Problem) -> Fit:
    """A stationary point of the weighted sum of squares, from the best start at hand (see `starts`)."""
    candidates = starts(problem)
    costs = [_cost(problem, x) for x in candidates]
    x, cost, damping = candidates[int(np.argmin(costs))], min(costs), 0.0
    for iteration in range(MAX_ITERATIONS):
        residuals, jacobian = problem.linearize(x)
        norm = float(np.linalg.norm(residuals))
        held = pressed(problem, x, jacobian.T @ residuals)
        step = linearized(problem, held, residuals, jacobian)
        if step.stationary(GRADIENT_TOLERANCE * norm + problem.rounding):
            return Fit(x, Status.converged, iteration)
        while np.any(out := outward(problem, x, step.move(x, damping))):
            held |= out
            step = linearized(problem, held, residuals, jacobian)
        allowance = 2.0 * norm * problem.rounding  # rounding may hide the descent of the last steps
        x, cost, damping = descend(problem, step, x, cost + allowance, damping)
        if damping > MAX_DAMPING:
            return Fit(x, Status.almost_solved, iteration)
    # a flat curved valley (nearly lost combination, few rows) is left slowly: what is missing is then far below its std
    flat = float(np.linalg.norm(step.rotated)) <= FLAT * norm
    return Fit(x, Status.almost_solved if flat else Status.iteration_limit, MAX_ITERATIONS)


def descend(problem: Problem, step: Step, x: Array, limit: float, damping: float) -> tuple[Array, float, float]:
    """The first point with a cost up to `limit`, under more and more damping; its cost, and the next damping."""
    while damping <= MAX_DAMPING:
        trial = np.clip(step.move(x, damping), *problem.bounds)
        cost = _cost(problem, trial)
        if cost <= limit:
            return trial, cost, damping / 10.0 if damping > 1e-6 else 0.0
        damping = max(10.0 * damping, 1e-4)
    return x, limit, damping


def _cost(problem: Problem, x: Array) -> float:
    return float(np.sum(problem.residuals(x) ** 2))


def starts(problem: Problem) -> list[Array]:
    """The best known values; and, where nothing of lengths and offsets is known, their closed-form solution beside it.

    The second makes any size of joint offset harmless: it is the global minimiser of the model without its effects.
    """
    candidates = [problem.start]
    arm, n = problem.model.arm, problem.model.arm.links
    base = tuple(f"{kind}:{j + 1}" for kind in ("length_error", "joint_offset") for j in range(n))
    if problem.model.names[: 2 * n] == base:
        data = problem.measurements
        bare = Measurements(data.postures, data.positions)
        without = Problem(Model(arm.with_effects()), bare, problem.weights, problem.tolerance)
        candidates.append(np.r_[linear(without).parameters, problem.start[2 * n :]])
    return candidates


def pressed(problem: Problem, x: Array, descent: Array) -> NDArray[np.bool_]:
    """(p,) True for parameters on a bound that the direction of descent presses against."""
    lower, upper = problem.bounds
    return ((x <= lower) & (descent < 0.0)) | ((x >= upper) & (descent > 0.0))


def outward(problem: Problem, x: Array, moved: Array) -> NDArray[np.bool_]:
    """(p,) True for parameters on a bound that the step would leave on the wrong side."""
    lower, upper = problem.bounds
    return ((x <= lower) & (moved < lower)) | ((x >= upper) & (moved > upper))


def linearized(problem: Problem, held: NDArray[np.bool_], residuals: Array, jacobian: Array) -> Step:
    """The decomposed problem over the parameters that are free to move."""
    sizes = np.linalg.norm(jacobian, axis=0) / problem.model.scales
    free = np.flatnonzero(~held & (sizes > 1e-9 * sizes.max()))
    lengths = sizes[free] * problem.model.scales[free]
    # the triangle of [E, r] holds all that the step needs; rows can be millions, columns are few
    triangle: Array = np.linalg.qr(np.column_stack([jacobian[:, free] / lengths, residuals]), mode="r")  # type: ignore
    left, values, right = np.linalg.svd(triangle[:, :-1], full_matrices=False)
    kept = values > problem.tolerance * np.max(values, initial=0.0)
    return Step(free, lengths, values[kept], right[kept].T, left.T[kept] @ triangle[:, -1])
