"""`estimate`: poses the problem, solves it, and states what is estimable, how sure it is, and what is doubtful.

With a normal prior of some parameters the minimum is the mode of the posterior. What the noise amounts to decides how
far the data may move what has a prior: it is the noise of the largest marginal likelihood (`prior.likeliest`), and no
less than a sigma that is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import Machining
from identification.arrays import Array
from identification.errors import InputError, JobError, nearest
from identification.estimation.doubts import Contradiction, doubts, far_rows, flange_turns
from identification.estimation.levenberg_marquardt import (
    GRADIENT_TOLERANCE,
    ITERATIONS,
    Index,
    Solution,
    levenberg_marquardt,
    outcomes,
)
from identification.estimation.problem import (
    METHODS,
    LinearProblem,
    Prior,
    Problem,
    check_measurements,
    contradicted,
    damped_gauss_newton,
    likeliest,
    linear,
    starts,
)
from identification.estimation.result import Identification
from identification.estimation.uncertainty import WhiteRows, limit_of, outlying, robust_squares, together, uncertainty
from identification.information import (
    RANK_TOLERANCE,
    Spectrum,
    full_rank,
    identifiability_of,
    information_matrix,
    spectrum,
)
from identification.inspection.readings import placed_with_zeros
from identification.kinematics.chain import BASE, TOOL
from identification.kinematics.counting import joint_range
from identification.kinematics.parameters import JOINT_OFFSET
from identification.measurements import Conditions, Measurements, directions_from_order, past_from_order, session_time
from identification.model import Model
from identification.model.placed import placed_model
from identification.sessions import placing
from identification.status import Status
from identification.threads import single_thread

LARGEST_SHARE = 0.1  # a combination whose standard deviation exceeds this share of the arm's reach is not estimable
UNUSUAL = 8.0  # times the machining's sizes, from which a mistake is likelier than such an arm


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
    problem = Problem.of(model, measurements, sigma, weights)
    chosen = method or ("linear" if problem.exact_form else "gauss_newton")
    if chosen not in METHODS:
        raise InputError(f"method: unknown name {chosen!r}, {nearest(chosen, METHODS)}")

    def solved(problem: Problem) -> tuple[Solution, Array, Spectrum]:
        solution = METHODS[chosen](problem)
        if not (status := solution.status[0]).succeeded:
            raise JobError(f"{chosen}: {status.value} Nothing damps this method; gauss_newton may do better.")
        residuals, jacobians = problem.linearize(solution.parameters, np.arange(1))
        return solution, residuals[0], spectrum(jacobians[0], model.scales, problem.tolerance)

    solution, residual, decomposed = solved(problem)
    # once more without the combinations whose standard deviation turns out too large to mean anything
    dof = residual.size - decomposed.rank
    deviation = problem.sigma or (float(np.sqrt(np.sum(residual**2) / dof)) if dof > 0 else 0.0)
    useful = max(RANK_TOLERANCE, deviation / (np.sqrt(len(measurements)) * LARGEST_SHARE * model.reach))
    if decomposed.truncated(min(useful, 0.1)).rank != decomposed.rank:
        problem = replace(problem, tolerance=min(useful, 0.1))
        solution, _, decomposed = solved(problem)
    fit = identification(problem, measurements, chosen, solution, decomposed, decomposed.rank)
    return fit if filed is None else replace(fit, residuals_before=filed)


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
    problem, solution, widths, jacobian = _with_likeliest_noise(
        Problem.of(model, measurements, sigma, weights, prior), zeros
    )
    decomposed = spectrum(jacobian, model.scales, problem.tolerance, problem.prior_rows)
    determined = decomposed.determined(jacobian)
    fit = identification(problem, measurements, "gauss_newton", solution, decomposed, determined)
    far = (*fit.doubts, *far_from_drawing(model.arm.machining, *widths))
    fit = replace(fit, prior=problem.prior, machining_factor=widths[0] if model.prior else None, doubts=far)
    if prior.earlier is None:
        return fit
    names, noise, jacobian = contradicted(problem, fit.parameters)
    least = replace(problem, noise=min(noise, problem.noise))  # that is there without the earlier calibration
    seen = spectrum(jacobian, model.scales, problem.tolerance, least.prior_rows).covariance
    fit = replace(fit, covariance_seen=least.noise**2 * seen)
    if not names:
        return fit
    earlier = prior.earlier
    others = {name: x for name, x in zip(earlier.names, earlier.values.tolist(), strict=True) if name not in names}
    held = replace(model, held={**model.fixed, **others})
    free = estimate_with_prior(held, measurements, replace(prior, earlier=None), sigma, weights)
    before = earlier.conditioned_on(others)
    return replace(fit, contradictions=tuple(Contradiction.of(name, before, free, names[name]) for name in names))


def without_outliers(
    fit: Callable[[Measurements], Identification], measurements: Measurements
) -> tuple[Identification, tuple[int, ...]]:
    """The fit to the rows that are no outliers of it, and the numbers (from 1) of the rows left out: again and again
    without the rows that the last fit does not explain, until it explains all that are left.

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


# -- noise and fit in turns --------------------------------------------------------------------------------------------
def _with_likeliest_noise(
    problem: Problem, zeros: Mapping[str, float]
) -> tuple[Problem, Solution, tuple[float, float], Array]:
    """The problem with the likeliest noise and prior, its solution, the widths of the machining's sizes (of all, and
    those of joint zeros besides), and the Jacobian without the prior; in turns until the noise stays.

    zeros : parameters to start from elsewhere than at the best known values
    """
    model, holds = problem.model, problem.reliance == "given"
    made: dict[bytes, LinearProblem] = {}

    def about(x: Array) -> LinearProblem:
        """Each made once: fits of other noise pass through the same points."""
        if (key := x.tobytes()) not in made:
            made[key] = problem.linearized(x)
        return made[key]

    def solved(at: Array, most: int) -> tuple[Problem, Solution, tuple[float, float]]:
        noise, (width, zero_width) = likeliest(about(at))
        offsets = {p.name for p in model.parameters if p.kind == JOINT_OFFSET}
        factors = {name: width * (zero_width if name in offsets else 1.0) for name in model.prior}
        prior = None if problem.prior is None else problem.prior.widened(factors)
        posed = replace(problem, noise=noise, prior=prior)
        rows = posed.prior_rows

        def linearize(x: Array, _: Index) -> tuple[Array, Array]:
            data, left = about(x[0]), rows @ (posed.prior_center - x[0])
            return np.concatenate([data.residual, left])[None], np.concatenate([data.jacobian, rows])[None]

        least = replace(posed.least_squares, linearize=linearize, iterations=most)
        return posed, levenberg_marquardt(least, at[None]), (width, zero_width)

    elsewhere = [p.name in zeros for p in model.parameters]
    start = np.where(elsewhere, model.parameters.vector(zeros, default=0.0), starts(problem)[0])
    # two steps before the noise is estimated again, in ten rounds at most: the model is nearly linear, so that the
    # second round changes little
    posed, solution, widths = solved(start, ITERATIONS if holds else 2)
    most = ITERATIONS
    for _ in range(0 if holds else 10):
        before, steps = posed.noise, solution.iterations
        posed, solution, widths = solved(solution.parameters[0], most)
        solution = replace(solution, iterations=solution.iterations + steps)
        if most == 0 or abs(posed.noise - before) <= 1e-4 * before:  # far below its own uncertainty
            break
        most = 0 if solution.status[0] is Status.iteration_limit else ITERATIONS  # the noise there, no further steps
    return posed, solution, widths, about(solution.parameters[0]).jacobian


def far_from_drawing(machining: Machining, width: float, zeros: float) -> list[str]:
    """What is doubtful about an arm whose errors are so many times those of its machining, and its zeros besides."""
    rotation = f"{np.degrees(machining.rotation):g} deg"
    sizes, sentences = f"{machining.translation:g} mm and {rotation}", []
    if width != 1.0:
        ask = "; are units, order and signs of joints and coordinates right? armcal check tells"
        sentences.append(
            f"the arm is farther from its drawing than [machining] says ({sizes}): taken {width:g} times as large"
            f"{ask if width >= UNUSUAL else ''}"
        )
    if zeros != 1.0:
        sentences.append(
            f"zeros of joints are farther from the drawing than [machining] says ({rotation}): taken as "
            f"{width * zeros:g} times as large, as where a motor was changed or a drawing counts from elsewhere"
        )
    return sentences


# -- from a solution to a result ---------------------------------------------------------------------------------------
def identification(
    problem: Problem,
    data: Measurements,
    method: str,
    solution: Solution,
    decomposed: Spectrum,
    determined: float,
) -> Identification:
    """The `Identification` of a solution: what is estimable, the uncertainty, and doubts about the fit.

    determined : how many combinations of parameters the data determine, a prior the rest
    """
    model, parameters, has_sigma = problem.model, solution.parameters[0], problem.sigma is not None
    rows, noise = WhiteRows.of(problem, data, parameters, determined), None if problem.prior is None else problem.noise
    made = uncertainty(rows, decomposed, sigma_given=has_sigma, reliance=problem.reliance, noise=noise)
    scale = noise if noise is not None else float(np.sqrt(rows.squares / rows.freedom)) if rows.freedom > 0 else None
    scatter = None if scale is None else scale * (problem.sigma or 1.0)
    dof = round(rows.freedom)
    identifiability = identifiability_of(decomposed, model.names, model.scales)
    before, after = as_it_was(problem), problem.residuals(parameters)[0]
    sentences, implausible = doubts(model, parameters, identifiability.identifiable, before, after, data)
    unexplained = unexplained_by_fit(problem, parameters, after)
    structure = together(unexplained, data.postures, data.posture_numbers)
    outlier = unexplained & ~structure
    used = np.flatnonzero(problem.weights > 0.0)
    first = used[np.unique(data.repeat_numbers[used], return_index=True)[1]]
    arm = getattr(model, "arm", None)
    stands = arm is None or arm.chain.planar or {BASE, TOOL} & arm.chain.settled  # base or measured points are given
    status = Status.not_identifiable if identifiability.combinations else solution.status[0]
    return Identification(
        model=model,
        parameters=parameters,
        covariance=made.covariance,
        identifiable=identifiability.identifiable,
        not_identifiable=identifiability.combinations,
        sigma=problem.sigma if has_sigma else scatter,
        sigma_known=has_sigma,
        chi2=rows.squares if has_sigma else None,
        dof=dof,
        residuals_before=before,
        residuals_after=after,
        method=method,
        status=Status.implausible if implausible else status,
        iterations=int(solution.iterations[0]),
        provenance=MappingProxyType(data.origin | joint_range(data.postures, model.joint_types)),
        uncertainty=made,
        scatter=scatter,
        doubts=(*sentences, *far_rows(after, outlier, structure)),
        flange_turns=None if arm is None or stands else flange_turns(arm.chain, data),
        postures=data.postures[first],
        determined=float(len(used) * after.shape[1] - dof),
        outlier_rows=tuple((np.flatnonzero(outlier) + 1).tolist()),
        unexplained_rows=tuple((np.flatnonzero(structure) + 1).tolist()),
    )


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
    placed = (BASE in chain.settled or calibration.base is not None) and (
        TOOL in chain.settled or {*calibration.tools} >= {*chain.tools}
    )
    if not placed or len(placing(model.parameters)) < len(model.names):
        return None
    return np.asarray(data.positions - model.position(data.postures, model.values, data.conditions))


def unexplained_by_fit(problem: Problem, parameters: Array, residual: Array) -> NDArray[np.bool_]:
    """(m,) rows that the model does not explain, where enough equations are left to tell.

    parameters : (p,) of the fit;  residual : (m, d) [mm]
    """
    unexplained, used = np.zeros(len(residual), dtype=bool), problem.weights > 0.0
    white = (problem.root_weights * residual)[used]
    p, d = len(parameters), white.shape[1]
    if white.size - p + len(problem.prior_rows) <= p:
        return unexplained
    # rows nearer than half the limit need no test with their leverage, which is small where rows are many
    if white.size > 20 * p and robust_squares(np.sum(white**2, axis=1), d).max() < 0.5 * limit_of(d):
        return unexplained
    columns = problem.jacobian(parameters).reshape(len(used), -1)[used].reshape(white.size, p)
    held = problem.prior_rows
    unexplained[used] = outlying(white, columns, held, held @ (problem.prior_center - parameters))
    return unexplained


# -- many data sets ----------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class BatchFit:
    """Fits of K data sets.

    parameters : (K, p) in the order of `model.parameters`, API units
    rss : (K,) weighted sum of squares at the solution; [mm^2] without sigma
    status : (K,) of `Status`
    """

    parameters: Array
    rss: Array
    status: NDArray[np.object_]

    def __post_init__(self) -> None:
        for array in (self.parameters, self.rss, self.status):
            array.setflags(write=False)

    @cached_property
    def converged(self) -> NDArray[np.bool_]:
        """(K,) True where it is stationary: no free column of the Jacobian has a cosine above 1e-9 with the residuals
        (the closed form always is); False for data that are not finite."""
        converged = np.asarray(self.status == Status.converged)
        converged.setflags(write=False)
        return converged

    def __len__(self) -> int:
        return len(self.rss)

    def __repr__(self) -> str:
        k, p = self.parameters.shape
        return f"BatchFit({k} data sets, {p} parameters, {np.count_nonzero(self.converged)} converged)"


def _chunks(count: int, rows: int) -> Iterator[slice]:
    size = max(1, 20_000 // rows)  # rows of all data sets: the arrays of one pass stay in the processor's cache
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _not_fitted(count: int, model: Model) -> tuple[Array, Array, NDArray[np.object_]]:
    """Parameters, sums of squares and statuses of data sets that are not fitted."""
    status = np.full(count, Status.not_identifiable, dtype=object)
    return np.full((count, len(model.names)), np.nan), np.full(count, np.nan), status


# -- one plan ----------------------------------------------------------------------------------------------------------
def estimate_batch(
    model: Model, plan: Measurements | ArrayLike, positions: ArrayLike, weights: ArrayLike | None = None
) -> BatchFit:
    """Fits every data set, each as `estimate` would.

    plan : measurements whose postures and conditions all data sets share (their positions are not read), or (m, n)
        postures [rad] in the order of measurement
    positions : (K, m, d) measured [mm]
    weights : (m,) relative weights of the rows; left out: 1/sigma^2 with the plan's sigma per row where it has one

    A spatial arm stands where its file has it. Its geometry is held by the prior of its machining (`Model.prior`),
    weighed against the plan's sigma, else the arm's, as by `estimate` with sigma="given".

    Raises `InputError` for shapes that do not fit, `JobError` naming what the plan does not identify.
    """
    if not isinstance(plan, Measurements):
        postures = np.atleast_2d(np.asarray(plan, dtype=float))
        plan = Measurements(postures, np.zeros((len(postures), model.dimension)))
    measured, (m, d) = np.asarray(positions, dtype=float), (len(plan), model.dimension)
    if measured.ndim != 3 or measured.shape[1:] != (m, d):
        raise InputError(f"positions: shape {measured.shape}, allowed: (K, {m}, {d})")
    check_measurements(model, replace(plan, positions=np.zeros((m, d))))
    sigma = "estimated" if plan.sigma is None else plan.sigma  # never the arm's sigma, but to weigh a prior against
    prior = Prior(model.prior) if model.prior else None
    problem = replace(Problem.of(model, plan, sigma if prior is None else "given", weights, prior), positions=measured)
    decomposed = spectrum(problem.jacobian(problem.start), model.scales, problem.tolerance, problem.prior_rows)
    undetermined = identifiability_of(decomposed, model.names, model.scales).combinations
    if undetermined:
        raise JobError(f"the plan does not identify: {'; '.join(undetermined)}")
    if (form := problem.exact_form) is None:
        return _iterated(problem)
    # one pseudo-inverse for all (identification/README.md, "Closed form")
    solve = form.solver(problem.postures, problem.weights, problem.tolerance)
    parameters, rss, _ = _not_fitted(len(measured), model)
    for part in _chunks(len(measured), m):
        parameters[part], rss[part] = solve(measured[part])
    return BatchFit(parameters, rss, outcomes(np.isfinite(rss), Status.converged, Status.solver_failed))


def _iterated(problem: Problem) -> BatchFit:
    """From the closed form, by the chord method with one matrix for all, then with their own, last by
    `levenberg_marquardt`."""
    count, m = problem.positions.shape[:2]
    parameters, rss, status = _not_fitted(count, problem.model)
    for part in _chunks(count, m):
        parameters[part] = starts(problem.rows(part))
    usable = np.all(np.isfinite(parameters), axis=1)
    center = np.mean(parameters[usable], axis=0) if usable.any() else problem.start
    shared = np.concatenate([problem.jacobian(center), problem.prior_rows])[None]
    stationary = np.zeros(count, dtype=bool)
    for attempt in range(3):
        rest = np.flatnonzero(~stationary)
        for part in _chunks(len(rest), m):
            sets = rest[part]
            problems = problem.rows(sets)
            jacobians = shared if attempt == 0 else problems.linearize(parameters[sets], np.arange(len(sets)))[1]
            parameters[sets], rss[sets], stationary[sets] = chord_steps(problems, jacobians, parameters[sets])
    status[stationary] = Status.converged
    rest = np.flatnonzero(~stationary)
    for part in _chunks(len(rest), m):
        sets = rest[part]
        solution = levenberg_marquardt(problem.rows(sets).least_squares, parameters[sets])
        parameters[sets], rss[sets], status[sets] = solution.parameters, solution.squares, solution.status
    return BatchFit(parameters, rss - np.sum((parameters @ problem.prior_rows.T) ** 2, axis=1), status)


def chord_steps(problem: Problem, jacobians: Array, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Parameters (k, p), weighted sums of squares (k,) and stationary (k,); of data sets that are left to others the
    last parameters inside the bounds to which steps led quickly.

    jacobians : (k, N, p) of each data set with the rows of the prior; (1, N, p): one for all
    """
    lower, upper = problem.bounds
    held, table = (
        problem.prior_rows.T @ problem.prior_rows,
        problem.model.condition_table(problem.postures, problem.conditions),
    )
    lengths = np.linalg.norm(jacobians, axis=1)
    unit = jacobians / lengths[:, None]
    inverse = np.linalg.inv(information_matrix(unit[:, :, None])) / lengths[:, None]  # for scaled gradients
    parameters, squares, stationary = starts.copy(), np.full(len(starts), np.nan), np.zeros(len(starts), dtype=bool)
    index, x, last = np.arange(len(starts)), starts, np.full(len(starts), np.inf)
    data, rounding = np.ascontiguousarray(np.moveaxis(problem.positions, -1, 0)), problem.rounding
    for _ in range(12):
        arguments = problem.postures, table, x[:, None, :], np.moveaxis(data, 0, -1)
        gradients, by_row = problem.model.residual_gradient(*arguments)
        # components come first in memory, so these sums over rows are products with contiguous memory
        pull = x @ held
        gradient = (np.moveaxis(gradients[..., 0], -1, 0) @ problem.weights).T - pull
        cost = by_row[..., 0, 0] @ problem.weights + np.einsum("kp,kp->k", pull, x)
        gradient /= lengths
        size = np.max(np.abs(gradient), axis=1)
        inside = np.all((x >= lower) & (x <= upper), axis=1)
        done = (size <= GRADIENT_TOLERANCE * np.sqrt(cost) + rounding) & inside
        finished = index[done]
        squares[finished], stationary[finished] = cost[done], True
        contracts = size <= 0.3 * last  # a step that shrinks the gradient by less hands the data set over
        parameters[index[(contracts | done) & inside]] = x[(contracts | done) & inside]
        going = ~done & contracts
        if not going.any():
            break
        index, last, rounding = index[going], size[going], rounding[going]
        data = data if going.all() else np.ascontiguousarray(data[:, going])
        if len(inverse) > 1:
            lengths, inverse = lengths[going], inverse[going]
        down = gradient[going]
        x = x[going] + (down @ inverse[0] if len(inverse) == 1 else (down[:, None] @ inverse)[:, 0])
    return parameters, squares, stationary


# -- plans of their own ------------------------------------------------------------------------------------------------
def estimate_each(
    model: Model, postures: ArrayLike, positions: ArrayLike, conditions: Conditions | None = None
) -> BatchFit:
    """Fits every data set on its own plan, each as `estimate` would with equal weights.

    postures : (K, m, n) [rad], each plan in the order of measurement;  positions : (K, m, d) [mm]
    conditions : (K, m), None: those of that order
    `parameters` are not numbers and `converged` is False where a plan does not make all parameters estimable.
    Raises `InputError` for shapes that do not fit.
    """
    plans, measured = np.asarray(postures, dtype=float), np.asarray(positions, dtype=float)
    n, d = model.joints, model.dimension
    if plans.ndim != 3 or plans.shape[-1] != n:
        raise InputError(f"postures: shape {plans.shape}, allowed: (K, m, {n})")
    if measured.shape != (*plans.shape[:2], d):
        raise InputError(f"positions: shape {measured.shape}, allowed: {(*plans.shape[:2], d)}")
    count, m, _ = plans.shape
    parameters, rss, status = _not_fitted(count, model)
    for part in _chunks(count, m):
        of_sets = sessions(plans[part], model.remembers) if conditions is None else conditions.rows(part)
        problem = Problem(model, plans[part], of_sets, measured[part], np.ones(m))
        jacobians = model.jacobian(problem.postures, problem.start, problem.conditions)
        estimable = np.flatnonzero(full_rank(jacobians, model.scales))
        if estimable.size:
            solve, sets = linear if problem.exact_form else damped_gauss_newton, estimable + part.start
            solution = solve(problem.rows(estimable))
            parameters[sets], rss[sets], status[sets] = solution.parameters, solution.squares, solution.status
    return BatchFit(np.where((status == Status.converged)[:, None], parameters, np.nan), rss, status)


def sessions(postures: Array, remembers: bool = False) -> Conditions:
    """Conditions (..., m) of plans (..., m, n) that are measured in their order, as `Measurements.conditions` of each.

    remembers : with the past of the joints, which takes time
    """
    time = np.broadcast_to(session_time(np.arange(postures.shape[-2], dtype=float)), postures.shape[:-1])
    past = past_from_order(postures) if remembers else None
    return Conditions(time=time, directions=directions_from_order(postures), past=past)
