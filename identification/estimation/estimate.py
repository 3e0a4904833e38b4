"""`estimate`: checks the data, chooses the method, and states what is estimable and how well."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from identification.errors import InputError, JobError, nearest
from identification.estimation.checks import Noise, check_measurements, weighting
from identification.estimation.levenberg_marquardt import Solution
from identification.estimation.methods import METHODS
from identification.estimation.outcome import Spread, as_filed, identification
from identification.estimation.prior import Prior
from identification.estimation.problem import Problem
from identification.estimation.result import Identification
from identification.estimation.uncertainty import FittedRows, uncertainty
from identification.estimation.with_prior import estimate_with_prior
from identification.information import RANK_TOLERANCE, Spectrum, spectrum
from identification.measurements import Measurements
from identification.model import Model
from identification.model.placed import placed_model

LARGEST_SHARE = 0.1  # a combination whose standard deviation exceeds this share of the arm's reach is not estimable


def estimate(
    model: Model,
    measurements: Measurements,
    method: str | None = None,
    sigma: ArrayLike | Literal["given", "estimated"] | None = None,
    weights: ArrayLike | None = None,
) -> Identification:
    """Least-squares estimates of the model's parameters (eq. 3), with covariance (eq. 16) and 95 % intervals.

    model : a `Model`, or another, of any dimension, with the same parameters, prior, values, joints, effects, sigma,
        reach, closed_form, position and linearize
    method : `linear` (closed form, the default where the model is linear in its links), `gauss_newton` (the default
        for every other model) or `paper_steps`
    sigma : standard deviation of one coordinate [mm], one number or (m,), which intervals then rely on; "given": the
        same with the data's sigma per row, else the arm's; "estimated": from the residuals, whatever the data say. Left
        out: as "given" as long as chi2 does not contradict it; where it does, or where none is given, the scatter of
        the residuals, robustly where something is left unexplained (`Identification.uncertainty`)
    weights : (m,) relative weights >= 0 of the rows, on top of sigma: the variance of row i is sigma^2 / weights_i, so
        a row of weight 3 moves the estimates as three equal rows would; rows of weight 0 are left out

    Where a spatial arm stands and where its measured points are is found from nothing, unless the arm says so. Its
    geometry is held by the prior of its machining (`Model.prior`), as by `estimate_with_prior`.

    A plan that does not make everything estimable is no error: what is estimable is estimated, the rest is named in
    `not_identifiable`, and `status` says so. Raises `InputError` for data that do not fit the model, `JobError` if the
    method fails.
    """
    check_measurements(model, measurements)
    if prior := model.prior:
        if method not in (None, "gauss_newton"):
            raise InputError(f"method: {method} for a spatial arm held by a prior, allowed: gauss_newton")
        return estimate_with_prior(model, measurements, Prior(prior), sigma, weights)
    filed, model = as_filed(model, measurements), placed_model(model, measurements)
    noise = weighting(model, measurements, sigma, weights)
    problem = Problem.of(model, measurements, noise.weights)
    chosen = method or ("linear" if problem.exact_form else "gauss_newton")
    if chosen not in METHODS:
        raise InputError(f"method: unknown name {chosen!r}, {nearest(chosen, METHODS)}")
    solution, decomposed, problem = _solve(problem, chosen, noise)
    fit = _result(problem, measurements, chosen, solution, decomposed, noise)
    return fit if filed is None else replace(fit, residuals_before=filed)


def _solution(problem: Problem, method: str) -> Solution:
    solution = METHODS[method](problem)
    if not solution.status[0].succeeded:
        raise JobError(f"{method}: {solution.status[0].value} Nothing damps this method; gauss_newton may do better.")
    return solution


def _solve(problem: Problem, method: str, noise: Noise) -> tuple[Solution, Spectrum, Problem]:
    """Fits; and fits again without the combinations whose standard deviation turns out too large to mean anything."""
    solution = _solution(problem, method)
    residuals, jacobian = problem.linearize_at(solution.parameters[0])
    decomposed = spectrum(jacobian, problem.model.scales, problem.tolerance)
    dof = residuals.size - decomposed.rank
    sigma = noise.sigma or (float(np.sqrt(np.sum(residuals**2) / dof)) if dof > 0 else 0.0)
    reach = problem.model.reach
    useful = max(RANK_TOLERANCE, sigma / (np.sqrt(len(problem.weights)) * LARGEST_SHARE * reach))
    if decomposed.truncated(min(useful, 0.1)).rank == decomposed.rank:
        return solution, decomposed, problem
    problem = replace(problem, tolerance=min(useful, 0.1))
    solution = _solution(problem, method)
    jacobian = problem.linearize_at(solution.parameters[0])[1]
    return solution, spectrum(jacobian, problem.model.scales, problem.tolerance), problem


def _result(
    problem: Problem, data: Measurements, method: str, solution: Solution, decomposed: Spectrum, noise: Noise
) -> Identification:
    rows, has_sigma = FittedRows.of(problem, data, solution.parameters[0], decomposed.rank), noise.sigma is not None
    made = uncertainty(rows, decomposed, known=has_sigma, reliance=noise.reliance)
    scale = float(np.sqrt(rows.squares / rows.freedom)) if rows.freedom > 0 else None
    scatter = scale if noise.sigma is None or scale is None else noise.sigma * scale
    return identification(
        problem, data, method, solution, decomposed, noise, Spread(made, scatter, rows.squares, round(rows.freedom))
    )
