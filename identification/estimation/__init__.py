"""Fits: of one data set with all that follows from it, or of many at once.

With a normal prior of some parameters the minimum is the mode of the posterior. What the noise amounts to decides how
far the data may move what has a prior: it is the noise of the largest marginal likelihood (`problem.likeliest`), and no
less than a sigma that is given. Many data sets on one plan are fitted by the chord method (`chord_steps`).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.estimation.doubts import doubts_of_fit, far_from_drawing, far_rows, only_rounding
from identification.estimation.problem import NO_PRIOR, Prior, Problem, check_measurements, contradicted, likeliest
from identification.estimation.result import Identification
from identification.estimation.uncertainty import WhiteRows, outlying, together, uncertainty
from identification.information import RANK_TOLERANCE, significant, spectrum
from identification.inspection.readings import placed_with_zeros
from identification.kinematics.counting import joint_range
from identification.kinematics.parameters import JOINT_OFFSET
from identification.levenberg_marquardt import GRADIENT_TOLERANCE, ITERATIONS, Index, Solution, outcomes
from identification.measurements import Measurements
from identification.model import Model
from identification.model.placed import placed_model, placing
from identification.running import Status, single_thread


@single_thread()
def estimate(
    model: Model,
    measurements: Measurements,
    sigma: ArrayLike | Literal["given", "estimated"] | None = None,
    prior: Prior = NO_PRIOR,
) -> Identification:
    """Least-squares estimates of the model's parameters (eq. 3), with covariance (eq. 16) and 95 % intervals.

    model : a `Model`, or another, of any dimension, with the members that `problem.FITTED` lists
    sigma : standard deviation of one coordinate [mm], one number or (m,), which intervals then rely on; "given": the
        same with the data's sigma per row, else the arm's; "estimated": from the residuals, whatever the data say. Left
        out: as "given" as long as chi2 does not contradict it, else the scatter of the residuals
    prior : of parameters; estimates and intervals are then those of the posterior

    Base pose and measured points of a spatial arm are found without starting values, unless the arm gives them; its
    geometry has the prior of its machining. What a plan does not determine is named in `not_identifiable`.

    With a prior the noise is the given one, or that of largest marginal likelihood ("estimated"; left out: no less than
    what is given). The sizes of the machining are those of the model. If the data show that the arm is farther from its
    drawing, they are multiplied by a common factor, and those of joint zeros by a second one, chosen as the likeliest
    together with the noise; `doubts` say so.

    Raises `InputError` for data that do not fit the model, `JobError` if that fails.
    """
    check_measurements(model, measurements, prior)
    if not (prior.names or model.prior):
        problem, useful = Problem.of(placed_model(model, measurements), measurements, sigma), RANK_TOLERANCE
        while True:
            if (form := problem.exact_form) is None:
                solution = problem.minimized(problem.starts())
            else:
                x, squares = form.solver(problem.postures, problem.weights, problem.tolerance)(problem.positions)
                solution = Solution(x, squares, outcomes(np.isfinite(squares), Status.converged, Status.solver_failed))
            if (status := solution.status[0]) is Status.solver_failed:
                raise JobError(f"{problem.method}: {status.value}")
            rows = WhiteRows.of(problem, measurements, solution.parameters[0])
            if useful > RANK_TOLERANCE:
                break
            # once more without the combinations whose standard deviation turns out too large to mean anything: above a
            # tenth of the arm's reach
            deviation = problem.sigma or (float(np.sqrt(rows.squares / rows.freedom)) if rows.freedom > 0 else 0.0)
            uncertain = deviation / np.sqrt(len(measurements))
            useful = float(np.clip(uncertain / (0.1 * problem.model.reach), RANK_TOLERANCE, 0.1))
            if np.count_nonzero(significant(rows.decomposed.values, useful)) == rows.rank:
                break
            problem = replace(problem, tolerance=useful)
        return _identification(problem, measurements, solution, rows)
    # noise and sizes of the prior as they are likeliest at the solution, and the solution with these, in turns until
    # the noise stays
    model, zeros = placed_with_zeros(model, measurements)
    prior = replace(prior, deviations={**model.prior, **prior.deviations})
    check_measurements(model, measurements, prior)
    problem = Problem.of(model, measurements, sigma, prior)
    offsets = {p.name for p in model.parameters if p.kind == JOINT_OFFSET}

    @cache  # fits of other noise pass through the same points
    def about(x: bytes) -> tuple[Array, Array]:
        return problem.linearized(np.frombuffer(x))

    def rows_at(x: Array, _: Index) -> tuple[Array, Array]:
        residual, jacobian = about(x.tobytes())
        return residual[None], jacobian[None]

    # zeros that another reading of the rows has are where the search starts
    x = np.where([n in zeros for n in model.names], model.parameters.vector(zeros, default=0.0), problem.starts()[0])
    before, is_given = np.inf, problem.reliance == "given"
    for turn in range(10):  # the model is nearly linear: of the first round two steps are enough to see the noise
        noise, widths = likeliest(problem, x, *about(x.tobytes()))
        factors = {name: widths[0] * (widths[1] if name in offsets else 1.0) for name in model.prior}
        wide = {name: deviation * factors.get(name, widths[2]) for name, deviation in prior.deviations.items()}
        widened = replace(prior, deviations=wide, own_error=widths[2] * prior.own_error)
        posed = replace(problem, noise=noise, prior=widened)
        solution = posed.minimized(x[None], rows_at, ITERATIONS if turn or is_given else 2)
        x, change, before = solution.parameters[0], abs(noise - before), noise
        goes_on = solution.status[0] is Status.iteration_limit
        if is_given or (turn and (goes_on or change <= 1e-4 * noise)):  # far below its own uncertainty
            break
    fit = _identification(posed, measurements, solution, WhiteRows.of(posed, measurements, x))
    contradiction = contradicted(posed, widened, x) if prior.earlier.parameter_names else None
    factor, doubts = widths[0] if model.prior else None, (*fit.doubts, *far_from_drawing(model.arm, *widths[:2]))
    return replace(fit, prior=posed.prior, machining_factor=factor, doubts=doubts, contradiction=contradiction)


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
            return fitted, tuple((np.setdiff1d(np.arange(len(measurements)), kept) + 1).tolist())
        kept = np.delete(kept, np.array(fitted.outlier_rows) - 1)


def _identification(problem: Problem, data: Measurements, solution: Solution, rows: WhiteRows) -> Identification:
    """The `Identification` of a solution: what is estimable, the uncertainty, and doubts about the fit."""
    model, x, has_sigma = problem.model, solution.parameters[0], problem.sigma is not None
    noise = problem.noise if problem.prior.names else None
    scale = noise if noise is not None else float(np.sqrt(rows.squares / rows.freedom)) if rows.freedom > 0 else None
    scatter = None if scale is None else scale * (problem.sigma or 1.0)
    # a number of each joint that no row shows does nothing: gravity has no moment about a vertical axis
    idle = {p.name for e in model.effects for p in e.parameters if len(e.parameters) > 1 and p.lower == 0.0}
    identifiable, combinations = rows.decomposed.identifiable, rows.decomposed.combinations(model.names, model.scales)
    undetermined = tuple(combination for combination in combinations if combination not in idle)
    # before: where nothing says where a spatial arm stands and what is measured on it, these are fitted in least
    # squares (one Gauss-Newton step from the closed form)
    was, after = problem.start, problem.residuals(x)[0]
    if free := placing(model.parameters):
        (left, slopes), was = problem.rows_about(was), was.copy()
        was[free] += np.linalg.lstsq(slopes[:, free], left, rcond=RANK_TOLERANCE)[0]
    before = problem.residuals(was)[0]
    sentences, implausible = doubts_of_fit(model, x, identifiable, before, after, data)
    # rows that the model does not explain, where enough equations are left to tell
    used, unexplained, p = problem.weights > 0.0, np.zeros(len(after), dtype=bool), len(x)
    if rows.residual.size - p + len(problem.prior_rows) > p and not only_rounding(after, model, data):
        unexplained[used] = outlying(rows.residual, rows.columns, rows.moment)
    structure = together(unexplained, data.postures, data.posture_numbers)
    outlier = unexplained & ~structure
    return Identification(
        model=model,
        parameters=x,
        identifiable=identifiable,
        not_identifiable=undetermined,
        sigma=problem.sigma if has_sigma else scatter,
        chi2=rows.squares if has_sigma else None,
        dof=round(rows.freedom),
        residuals_before=before,
        residuals_after=after,
        method=problem.method,
        status=Status.implausible if implausible else Status.not_identifiable if undetermined else solution.status[0],
        provenance=data.origin | joint_range(data.postures, model.joint_types),
        uncertainty=uncertainty(rows, sigma_given=has_sigma, reliance=problem.reliance, noise=noise),
        scatter=scatter,
        doubts=(*sentences, *far_rows(after, data, getattr(model, "arm", None), outlier, structure)),
        postures=data.postures[np.flatnonzero(used)[np.unique(data.repeat_numbers[used], return_index=True)[1]]],
        inside=rows.inside,
        outlier_rows=tuple((np.flatnonzero(outlier) + 1).tolist()),
        unexplained_rows=tuple((np.flatnonzero(structure) + 1).tolist()),
    )


# -- many data sets ----------------------------------------------------------------------------------------------------
def estimate_batch(model: Model, plan: Measurements | ArrayLike, positions: ArrayLike) -> Solution:
    """Fits every data set, each as `estimate` would.

    plan : measurements whose postures, conditions and sigma per row, if they have one, all data sets share (their
        positions are not read), or (m, n) postures [rad] in the order of measurement
    positions : (K, m, d) measured [mm]

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
    problem = Problem.of(model, plan, "given" if model.prior else sigma, Prior(model.prior), measured)
    decomposed = spectrum(problem.rows_about(problem.start)[1], model.scales, problem.tolerance, problem.prior_rows)
    if undetermined := decomposed.combinations(model.names, model.scales):
        raise JobError(f"the plan does not identify: {'; '.join(undetermined)}")
    x, rss = np.empty((len(measured), len(model.names))), np.empty(len(measured))
    status, form = np.full(len(measured), Status.converged, dtype=object), problem.exact_form
    # one pseudo-inverse for all (identification/README.md, "Closed form")
    solve = form and form.solver(problem.postures, problem.weights, problem.tolerance)
    size = max(1, 20_000 // m)  # rows of all data sets: the arrays of one pass stay in the processor's cache
    for part in (slice(first, first + size) for first in range(0, len(measured), size)):
        if solve:
            x[part], rss[part] = solve(measured[part])
            status[part] = outcomes(np.isfinite(rss[part]), Status.converged, Status.solver_failed)
            continue
        # from the closed form, by the chord method with one matrix for all, then one about where that led the others;
        # what neither brings to an end, by Levenberg-Marquardt
        rest, x[part] = np.arange(len(measured))[part], problem.data_sets(part).starts()
        for _ in range(2):
            usable = x[rest][np.all(np.isfinite(x[rest]), axis=1)]
            center = np.mean(usable, axis=0) if len(usable) else problem.start
            shared = np.concatenate([problem.rows_about(center)[1], problem.prior_rows])
            x[rest], rss[rest], stationary = chord_steps(problem.data_sets(rest), shared, x[rest])
            if not len(rest := rest[~stationary]):
                break
        else:
            each = problem.data_sets(rest).minimized(x[rest])
            x[rest], rss[rest], status[rest] = each.parameters, each.rss, each.status
    rss -= np.sum((x @ problem.prior_rows.T) ** 2, axis=1)
    return Solution(x, rss, status)


def chord_steps(problem: Problem, jacobian: Array, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Parameters (k, p), weighted sums of squares (k,) and stationary (k,); of data sets that are left to others the
    last parameters inside the bounds to which steps led quickly.

    jacobian : (N, p) about one point for all, with the rows of the prior

    Steps are N^-1 J(p)^T W r with N^-1 taken at one point, where J(p)^T W r comes exactly from CasADi's reverse mode at
    the price of a few position evaluations: no Jacobian, no decomposition per step. The matrix only sets the speed:
    what is accepted is stationary for its own data set. What does not contract quickly, or meets a bound, is left.
    """
    model, held = problem.model, problem.prior_rows.T @ problem.prior_rows
    table, data = model.condition_table(problem.postures, problem.conditions), problem.positions
    lengths = np.linalg.norm(jacobian, axis=0)
    unit = jacobian / lengths
    inverse = np.linalg.inv(unit.T @ unit) / lengths  # for scaled gradients
    x, quick, last = starts.copy(), starts.copy(), np.full(len(starts), np.inf)
    for _ in range(12):
        gradients, by_row = model.expressions.residual_gradient(problem.postures, table, x[:, None, :], data)
        # components come first in memory, so these sums over rows are products with contiguous memory
        pull = x @ held
        gradient = ((np.moveaxis(gradients[..., 0], -1, 0) @ problem.weights).T - pull) / lengths
        squares = by_row[..., 0, 0] @ problem.weights + np.einsum("kp,kp->k", pull, x)
        size = np.max(np.abs(gradient), axis=1)
        inside = np.all((x >= model.parameters.lower) & (x <= model.parameters.upper), axis=1)
        stationary = (size <= GRADIENT_TOLERANCE * np.sqrt(squares) + problem.rounding) & inside
        goes_on = ~stationary & inside & (size <= 0.3 * last)  # a step that shrinks the gradient by less is the last
        quick[goes_on | stationary] = x[goes_on | stationary]
        if not goes_on.any():
            break
        x[goes_on] += gradient[goes_on] @ inverse
        last = size
    return quick, squares, stationary
