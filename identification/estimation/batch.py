"""Many data sets on one plan: Monte Carlo studies, bootstraps, fleets of one arm.

A model that is linear in its links has one pseudo-inverse for all data sets: a fit is a few multiplications. Any other
model starts there and takes steps N^-1 J(p)^T W r with one inverse normal matrix N^-1 shared by all data sets, where
J(p)^T W r comes exactly from CasADi's reverse mode at the price of a few position evaluations. The shared matrix only
sets the speed: what is accepted is stationary for its own data set. What does not contract quickly, or meets a physical
bound, gets damped Gauss-Newton steps of its own (`individual`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.estimation.estimate import check, weighting
from identification.estimation.individual import individual
from identification.estimation.planar_linear import as_complex, design, parameters_of
from identification.estimation.problem import GRADIENT_TOLERANCE, ROUNDING, Problem
from identification.information import identifiability_of, information_matrix, spectrum
from identification.measurements import Measurements
from identification.model import DIMENSION, Model
from identification.vectorize import vectorize

CHUNK = 20_000  # rows (data sets times postures) at a time: the arrays of one pass stay in the processor's cache
SHARED_STEPS = 12
CONTRACTION = 0.3  # a shared step that shrinks the gradient by less hands the data set over


@dataclass(frozen=True, eq=False)
class BatchFit:
    """Fits of K data sets.

    parameters : (K, p) in the order of `model.parameters`, API units
    rss : (K,) weighted sum of squares at the solution; [mm^2] without sigma
    converged : (K,) True where it is stationary: no free column of the Jacobian has a cosine above 1e-9 with the
        residuals (the closed form always is); False for data that are not finite
    """

    parameters: Array
    rss: Array
    converged: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for array in (self.parameters, self.rss, self.converged):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.rss)

    def __repr__(self) -> str:
        k, p = self.parameters.shape
        return f"BatchFit({k} data sets, {p} parameters, {np.count_nonzero(self.converged)} converged)"


def estimate_batch(
    model: Model, plan: Measurements | ArrayLike, positions: ArrayLike, weights: ArrayLike | None = None
) -> BatchFit:
    """Fits every data set, each as `estimate` would.

    plan : measurements whose postures and conditions all data sets share (their positions are not read), or (m, n)
        postures [rad] in the order of measurement
    positions : (K, m, 2) measured [mm]
    weights : (m,) relative weights of the rows; left out: 1/sigma^2 with the plan's sigma per row where it has one

    Raises `InputError` for shapes that do not fit, `JobError` naming what the plan cannot tell apart.
    """
    measured = np.asarray(positions, dtype=float)
    problem = _problem(model, plan, measured, weights)
    lost = identifiability_of(
        spectrum(problem.linearize(problem.start)[1], model.scales, problem.tolerance), model.names, model.scales
    )
    if lost.combinations:
        raise JobError(f"the plan cannot tell apart: {'; '.join(lost.combinations)}")
    if model.linear_in_links:
        return _closed_form(problem, measured)
    return _iterated(problem, measured)


def _problem(model: Model, plan: Measurements | ArrayLike, measured: Array, weights: ArrayLike | None) -> Problem:
    """The shared part, with zeros for the measured positions."""
    if not isinstance(plan, Measurements):
        postures = np.atleast_2d(np.asarray(plan, dtype=float))
        plan = Measurements(postures, np.zeros((len(postures), DIMENSION)))
    m = len(plan)
    if measured.ndim != 3 or measured.shape[1:] != (m, DIMENSION):
        raise InputError(f"positions: shape {measured.shape}, allowed: (K, {m}, {DIMENSION})")
    check(model, replace(plan, positions=np.zeros((m, DIMENSION))))
    without_arm = replace(model.arm, sigma=None)
    return Problem(model, plan, weighting(Model(without_arm, model.known), plan, None, weights).weights)


def _chunks(count: int, rows: int) -> Iterator[slice]:
    size = max(1, CHUNK // rows)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


# -- closed form ---------------------------------------------------------------------------------------------------
def _closed_form(problem: Problem, measured: Array) -> BatchFit:
    """One pseudo-inverse for all (identification/README.md, "Closed form")."""
    count, m, _ = measured.shape
    parameters, rss = np.empty((count, len(problem.model.parameters))), np.empty(count)
    solve = _linear_solver(problem)
    for part in _chunks(count, m):
        parameters[part], rss[part] = solve(measured[part])
    return BatchFit(parameters, rss, np.isfinite(rss))


def _linear_solver(problem: Problem) -> Callable[[Array], tuple[Array, Array]]:
    """(k, m, 2) positions -> parameters (k, p) and weighted sums of squares (k,)."""
    columns, nominal = design(problem.model, problem.measurements.postures)
    root = problem.root_weights
    back = np.ascontiguousarray((np.linalg.pinv(root * columns) * root.T).T)
    forth = np.ascontiguousarray(columns.T)

    def solve(positions: Array) -> tuple[Array, Array]:
        # differences to the nominal arm: the sum of squares then loses no digits
        rest = as_complex(positions) - columns @ nominal
        change = rest @ back
        residuals = (rest - change @ forth) * root[:, 0]
        squares = residuals.view(np.float64)
        return parameters_of(problem.model, nominal + change), np.einsum("ki,ki->k", squares, squares)

    return solve


# -- every other model ---------------------------------------------------------------------------------------------
def _iterated(problem: Problem, measured: Array) -> BatchFit:
    count, m, _ = measured.shape
    parameters, rss, converged = _starts(problem, measured), np.empty(count), np.zeros(count, dtype=bool)
    usable = np.all(np.isfinite(parameters), axis=1)
    shared = _Shared(problem, np.mean(parameters[usable], axis=0) if usable.any() else problem.start)
    for part in _chunks(count, m):
        _shared_steps(problem, shared, measured[part], parameters[part], rss[part], converged[part])
    rest = np.flatnonzero(~converged)
    for part in _chunks(len(rest), m):
        some = rest[part]
        parameters[some], rss[some], converged[some] = individual(problem, measured[some], parameters[some])
    return BatchFit(parameters, rss, converged)


def _starts(problem: Problem, measured: Array) -> Array:
    """(K, p) closed-form lengths and offsets with the effects at their best known values, where nothing is known."""
    model, n = problem.model, problem.model.arm.links
    starts = np.tile(problem.start, (len(measured), 1))
    base = Model(model.arm.with_effects())
    if model.names[: 2 * n] == base.names:
        without = replace(problem, model=base)
        if spectrum(without.linearize(without.start)[1], base.scales).rank == 2 * n:
            starts[:, : 2 * n] = _closed_form(without, measured).parameters
    return starts


class _Shared:
    """The inverse normal matrix at one point, and exact gradients anywhere."""

    def __init__(self, problem: Problem, center: Array) -> None:
        _, jacobian = problem.linearize(center)
        self.lengths = np.linalg.norm(jacobian, axis=0)
        scaled = jacobian / self.lengths
        self.inverse = np.linalg.inv(information_matrix(scaled[:, None, :])) / self.lengths  # for scaled gradients
        data, model = problem.measurements, problem.model
        payload = 0.0 if model.arm.gravity is None else model.arm.gravity.payload
        self._table = problem.conditions.table(len(data), data.links, payload)
        self._postures, self._weights = data.postures, problem.weights
        self._tape = vectorize(gradient_function(model))

    def gradient(self, measured: Array, parameters: Array) -> tuple[Array, Array]:
        """(k, p) J^T W r / column lengths, and (k,) weighted sums of squares, for components-first (2, k, m) data."""
        arguments = self._postures, self._table, parameters[:, None, :], np.moveaxis(measured, 0, -1)
        gradient, squares = self._tape(*arguments)
        # the tape writes components first, so these sums over rows are products with contiguous memory
        sums = np.moveaxis(gradient[..., 0], -1, 0) @ self._weights
        return sums.T / self.lengths, squares[..., 0, 0] @ self._weights


def gradient_function(model: Model) -> ca.Function:
    """CasADi (q, c, p, measured y) -> J^T (y - position) (p) by reverse mode, and |y - position|^2."""
    q, c, p, position = model.symbols
    y = ca.SX.sym("y", DIMENSION)
    outputs = ca.cse([ca.jtimes(position, p, y - position, True), ca.sumsqr(y - position)])
    return ca.Function("gradient", [q, c, p, y], outputs, ["q", "c", "p", "y"], ["gradient", "squares"])


def _shared_steps(
    problem: Problem, shared: _Shared, measured: Array, parameters: Array, rss: Array, converged: NDArray[np.bool_]
) -> None:
    """Steps in place, until every data set is stationary, slow, or outside its bounds."""
    lower, upper = problem.bounds
    active = np.arange(len(measured))
    data = np.ascontiguousarray(np.moveaxis(measured, -1, 0))
    rounding = ROUNDING * np.sqrt(np.sum(data**2 * problem.weights, axis=(0, 2)))
    x, last = parameters.copy(), np.full(len(measured), np.inf)
    for _ in range(SHARED_STEPS):
        gradient, cost = shared.gradient(data, x)
        size = np.max(np.abs(gradient), axis=1)
        inside = np.all((x >= lower) & (x <= upper), axis=1)
        done = (size <= GRADIENT_TOLERANCE * np.sqrt(cost) + rounding) & inside
        finished = active[done]
        parameters[finished], rss[finished], converged[finished] = x[done], cost[done], True
        going = ~done & (size <= CONTRACTION * last)
        if not going.any():
            return
        x = x[going] + gradient[going] @ shared.inverse
        active, last, rounding = active[going], size[going], rounding[going]
        data = data if going.all() else np.ascontiguousarray(data[:, going])
