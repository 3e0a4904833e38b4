"""Least squares with a normal prior of some parameters, against noise that the data may show to be larger than sigma.

The minimum is the mode of the posterior. What the noise amounts to decides how far the data may move what has a prior:
it is the variance of the largest marginal likelihood, the parameters without a prior integrated out (restricted maximum
likelihood, H. D. Patterson, R. Thompson 1971), and no less than a sigma that is given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from identification.arm import Machining
from identification.arrays import Array
from identification.estimation.checks import Noise, check_measurements, weighting
from identification.estimation.contradictions import with_contradictions
from identification.estimation.levenberg_marquardt import ITERATIONS, Index, LeastSquares, Solution, levenberg_marquardt
from identification.estimation.methods import starts
from identification.estimation.outcome import Spread, identification
from identification.estimation.prior import Prior, effective_count
from identification.estimation.problem import Problem
from identification.estimation.restricted_likelihood import LinearizedProblem, Widths, likeliest, widened
from identification.estimation.result import Identification
from identification.estimation.uncertainty import FittedRows, uncertainty
from identification.information import Spectrum, spectrum
from identification.inspection.readings import placed_with_zeros
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status
from identification.threads import single_thread

FIRST = 2  # steps before the noise is estimated again: the model is nearly linear
ROUNDS = 10  # of fit and noise: the model is nearly linear, so that the second changes little
STEADY = 1e-4  # relative change of the noise, far below its own uncertainty
ROUNDED = 1e-14  # of the largest singular value: below it is rounding
UNUSUAL = 8.0  # times the machining's sizes, from which a mistake is likelier than such an arm


@single_thread()
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

    The sizes of the machining are those of the model or, where the data say that the arm is farther from its drawing,
    a common multiple of them, and one of the joint zeros', likeliest together with the noise; `doubts` say so.

    Raises `InputError` for data that do not fit the model, and fewer equations than parameters without a prior.
    """
    model, zeros = placed_with_zeros(model, measurements)
    prior = replace(prior, deviations={**model.prior, **prior.deviations})
    check_measurements(model, measurements, prior)
    noise = weighting(model, measurements, sigma, weights)
    whole = replace(Problem.of(model, measurements, noise.weights), prior=prior)
    problem, solution, widths, jacobian = _solved(whole, noise, zeros)
    parameters = solution.parameters[0]
    decomposed = _decomposed(jacobian, problem)
    effective = float(np.sum(np.square(jacobian @ decomposed.root)))  # as `effective_count`, whose decomposition it is
    if decomposed.rank < len(parameters):
        effective = effective_count(jacobian, problem.prior_rows)
    dof = round(model.dimension * np.count_nonzero(problem.weights) - effective)
    rows = FittedRows.of(problem, measurements, parameters, effective)
    has_sigma = noise.sigma is not None
    made = uncertainty(rows, decomposed, known=has_sigma, reliance=noise.reliance, noise=problem.noise)
    spread = Spread(made, problem.noise * (noise.sigma or 1.0), float(problem.squares(parameters)[0]), dof)
    fit = identification(problem, measurements, "gauss_newton", solution, decomposed, noise, spread)
    fit = replace(fit, prior=problem.prior, machining_factor=widths.machining if model.prior else None)
    fit = replace(fit, doubts=(*fit.doubts, *far_from_drawing(model.arm.machining, widths)))
    if prior.earlier is None:
        return fit

    def again(values: Mapping[str, float]) -> Identification:
        held = replace(model, known={**model.fixed, **values})
        return estimate_with_prior(held, measurements, replace(prior, earlier=None), sigma, weights)

    return with_contradictions(fit, problem, noise, again)


def _decomposed(jacobian: Array, problem: Problem) -> Spectrum:
    """Of a Jacobian (N, p) and the rows of the prior: what a proper prior holds is determined, however much more exact
    the rows of the data are; what counts as zero is a share of the least that it holds, as long as that is no rounding.
    """
    rows, scales = problem.prior_rows, problem.model.scales
    held = np.any(rows != 0.0, axis=0)
    decomposed = spectrum(np.concatenate([jacobian, rows]), scales, problem.tolerance, held)
    sizes = np.linalg.svd(rows / decomposed.lengths, compute_uv=False)
    least = np.min(sizes, initial=np.inf, where=sizes > ROUNDED * np.max(sizes, initial=0.0))
    return decomposed.truncated(float(np.clip(0.1 * least / decomposed.values[0], ROUNDED, problem.tolerance)))


def far_from_drawing(machining: Machining, widths: Widths) -> list[str]:
    """What is doubtful about an arm whose errors are so many times those of its machining."""
    rotation = f"{np.degrees(machining.rotation):g} deg"
    width, zeros, sizes = widths.machining, widths.zeros, f"{machining.translation:g} mm and {rotation}"
    ask = "; are units, order and signs of joints and coordinates right? armcal check tells" if width >= UNUSUAL else ""
    of_lengths = (
        f"the arm is farther from its drawing than [machining] says ({sizes}): taken {width:g} times as large{ask}"
    )
    why = f"taken as {width * zeros:g} times as large, as where a motor was changed or a drawing counts from elsewhere"
    of_zeros = f"zeros of joints are farther from the drawing than [machining] says ({rotation}): {why}"
    return [sentence for factor, sentence in ((width, of_lengths), (zeros, of_zeros)) if factor != 1.0]


def _solved(problem: Problem, noise: Noise, zeros: Mapping[str, float]) -> tuple[Problem, Solution, Widths, Array]:
    """The problem with the noise that was found, its solution, the widths of the machining's sizes, and the Jacobian
    without the prior; in turns until the noise stays.

    zeros : parameters to start from elsewhere than at the best known values
    """
    sigma_holds, linearized = noise.reliance == "given", _Linearizations(replace(problem, prior=None))

    def solved(at: Array, most: int) -> tuple[Problem, Solution, Widths]:
        scale, widths = likeliest(LinearizedProblem.of(problem, at, *linearized.at(at)), noise, sigma_holds)
        posed = replace(problem, noise=scale, prior=widened(problem, widths))
        return posed, levenberg_marquardt(replace(linearized.with_prior(posed), iterations=most), at[None]), widths

    parameters = problem.model.parameters
    elsewhere, values = [p.name in zeros for p in parameters], parameters.vector(zeros, default=0.0)
    start = np.where(elsewhere, values, starts(problem)[0])
    posed, solution, widths = solved(start, ITERATIONS if sigma_holds else FIRST)
    most = ITERATIONS
    for _ in range(0 if sigma_holds else ROUNDS):
        before, steps = posed.noise, solution.iterations
        posed, solution, widths = solved(solution.parameters[0], most)
        solution = replace(solution, iterations=solution.iterations + steps)
        if most == 0 or abs(posed.noise - before) <= STEADY * before:
            break
        most = 0 if solution.status[0] is Status.iteration_limit else ITERATIONS  # the noise there, no further steps
    return posed, solution, widths, linearized.at(solution.parameters[0])[1]


@dataclass
class _Linearizations:
    """Triangles of a problem without its prior, each made once: fits of other noise pass through the same points."""

    problem: Problem
    by_point: dict[bytes, tuple[Array, Array]] = field(default_factory=dict)

    def at(self, x: Array) -> tuple[Array, Array]:
        """(N,) residuals and (N, p) Jacobian at x (p,)."""
        if (key := x.tobytes()) not in self.by_point:
            residuals, jacobians = self.problem.least_squares.linearize(x[None], np.arange(1))
            self.by_point[key] = residuals[0], jacobians[0]
        return self.by_point[key]

    def with_prior(self, problem: Problem) -> LeastSquares:
        """The same problem with the prior."""
        rows = problem.prior_rows

        def linearize(x: Array, _: Index) -> tuple[Array, Array]:
            residual, jacobian = self.at(x[0])
            left = rows @ (problem.prior_center - x[0])
            return np.concatenate([residual, left])[None], np.concatenate([jacobian, rows])[None]

        return replace(problem.least_squares, linearize=linearize)
