"""Fit many data sets at once: on one plan (`estimate_batch`), or each on its own plan (`estimate_each`).

The first serves Monte Carlo studies, bootstraps and fleets of one arm, the second averages over random plans.
A model with a closed form takes a few multiplications per fit. Any other starts there and goes on with
`levenberg_marquardt`; on one plan, steps by matrices that are made once come first (`chord`).

Gauss-Newton steps for many data sets on one plan by inverse normal matrices that are made once: the chord method.

Steps N^-1 J(p)^T W r with N^-1 taken at one point, for all data sets together or for each, where J(p)^T W r comes
exactly from CasADi's reverse mode at the price of a few position evaluations: no Jacobian, no decomposition per step,
several times as many fits per second as `levenberg_marquardt` gives (tests/benchmarks/test_identification_speed.py).
The matrix only sets the speed: what is accepted is stationary for its own data set. What does not contract quickly, or
meets a physical bound, is left to others.
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
    weighting,
)
from identification.information import full_rank, identifiability_of, information_matrix, spectrum
from identification.kinematics.closed_form import PlanarClosedForm
from identification.measurements import Conditions, Measurements, directions_from_order, past_from_order, session_time
from identification.model import Model
from identification.status import Status

CHUNK = 20_000  # rows (data sets times postures) at a time: the arrays of one pass stay in the processor's cache


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
    size = max(1, CHUNK // rows)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _empty(count: int, model: Model) -> tuple[Array, Array, NDArray[np.object_]]:
    """Parameters, sums of squares and statuses of data sets that are not fitted."""
    status = np.full(count, Status.not_identifiable, dtype=object)
    return np.full((count, len(model.names)), np.nan), np.full(count, np.nan), status


# -- one plan ------------------------------------------------------------------------------------------------------
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
    problem = _problem(model, plan, np.asarray(positions, dtype=float), weights)
    rows = np.concatenate([problem.jacobian(problem.start), problem.prior_rows])
    decomposed = spectrum(rows, model.scales, problem.tolerance)
    undetermined = identifiability_of(decomposed, model.names, model.scales).combinations
    if undetermined:
        raise JobError(f"the plan does not identify: {'; '.join(undetermined)}")
    return _iterated(problem) if problem.exact_form is None else _closed_form(problem, problem.exact_form)


def _problem(model: Model, plan: Measurements | ArrayLike, measured: Array, weights: ArrayLike | None) -> Problem:
    if not isinstance(plan, Measurements):
        postures = np.atleast_2d(np.asarray(plan, dtype=float))
        plan = Measurements(postures, np.zeros((len(postures), model.dimension)))
    m, d = len(plan), model.dimension
    if measured.ndim != 3 or measured.shape[1:] != (m, d):
        raise InputError(f"positions: shape {measured.shape}, allowed: (K, {m}, {d})")
    prior = Prior(model.prior) if model.prior else None
    check_measurements(model, replace(plan, positions=np.zeros((m, d))))
    of_plan = "estimated" if plan.sigma is None else plan.sigma  # never the arm's sigma, but to weigh a prior against
    noise = weighting(model, plan, of_plan if prior is None else "given", weights)
    return Problem(model, plan.postures, plan.conditions, measured, noise.weights, prior=prior)


def _closed_form(problem: Problem, form: PlanarClosedForm) -> BatchFit:
    """One pseudo-inverse for all (identification/README.md, "Closed form")."""
    solve = form.solver(problem.postures, problem.weights, problem.tolerance)
    count = len(problem.positions)
    parameters, rss = np.empty((count, len(problem.model.names))), np.empty(count)
    for part in _chunks(count, len(problem.postures)):
        parameters[part], rss[part] = solve(problem.positions[part])
    return BatchFit(parameters, rss, outcomes(np.isfinite(rss), Status.converged, Status.solver_failed))


def _iterated(problem: Problem) -> BatchFit:
    count, m = problem.positions.shape[:2]
    parameters, rss, status = _empty(count, problem.model)
    for part in _chunks(count, m):
        parameters[part] = starts(problem.rows(part))
    usable = np.all(np.isfinite(parameters), axis=1)
    center = np.mean(parameters[usable], axis=0) if usable.any() else problem.start
    shared = Chord(problem, np.concatenate([problem.jacobian(center), problem.prior_rows])[None])
    stationary = np.zeros(count, dtype=bool)
    for part in _chunks(count, m):
        parameters[part], rss[part], stationary[part] = shared.solve(problem.rows(part), parameters[part])
    for _ in range(2):
        rest = np.flatnonzero(~stationary)
        for part in _chunks(len(rest), m):
            sets = rest[part]
            problems = problem.rows(sets)
            chord = Chord(problems, problems.linearize(parameters[sets], np.arange(len(sets)))[1])
            parameters[sets], rss[sets], stationary[sets] = chord.solve(problems, parameters[sets])
    status[stationary] = Status.converged
    rest = np.flatnonzero(~stationary)
    for part in _chunks(len(rest), m):
        sets = rest[part]
        solution = levenberg_marquardt(problem.rows(sets).least_squares, parameters[sets])
        parameters[sets], rss[sets], status[sets] = solution.parameters, solution.squares, solution.status
    return BatchFit(parameters, rss - np.sum((parameters @ problem.prior_rows.T) ** 2, axis=1), status)


# -- plans of their own --------------------------------------------------------------------------------------------
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
    _check_plans(model, plans, measured)
    count, m, _ = plans.shape
    parameters, rss, status = _empty(count, model)
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


def _check_plans(model: Model, plans: Array, measured: Array) -> None:
    n, d = model.joints, model.dimension
    if plans.ndim != 3 or plans.shape[-1] != n:
        raise InputError(f"postures: shape {plans.shape}, allowed: (K, m, {n})")
    if measured.shape != (*plans.shape[:2], d):
        raise InputError(f"positions: shape {measured.shape}, allowed: {(*plans.shape[:2], d)}")


def sessions(postures: Array, remembers: bool = False) -> Conditions:
    """Conditions (..., m) of plans (..., m, n) that are measured in their order, as `Measurements.conditions` of each.

    remembers : with the past of the joints, which takes time
    """
    time = np.broadcast_to(session_time(np.arange(postures.shape[-2], dtype=float)), postures.shape[:-1])
    past = past_from_order(postures) if remembers else None
    return Conditions(time=time, directions=directions_from_order(postures), past=past)


STEPS = 12
CONTRACTION = 0.3  # a step that shrinks the gradient by less hands the data set over


class Chord:
    """Inverse normal matrices of a problem, and exact gradients anywhere."""

    def __init__(self, problem: Problem, jacobians: Array) -> None:
        """jacobians : (k, N, p) of each data set with the rows of the prior; (1, N, p): for all"""
        self._known = problem.prior_rows.T @ problem.prior_rows
        self._lengths = np.linalg.norm(jacobians, axis=1)
        scaled = jacobians / self._lengths[:, None]
        # for scaled gradients
        self._inverse = np.linalg.inv(information_matrix(scaled[:, :, None])) / self._lengths[:, None]
        self._table = problem.model.condition_table(problem.postures, problem.conditions)

    def gradient(self, problem: Problem, measured: Array, parameters: Array) -> tuple[Array, Array]:
        """(k, p) J^T W r, and (k,) weighted sums of squares, for components-first (d, k, m) data; both with the rows of
        the prior."""
        arguments = problem.postures, self._table, parameters[:, None, :], np.moveaxis(measured, 0, -1)
        gradient, squares = problem.model.expressions.residual_gradient(*arguments)
        # components come first in memory, so these sums over rows are products with contiguous memory
        sums = np.moveaxis(gradient[..., 0], -1, 0) @ problem.weights
        prior = parameters @ self._known
        cost = squares[..., 0, 0] @ problem.weights + np.einsum("kp,kp->k", prior, parameters)
        return sums.T - prior, cost

    def solve(self, problem: Problem, starts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Parameters (k, p), weighted sums of squares (k,) and stationary (k,); of data sets that are left to others
        the last parameters inside the bounds to which steps led quickly."""
        lower, upper = problem.bounds
        parameters, squares, stationary = starts.copy(), np.full(len(starts), np.nan), np.zeros(len(starts), dtype=bool)
        index, x, last = np.arange(len(starts)), starts, np.full(len(starts), np.inf)
        data, rounding = np.ascontiguousarray(np.moveaxis(problem.positions, -1, 0)), problem.rounding
        lengths, inverse = self._lengths, self._inverse
        for _ in range(STEPS):
            gradient, cost = self.gradient(problem, data, x)
            gradient /= lengths
            size = np.max(np.abs(gradient), axis=1)
            inside = np.all((x >= lower) & (x <= upper), axis=1)
            done = (size <= GRADIENT_TOLERANCE * np.sqrt(cost) + rounding) & inside
            finished = index[done]
            squares[finished], stationary[finished] = cost[done], True
            contracts = size <= CONTRACTION * last
            parameters[index[(contracts | done) & inside]] = x[(contracts | done) & inside]
            going = ~done & contracts
            if not going.any():
                break
            index, last, rounding = index[going], size[going], rounding[going]
            data = data if going.all() else np.ascontiguousarray(data[:, going])
            if len(inverse) == 1:
                x = x[going] + gradient[going] @ inverse[0]
                continue
            lengths, inverse = lengths[going], inverse[going]
            x = x[going] + (gradient[going][:, None] @ inverse)[:, 0]
        return parameters, squares, stationary
