"""Least squares with a normal prior of some parameters, against noise that the data may show to be larger than sigma.

The minimum is the mode of the posterior. What the noise amounts to decides how far the data may move what has a prior:
it is the variance of the largest marginal likelihood, the parameters without a prior integrated out (restricted maximum
likelihood, H. D. Patterson, R. Thompson 1971), and no less than a sigma that is given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize_scalar

from identification.arrays import Array
from identification.estimation.checks import Noise, check, weighting
from identification.estimation.levenberg_marquardt import Solution
from identification.estimation.methods import gauss_newton
from identification.estimation.outcome import Spread, identification
from identification.estimation.prior import Prior, effective_count
from identification.estimation.problem import Problem
from identification.estimation.result import Identification
from identification.estimation.uncertainty import Uncertainty
from identification.information import spectrum
from identification.measurements import Measurements
from identification.model import Model
from identification.placed import placed_model

ROUNDS = 3  # of fit and noise: the model is nearly linear, so that the second changes little
SIZES = (0.0, *(2.0 ** (-k / 2.0) for k in range(16, -1, -1)))  # of all effects; the likelihood is flat over a step
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
    problem, solution = _solved(replace(Problem.of(model, measurements, noise.weights), prior=prior), noise)
    parameters = solution.parameters[0]
    jacobian = problem.linearize_at(parameters)[1]
    decomposed = spectrum(jacobian, model.scales, problem.tolerance)
    effective = effective_count(jacobian[: len(jacobian) - len(problem.prior_rows)], problem.prior_rows)
    dof = round(model.dimension * np.count_nonzero(problem.weights) - effective)
    made = _uncertainty(problem, decomposed.covariance, float(dof), noise)
    spread = Spread(made, problem.noise * (noise.sigma or 1.0), float(problem.squares(parameters)[0]), dof)
    return identification(problem, measurements, "gauss_newton", solution, decomposed, noise, spread)


def _solved(problem: Problem, noise: Noise) -> tuple[Problem, Solution]:
    """The problem with the noise that was found, and its solution."""
    problem = replace(problem, noise=1.0 if noise.sigma is not None else _scatter(problem))
    solution = gauss_newton(problem)
    for _ in range(ROUNDS if noise.reliance != "given" else 0):
        problem = replace(problem, noise=_likeliest(problem, solution.parameters[0], noise))
        solution = gauss_newton(problem)
    return problem, solution


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
    if len(target) == free.shape[1]:
        return problem.noise
    found, unit = Restricted.of(target, free, effects), 1.0 if noise.sigma is not None else _scatter(problem)
    least = unit if noise.sigma is not None else unit / LARGEST
    return found.likeliest_noise(least, LARGEST * unit)


@dataclass(frozen=True)
class Restricted:
    """Residuals as noise and effects of normal sizes, with the parameters without a prior integrated out.

    values : variances of orthogonal combinations of residuals that effects of deviation one make
    squares : of these combinations;  rest, count : sum of squares of the others, and their number
    """

    values: Array
    squares: Array
    rest: float
    count: int

    @classmethod
    def of(cls, target: Array, free: Array, effects: Array) -> Restricted:
        """Of (N,) residuals, (N, f) columns without a prior and (N, e) columns times the deviation of their prior."""
        spare = len(target) - free.shape[1]
        basis = np.linalg.qr(free)[0]
        target, effects = target - basis @ (basis.T @ target), effects - basis @ (basis.T @ effects)
        values, vectors = np.linalg.eigh(effects.T @ effects)
        seen = values > 1e-12 * max(values.max(initial=0.0), 1e-300)
        values = values[seen][-spare:]
        along = (vectors[:, seen][:, -len(values) :].T @ (effects.T @ target)) ** 2 / values if len(values) else values
        return cls(values, along, max(float(target @ target - along.sum()), 0.0), spare - len(values))

    def minus_log(self, noise: float, size: float = 1.0) -> float:
        """-2 log of the likelihood, up to a constant;  size : factor on the deviations of the effects."""
        total = size**2 * self.values + noise**2
        own = float(np.sum(np.log(total) + self.squares / total))
        return own + self.count * 2.0 * float(np.log(noise)) + self.rest / noise**2

    def likeliest_noise(self, least: float, largest: float, size: float = 1.0) -> float:
        """Between two values, for a factor on the deviations of the effects."""
        limits = (float(np.log(least)), float(np.log(largest)))
        found = minimize_scalar(lambda log: self.minus_log(float(np.exp(log)), size), bounds=limits, method="bounded")
        return least if self.minus_log(least, size) <= found.fun else float(np.exp(found.x))

    def likeliest_size(self) -> tuple[float, float]:
        """Factor from 0 to 1 on the deviations of all effects, and the noise beside them, both likeliest together."""
        whole = max(float(np.sqrt((self.rest + self.squares.sum()) / (self.count + len(self.values)))), 1e-12)
        noises = {size: self.likeliest_noise(whole / LARGEST, whole, size) for size in SIZES}
        best = min(SIZES, key=lambda size: self.minus_log(noises[size], size))
        return best, noises[best]
