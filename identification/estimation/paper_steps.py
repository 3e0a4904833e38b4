"""The paper's iteration (Section III, Steps 1-5): the linearised solution of eq. 11, repeated.

Step 1 starts at zero errors, Step 2 computes positions, Step 3 solves eq. 11 for the residuals, Step 4 corrects the
model, Step 5 repeats. Nothing damps it and it knows no bounds. A linear change of coordinates does not change the
iteration, so orientation offsets (the paper's) and joint offsets (ours) take the same steps.
"""

from __future__ import annotations

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import Solution, truncated_steps
from identification.estimation.problem import Problem
from identification.information import column_lengths
from identification.status import Status

MAX_ITERATIONS = 50
STEP_TOLERANCE = 1e-12  # of the arm's reach; "required accuracy" of Step 5


def paper_steps(problem: Problem) -> Solution:
    """Steps 1-5 until the correction is below 1e-12 of the reach. Raises `InputError` for parameters with bounds."""
    model = problem.model
    for parameter in model.parameters:
        if np.isfinite(parameter.lower) or np.isfinite(parameter.upper):
            bounded = f"{parameter.name} is bounded to [{parameter.lower:g}, {parameter.upper:g}]"
            raise InputError(f"method: paper_steps knows no bounds, {bounded}; allowed: gauss_newton")
    errors = np.zeros(len(model.parameters))  # Step 1
    enough = STEP_TOLERANCE * model.reach
    for iteration in range(1, MAX_ITERATIONS + 1):
        residuals, jacobian = problem.linearize_at(errors)  # Step 2
        # Step 3, eq. 11: the least-squares solution, the shortest where the rank is not full
        lengths, zero = column_lengths(np.linalg.norm(jacobian, axis=0), model.scales)
        columns = np.where(zero, 0.0, jacobian / lengths)
        correction = truncated_steps(columns[None], residuals[None], np.zeros(1), problem.tolerance)[0][0] / lengths
        errors = errors + correction  # Step 4
        if not np.all(np.isfinite(errors)):
            return _end(problem, np.zeros(len(errors)), Status.solver_failed, iteration)
        if np.linalg.norm(correction * model.scales) <= enough:  # Step 5
            return _end(problem, errors, Status.converged, iteration)
    return _end(problem, errors, Status.iteration_limit, MAX_ITERATIONS)


def _end(problem: Problem, errors: Array, status: Status, iterations: int) -> Solution:
    parameters = errors[None]
    inactive = np.zeros(parameters.shape, dtype=bool)
    ends = np.array([status], dtype=object), np.array([iterations])
    return Solution(parameters, problem.squares(parameters), inactive, *ends)
