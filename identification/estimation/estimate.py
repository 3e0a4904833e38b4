"""`estimate`: checks the data, chooses the method, and states what is estimable and how well.

Least squares with a normal prior of some parameters, against noise that the data may show to be larger than sigma.

The minimum is the mode of the posterior. What the noise amounts to decides how far the data may move what has a prior:
it is the variance of the largest marginal likelihood, the parameters without a prior integrated out (restricted maximum
likelihood, H. D. Patterson, R. Thompson 1971), and no less than a sigma that is given.

From a solution of a least-squares problem to an `Identification`: what is estimable, how sure, what is doubtful.

Fits again and again without the rows that the last fit does not explain, until it explains all that are left.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Machining
from identification.arrays import Array
from identification.errors import InputError, JobError, nearest
from identification.estimation.doubts import doubts, far_rows, with_contradictions
from identification.estimation.expected_tip import turns_measured
from identification.estimation.levenberg_marquardt import ITERATIONS, Index, LeastSquares, Solution, levenberg_marquardt
from identification.estimation.outlying import limit_of, outlying, robust_squares, together
from identification.estimation.prior import LinearizedProblem, Prior, Widths, effective_count, likeliest, widened
from identification.estimation.problem import METHODS, Noise, Problem, check_measurements, starts, weighting
from identification.estimation.result import Identification
from identification.estimation.uncertainty import FittedRows, Uncertainty, uncertainty
from identification.information import RANK_TOLERANCE, Spectrum, identifiability_of, spectrum
from identification.inspection.readings import placed_with_zeros
from identification.kinematics.joint_range import joint_range
from identification.kinematics.spatial import BASE, TOOL
from identification.measurements import Measurements
from identification.model import Model
from identification.model.placed import placed_model
from identification.sessions import placing
from identification.status import Status
from identification.threads import single_thread

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


CLEAR = 0.5  # of the limit: rows this near are tested with their leverage, which is small where rows are many
MANY = 20  # equations for each parameter


class Spread(NamedTuple):
    """How sure a fit is: its intervals, standard deviation of one coordinate [mm], weighted squares, what is left."""

    uncertainty: Uncertainty
    scatter: float | None
    squares: float
    freedom: int


def as_it_was(problem: Problem) -> Array:
    """(m, d) residuals [mm] of the arm as it was; where nothing says where a spatial arm stands and what is measured on
    it, these are fitted in least squares (one Gauss-Newton step from the closed form)."""
    if not (free := placing(problem.model.parameters)):
        return np.asarray(problem.residuals(problem.start)[0])
    position, jacobian = problem.model.linearize(problem.postures, problem.start, problem.conditions)
    residual = problem.positions[0] - position
    slopes = (problem.root_weights[:, :, None] * jacobian[:, :, free]).reshape(-1, len(free))
    step = np.linalg.lstsq(slopes, (problem.root_weights * residual).ravel(), rcond=None)[0]
    parameters = problem.start.copy()
    parameters[free] += step
    return np.asarray(problem.residuals(parameters)[0])


def as_filed(model: Model, data: Measurements) -> Array | None:
    """(m, d) residuals [mm] of a spatial arm where its calibration has it, if nothing but that place is estimated; None
    for other fits and where the file does not say it: `as_it_was` fits it."""
    arm = getattr(model, "arm", None)
    if arm is None or arm.chain.planar or arm.calibration is None or len(data.session_names) > 1:
        return None
    chain, calibration = arm.chain, arm.calibration
    placed = (BASE in chain.known or calibration.base is not None) and (
        TOOL in chain.known or {*calibration.tools} >= {*chain.tools}
    )
    if not placed or len(placing(model.parameters)) < len(model.names):
        return None
    return np.asarray(data.positions - model.position(data.postures, model.values, data.conditions))


def identification(
    problem: Problem,
    data: Measurements,
    method: str,
    solution: Solution,
    decomposed: Spectrum,
    noise: Noise,
    spread: Spread,
) -> Identification:
    """The `Identification` of a solution: what is estimable, the uncertainty, and doubts about the fit."""
    model, parameters, has_sigma = problem.model, solution.parameters[0], noise.sigma is not None
    identifiability = identifiability_of(decomposed, model.names, model.scales)
    before, after = as_it_was(problem), problem.residuals(parameters)[0]
    doubtful = doubts(model, parameters, identifiability.identifiable, before, after, data)
    unexplained = unexplained_by_fit(problem, parameters, after)
    structure = together(unexplained, data.postures, data.posture_numbers)
    outlier = unexplained & ~structure
    used = np.flatnonzero(problem.weights > 0.0)
    first = used[np.unique(data.repeat_numbers[used], return_index=True)[1]]
    status = Status.not_identifiable if identifiability.combinations else solution.status[0]
    return Identification(
        model=model,
        parameters=parameters,
        covariance=spread.uncertainty.covariance,
        identifiable=identifiability.identifiable,
        not_identifiable=identifiability.combinations,
        sigma=noise.sigma if has_sigma else spread.scatter,
        sigma_known=has_sigma,
        chi2=spread.squares if has_sigma else None,
        dof=spread.freedom,
        residuals_before=before,
        residuals_after=after,
        method=method,
        status=Status.implausible if doubtful.implausible else status,
        iterations=int(solution.iterations[0]),
        provenance=MappingProxyType(data.origin | joint_range(data.postures, model.joint_types)),
        uncertainty=spread.uncertainty,
        scatter=spread.scatter,
        doubts=(*doubtful.sentences, *far_rows(after, outlier, structure)),
        flange_turns=turns_measured(model, data),
        postures=data.postures[first],
        determined=float(len(used) * after.shape[1] - spread.freedom),
        outlier_rows=tuple((np.flatnonzero(outlier) + 1).tolist()),
        unexplained_rows=tuple((np.flatnonzero(structure) + 1).tolist()),
    )


def unexplained_by_fit(problem: Problem, parameters: Array, residual: Array) -> NDArray[np.bool_]:
    """(m,) rows that the model does not explain, where enough equations are left to tell.

    parameters : (p,) of the fit;  residual : (m, d) [mm]
    """
    unexplained, used = np.zeros(len(residual), dtype=bool), problem.weights > 0.0
    white = (problem.root_weights * residual)[used]
    p, d = len(parameters), white.shape[1]
    if white.size - p + len(problem.prior_rows) <= p:
        return unexplained
    if white.size > MANY * p and robust_squares(np.sum(white**2, axis=1), d).max() < CLEAR * limit_of(d):
        return unexplained
    columns = problem.jacobian(parameters).reshape(len(used), -1)[used].reshape(white.size, p)
    held = problem.prior_rows
    unexplained[used] = outlying(white, columns, held, held @ (problem.prior_center - parameters))
    return unexplained


def without_outliers(
    fit: Callable[[Measurements], Identification], measurements: Measurements
) -> tuple[Identification, tuple[int, ...]]:
    """The fit to the rows that are no outliers of it, and the numbers (from 1) of the rows left out.

    fit : `lambda rows: estimate(model, rows)`, say; it is called with fewer rows each time, and once more than the
        rounds that find an outlier

    A gravity that the model lacks makes outliers, too, so look at the rows that were left out. Raises what `fit` does.
    """
    kept = np.arange(len(measurements))
    while True:
        fitted = fit(measurements.rows(kept))
        if not fitted.outlier_rows:
            left_out = np.setdiff1d(np.arange(len(measurements)), kept)
            return fitted, tuple((left_out + 1).tolist())
        kept = np.delete(kept, np.array(fitted.outlier_rows) - 1)
