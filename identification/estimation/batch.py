"""Fit many data sets at once: on one plan (`estimate_batch`), or each on its own plan (`estimate_each`).

The first serves Monte Carlo studies, bootstraps and fleets of one arm, the second averages over random plans.
A model with a closed form takes a few multiplications per fit. Any other starts there and goes on with
`levenberg_marquardt`; on one plan, steps by inverse normal matrices that are made once come first (the chord method).

Those are steps N^-1 J(p)^T W r with N^-1 taken at one point, for all data sets together or for each, where J(p)^T W r
comes exactly from CasADi's reverse mode at the price of a few position evaluations: no Jacobian, no decomposition per
step, several times as many fits per second as `levenberg_marquardt` gives
(tests/benchmarks/test_speed.py). The matrix only sets the speed: what is accepted is stationary for its
own data set. What does not contract quickly, or meets a physical bound, is left to others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.estimation.levenberg_marquardt import GRADIENT_TOLERANCE, levenberg_marquardt, outcomes
from identification.estimation.prior import Prior
from identification.estimation.problem import (
    Problem,
    check_measurements,
    damped_gauss_newton,
    linear,
    starts,
)
from identification.information import full_rank, identifiability_of, information_matrix, spectrum
from identification.measurements import Conditions, Measurements, directions_from_order, past_from_order, session_time
from identification.model import Model
from identification.status import Status


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
        gradients, by_row = problem.model.expressions.residual_gradient(*arguments)
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
