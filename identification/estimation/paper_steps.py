"""The paper's iteration (Section III, Steps 1-5): the linearised solution of eq. 11, repeated.

Step 1 starts at zero errors, Step 2 computes positions, Step 3 solves eq. 11 for the residuals, Step 4 corrects the
model, Step 5 repeats. Nothing damps it and it knows no bounds. A linear change of coordinates does not change the
iteration, so orientation offsets (the paper's) and joint offsets (ours) take the same steps.
"""

from __future__ import annotations

import numpy as np

from identification.errors import InputError
from identification.estimation.problem import Fit, Problem
from identification.status import Status

MAX_ITERATIONS = 50
STEP_TOLERANCE = 1e-12  # of the arm's reach; "required accuracy" of Step 5


def paper_steps(problem: Problem) -> Fit:
    """Steps 1-5 until the correction is below 1e-12 of the reach. Raises `InputError` for parameters with bounds."""
    model = problem.model
    for parameter in model.parameters:
        if np.isfinite(parameter.lower) or np.isfinite(parameter.upper):
            found = f"{parameter.name} is bounded to [{parameter.lower:g}, {parameter.upper:g}]"
            raise InputError(f"method: paper_steps knows no bounds, {found}; allowed: gauss_newton")
    errors = np.zeros(len(model.parameters))  # Step 1
    enough = STEP_TOLERANCE * float(np.sum(model.arm.lengths))
    for iteration in range(1, MAX_ITERATIONS + 1):
        residuals, jacobian = problem.linearize(errors)  # Step 2
        scaled = np.linalg.lstsq(jacobian / model.scales, residuals, rcond=problem.tolerance)[0]  # Step 3, eq. 11
        errors = errors + scaled / model.scales  # Step 4
        if not np.all(np.isfinite(errors)):
            return Fit(np.zeros(len(errors)), Status.solver_failed, iteration)
        if np.linalg.norm(scaled) <= enough:  # Step 5
            return Fit(errors, Status.converged, iteration)
    return Fit(errors, Status.iteration_limit, MAX_ITERATIONS)
