"""Least squares with a normal prior of some parameters, against noise that the data may show to be larger than sigma.

The minimum is the mode of the posterior. What the noise amounts to decides how far the data may move what has a prior:
it is the variance of the largest marginal likelihood, the parameters without a prior integrated out (restricted maximum
likelihood, H. D. Patterson, R. Thompson 1971), and no less than a sigma that is given.
"""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from identification.arrays import Array
from identification.estimation.checks import Noise, check, weighting
from identification.estimation.methods import gauss_newton
from identification.estimation.plausibility import doubts
from identification.estimation.prior import Prior, effective_count
from identification.estimation.problem import Problem
from identification.estimation.result import Identification
from identification.estimation.uncertainty import Uncertainty
from identification.information import identifiability_of, spectrum
from identification.measurements import Measurements
from identification.model import Model
from identification.placed import placed_model
from identification.status import Status

ROUNDS = 3  # of fit and noise: the model is nearly linear, so that the second changes little
LARGEST = 1e3  # noise in units of sigma, or of the scatter of a fit without the parameters that have a prior


def estimate_with_prior(
    model: Model,
    measurements: Measurements,
    prior: Prior,
    sigma: ArrayLike | Literal["given", "estimated"] | None = None,
    weights: ArrayLike | None = None,
) -> Identification:
    """Estimates of all parameters, those with a prior as far as the data move them, with intervals of the posterior.

    model, measurements, weights : as of `estimate`
    sigma : numbers or "given": the noise is what is given; "estimated": of the largest marginal likelihood; left out:
        the latter, but no less than what is given

    Raises `InputError` for data that do not fit the model, and fewer equations than parameters without a prior.
    """
    model = placed_model(model, measurements)
    prior = Prior({**getattr(model, "prior", {}), **prior.deviations})
    check(model, measurements, prior)
    noise = weighting(model, measurements, sigma, weights)
    problem = replace(Problem.of(model, measurements, noise.weights), prior=prior)
    problem = replace(problem, noise=1.0 if noise.sigma is not None else _scatter(problem))
    solution = gauss_newton(problem)
    for _ in range(ROUNDS if noise.reliance != "given" else 0):
        problem = replace(problem, noise=_likeliest(problem, solution.parameters[0], noise))
        solution = gauss_newton(problem)
    parameters, status = solution.parameters[0], solution.status[0]
    jacobian = problem.linearize_at(parameters)[1]
    decomposed = spectrum(jacobian, model.scales, problem.tolerance)
    found = identifiability_of(decomposed, model.names, model.scales)
    data_rows = len(jacobian) - len(problem.prior_rows)
    effective = effective_count(jacobian[:data_rows], problem.prior_rows)
    before, after = problem.residuals(problem.start)[0], problem.residuals(parameters)[0]
    doubtful = doubts(model, parameters, found.identifiable, after, measurements)
    if found.combinations:
        status = Status.not_identifiable
    dof = round(model.dimension * np.count_nonzero(problem.weights) - effective)
    known = noise.sigma is not None
    scale = problem.noise * (noise.sigma or 1.0)
    return Identification(
        model=model,
        parameters=parameters,
        covariance=problem.noise**2 * decomposed.covariance,
        identifiable=found.identifiable,
        not_identifiable=found.combinations,
        sigma=noise.sigma if known else scale,
        sigma_known=known,
        chi2=float(problem.squares(parameters)[0]) if known else None,
        dof=dof,
        residuals_before=before,
        residuals_after=after,
        method="gauss_newton",
        status=Status.implausible if doubtful.implausible else status,
        uncertainty=_uncertainty(problem, decomposed.covariance, float(dof), noise),
        scatter=scale,
        doubts=doubtful.sentences,
        iterations=int(solution.iterations[0]),
        provenance=MappingProxyType(measurements.origin),
    )


def _uncertainty(problem: Problem, covariance: Array, dof: float, noise: Noise) -> Uncertainty:
    """`given` where the noise is sigma; else `scatter`, with Student's t."""
    given = noise.sigma is not None and problem.noise == 1.0
    freedom = np.full(len(covariance), np.inf if given else max(dof, 1.0))
    return Uncertainty("given" if given else "scatter", problem.noise**2 * covariance, freedom)


def _split(problem: Problem, parameters: Array) -> tuple[Array, Array, Array]:
    """Weighted residuals (N,) if all with a prior were zero, (N, f) columns without a prior, (N, e) with one times its
    deviation."""
    residual, jacobian = replace(problem, prior=None).linearize_at(parameters)
    deviations = problem.model.parameters.vector(problem.prior.deviations if problem.prior else {})
    known = deviations > 0.0
    return (
        residual + jacobian[:, known] @ parameters[known],
        jacobian[:, ~known],
        jacobian[:, known] * deviations[known],
    )


def _scatter(problem: Problem) -> float:
    """Scatter of a linear fit of the parameters without a prior alone, at the start."""
    target, free, _ = _split(problem, problem.start)
    left = target - free @ np.linalg.lstsq(free, target, rcond=None)[0]
    return max(float(np.linalg.norm(left)) / np.sqrt(max(len(left) - free.shape[1], 1)), 1e-12)


def _likeliest(problem: Problem, parameters: Array, noise: Noise) -> float:
    """The noise of the largest marginal likelihood, linearised at the parameters, no less than a given one."""
    target, free, effects = _split(problem, parameters)
    if (spare := len(target) - free.shape[1]) < 1:
        return problem.noise
    basis = np.linalg.qr(free)[0]
    target, effects = target - basis @ (basis.T @ target), effects - basis @ (basis.T @ effects)
    values, vectors = np.linalg.eigh(effects.T @ effects)
    seen = values > 1e-12 * max(values[-1], 1e-300)
    values = values[seen][-spare:]
    along = (vectors[:, seen][:, -len(values) :].T @ (effects.T @ target)) ** 2 / values if len(values) else values
    rest, count = max(float(target @ target - along.sum()), 0.0), spare - len(values)

    def minus_log(logarithm: float) -> float:
        variance = np.exp(2.0 * logarithm)
        total = values + variance
        return float(np.sum(np.log(total) + along / total) + count * 2.0 * logarithm + rest / variance)

    unit = 1.0 if noise.sigma is not None else _scatter(problem)
    least = unit if noise.sigma is not None else unit / LARGEST
    found = minimize_scalar(minus_log, bounds=(np.log(least), np.log(LARGEST * unit)), method="bounded")
    return least if minus_log(float(np.log(least))) <= found.fun else float(np.exp(found.x))
