"""Gauss-Newton with Levenberg-Marquardt damping, physical bounds and rank truncation, for every model.

Each step solves min |E s - r|^2 + damping |s|^2 over the columns E of the exact CasADi Jacobian, scaled to unit
length, by a singular value decomposition of its triangle. Undamped unless a step fails to descend. Parameters on a
bound that the gradient presses against are held (active set); what a step takes beyond a bound is cut off there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arm import Array
from identification.estimation.linear import linear
from identification.estimation.problem import Fit, Problem
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status

GRADIENT_TOLERANCE = 1e-9  # stationary: no column of the Jacobian has a cosine with the residuals above this
MAX_ITERATIONS = 100
MAX_DAMPING = 1e12


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
    costs = [float(np.sum(problem.residuals(x) ** 2)) for x in candidates]
    x, cost, damping = candidates[int(np.argmin(costs))], min(costs), 0.0
    for iteration in range(MAX_ITERATIONS):
        residuals, jacobian = problem.linearise(x)
        step = linearised(problem, x, residuals, jacobian)
        threshold = GRADIENT_TOLERANCE * float(np.linalg.norm(residuals)) + problem.noise_floor
        if step.stationary(threshold):
            return Fit(x, Status.converged, iteration)
        while True:
            trial = np.clip(step.move(x, damping), *problem.bounds)
            trial_cost = float(np.sum(problem.residuals(trial) ** 2))
            if trial_cost <= cost * (1.0 + 1e-13):  # rounding may hide the descent of the last steps
                break
            damping = max(10.0 * damping, 1e-4)
            if damping > MAX_DAMPING:
                return Fit(x, Status.almost_solved, iteration)
        x, cost, damping = trial, trial_cost, damping / 10.0 if damping > 1e-6 else 0.0
    return Fit(x, Status.iteration_limit, MAX_ITERATIONS)


def starts(problem: Problem) -> list[Array]:
    """The best known values; and, where nothing of lengths and offsets is known, their closed-form solution beside it.

    The second makes any size of joint offset harmless: it is the global minimiser of the model without its effects.
    """
    candidates = [problem.start]
    arm, n = problem.model.arm, problem.model.arm.links
    base = tuple(f"{kind}:{j + 1}" for kind in ("length_error", "joint_offset") for j in range(n))
    if problem.model.names[: 2 * n] == base:
        data = problem.measurements
        without = Problem(Model(arm.with_effects()), Measurements(data.postures, data.positions), problem.weights)
        candidates.append(np.r_[linear(without).parameters, problem.start[2 * n :]])
    return candidates


def linearised(problem: Problem, x: Array, residuals: Array, jacobian: Array) -> Step:
    """The decomposed problem over the parameters that are free to move."""
    lower, upper = problem.bounds
    descent = jacobian.T @ residuals
    held = ((x <= lower) & (descent < 0.0)) | ((x >= upper) & (descent > 0.0))
    sizes = np.linalg.norm(jacobian, axis=0) / problem.model.scales
    free = np.flatnonzero(~held & (sizes > 1e-9 * sizes.max()))
    lengths = sizes[free] * problem.model.scales[free]
    # the triangle of [E, r] holds all that the step needs; rows can be millions, columns are few
    triangle = np.linalg.qr(np.column_stack([jacobian[:, free] / lengths, residuals]), mode="r")
    left, values, right = np.linalg.svd(triangle[:, :-1], full_matrices=False)
    kept = values > problem.tolerance * np.max(values, initial=0.0)
    return Step(free, lengths, values[kept], right[kept].T, left.T[kept] @ triangle[:, -1])
