"""The least-squares problem of a fit: what must hold of data and model, their weighted residuals, and the methods.

A problem is posed (`Problem.of`) and solved, by one of `METHODS` or about values of its parameters (`LinearProblem`);
what follows from its solution is an `Identification` or a `BatchFit`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import (
    Index,
    LeastSquares,
    Solution,
    compressed,
    levenberg_marquardt,
    outcomes,
    truncated_steps,
)
from identification.estimation.prior import Prior
from identification.information import RANK_TOLERANCE, column_lengths
from identification.kinematics.closed_form import PlanarClosedForm
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.status import Status

RELIANCE = ("given", "estimated")
WITH = {  # what an effect needs -> where it comes from
    "temperature": "with it",
    "gravity": "an arm file with a [gravity] table",
    "distance": "an arm file with an [instrument] of kind distance",
}
ROUNDING = 1e-14  # of a coordinate, after a chain of some ten operations


# -- what must hold ----------------------------------------------------------------------------------------------------
def check_measurements(model: Model, measurements: Measurements, prior: Prior | None = None) -> None:
    """Raises `InputError` for other kinds, the wrong number of joints, data that effects lack, too few equations.

    prior : of parameters that need no equation, besides those of the model
    """
    for name, value, needed, allowed in (
        ("model", model, "linearize", "a Model, as in Model(arm)"),
        ("measurements", measurements, "positions", "Measurements, as load_measurements(path) gives"),
    ):
        if not hasattr(value, needed):
            raise InputError(f"{name}: found {type(value).__name__}, allowed: {allowed}")
    n, m, p = model.joints, len(measurements), len(model.parameters)
    if measurements.links != n:
        raise InputError(f"measurements: {measurements.links} joints for an arm of {n} links, allowed: {n}")
    if measurements.dimension not in getattr(model, "dimensions", (model.dimension,)):
        allowed = f"allowed: {model.dimension} as the model has"
        raise InputError(f"measurements: positions of {measurements.dimension} coordinates, {allowed}")
    if p == 0:
        raise InputError("model: every parameter is known, allowed: at least one to estimate")
    for effect in model.effects:
        for need, lacks, what in (
            ("temperature", measurements.temperature is None, "the column temperature_C, the measurements have none"),
            ("gravity", model.arm.gravity is None, "gravity torques"),
            ("distance", "distance" not in model.arm.offers, "measured distances"),
        ):
            if lacks and need in effect.needs:
                raise InputError(f"effects: {effect.key} needs {what}, allowed: {WITH[need]}")
    held = {*model.prior, *(() if prior is None else prior.names)}
    p -= len(held & set(model.names))
    if (d := measurements.dimension) * m < p:
        counted = f"{d} m = {d * m} < p = {p}"
        file = measurements.provenance.get("file", "measurements")
        raise InputError(f"{file}: fewer equations than unknowns: {counted}, allowed: m >= {-(-p // d)}")


def weighting(
    model: Model, measurements: Measurements, sigma: ArrayLike | str | None, weights: ArrayLike | None
) -> tuple[Array, float | None]:
    """(m,) weights of the rows, 1/sigma_i^2 where sigma is known, else relative; and the root mean square of sigma over
    rows [mm], None where it must be estimated.

    Which sigma holds: argument, then rows, then arm. Of rows that are copied the first counts, the others have no
    weight. Raises `InputError`.
    """
    m = len(measurements)
    relative = np.ones(m) if weights is None else np.asarray(weights, dtype=float)
    if relative.shape != (m,) or not np.all(np.isfinite(relative) & (relative >= 0.0)) or not np.any(relative):
        raise InputError(f"weights: shape {relative.shape}, allowed: ({m},) finite numbers >= 0, not all zero")
    relative = np.where(measurements.originals == np.arange(len(measurements)), relative, 0.0)
    if isinstance(sigma, str) and sigma not in RELIANCE:
        raise InputError(f"sigma: {sigma!r}, allowed: numbers [mm], {' or '.join(map(repr, RELIANCE))}")
    numbers = None if isinstance(sigma, str) else sigma
    stated = next((s for s in (numbers, measurements.sigma, model.sigma) if s is not None), None)
    if stated is None and isinstance(sigma, str) and sigma == "given":
        allowed = "measurement.sigma_mm in the arm file, or a column sigma_mm in the measurements"
        raise InputError(f"sigma: 'given', but none is given, allowed: {allowed}")
    if stated is None or (isinstance(sigma, str) and sigma == "estimated"):
        return relative, None
    deviations = np.asarray(stated, dtype=float)
    if deviations.shape not in ((), (m,)) or not np.all(np.isfinite(deviations) & (deviations > 0.0)):
        raise InputError(f"sigma_mm: shape {deviations.shape}, allowed: one number or ({m},), each finite and > 0")
    return relative / deviations**2, float(np.sqrt(np.mean(deviations**2)))


# -- the problem -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Problem:
    """min over the parameters of sum_i w_i |measured_i - position_i|^2 (eq. 3, with weights), for K data sets.

    postures : (m, n) [rad] that all data sets share, with conditions (m,); or (K, m, n), each its own, and (K, m)
    positions : (K, m, d) measured [mm]
    weights : (m,) of the rows, 1/sigma_i^2 where sigma is known
    sigma : root mean square over rows [mm] of the standard deviation that the weights are of; None: unknown
    reliance : `given` or `estimated`: what intervals rely on whatever the residuals say; None: they may decide
    tolerance : singular values below this share of the largest do not count; along them nothing is estimated
    prior : of the parameters, r rows more;  noise : standard deviation of weighted residuals, 1 where sigma is known
    """

    model: Model
    postures: Array
    conditions: Conditions
    positions: Array
    weights: Array
    sigma: float | None = None
    reliance: str | None = None
    tolerance: float = RANK_TOLERANCE
    prior: Prior | None = None
    noise: float = 1.0

    @classmethod
    def of(
        cls,
        model: Model,
        measurements: Measurements,
        sigma: ArrayLike | str | None = None,
        weights: ArrayLike | None = None,
        prior: Prior | None = None,
    ) -> Problem:
        """The problem of one data set;  sigma, weights : as of `estimate`. Raises `InputError`."""
        weighted, deviation = weighting(model, measurements, sigma, weights)
        reliance = sigma if isinstance(sigma, str) else None if sigma is None else "given"
        rows = measurements.postures, measurements.conditions, measurements.positions[None], weighted
        return cls(model, *rows, deviation, reliance, prior=prior)

    @property
    def exact_form(self) -> PlanarClosedForm | None:
        """The model's closed form if that is the solution; None: there is none, or it is a start only."""
        form = self.model.closed_form
        return form if form is not None and form.exact and self.prior is None else None

    def rows(self, index: Index | NDArray[np.bool_] | slice) -> Problem:
        """The problem of some of the data sets."""
        chosen = replace(self, positions=self.positions[index])
        if self.postures.ndim == 2:
            return chosen
        return replace(chosen, postures=self.postures[index], conditions=self.conditions.rows(index))

    @cached_property
    def root_weights(self) -> Array:
        """(m, 1) square roots of the weights."""
        return np.sqrt(self.weights)[:, None]

    @property
    def equations(self) -> int:
        """Of a data set: coordinates of rows of weight above zero."""
        return self.model.dimension * int(np.count_nonzero(self.weights))

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """(p,) lower and (p,) upper physical bounds, API units."""
        return self.model.parameters.lower, self.model.parameters.upper

    @cached_property
    def start(self) -> Array:
        """(p,) best known values, moved inside the bounds."""
        return np.clip(self.model.values, *self.bounds)

    @cached_property
    def rounding(self) -> Array:
        """(K,) norms of the weighted residuals that rounding errors of coordinates of this size make."""
        return ROUNDING * np.sqrt(np.einsum("kmd,m->k", self.positions**2, self.weights))

    @cached_property
    def prior_rows(self) -> Array:
        """(r, p) rows of the prior in the Jacobian, see `Prior.rows`."""
        nothing = np.zeros((0, len(self.model.parameters)))
        return nothing if self.prior is None else self.prior.rows(self.model.parameters, self.noise)

    @cached_property
    def prior_center(self) -> Array:
        """(p,) means of the prior, see `Prior.center`."""
        parameters = self.model.parameters
        return np.zeros(len(parameters)) if self.prior is None else self.prior.center(parameters)

    @property
    def least_squares(self) -> LeastSquares:
        """The problem in the solver's form; tall problems are reduced to their QR triangle."""

        def linearize(parameters: Array, index: Index) -> tuple[Array, Array]:
            return compressed(*self.linearize(parameters, index))

        return LeastSquares(linearize, *self.bounds, self.model.scales, self.rounding, self.tolerance)

    def residuals(self, parameters: Array) -> Array:
        """(K, m, d) measured less computed [mm], for parameters (p,) or (K, p)."""
        return self.positions - self.model.position(self.postures, parameters, self.conditions)

    def squares(self, parameters: Array) -> Array:
        """(K,) weighted sums of squares."""
        return np.einsum("kmd,m->k", self.residuals(parameters) ** 2, self.weights)

    def linearize(self, parameters: Array, index: Index) -> tuple[Array, Array]:
        """(k, m d + r) weighted residuals of the data sets numbered (k,) and the (k, m d + r, p) weighted Jacobian."""
        chosen = self if len(index) == len(self.positions) else self.rows(index)
        position, jacobian = self.model.linearize(chosen.postures, parameters, chosen.conditions)
        residuals = self.root_weights * (chosen.positions - position)
        jacobian *= self.root_weights[:, :, None]  # in place: new memory takes as long as the product
        k, m, d, p = jacobian.shape
        residuals, jacobian = residuals.reshape(k, m * d), jacobian.reshape(k, m * d, p)
        if len(rows := self.prior_rows) == 0:
            return residuals, jacobian
        left = (self.prior_center - parameters) @ rows.T
        prior_rows = np.broadcast_to(rows, (k, *rows.shape))
        return np.concatenate([residuals, left], axis=1), np.concatenate([jacobian, prior_rows], axis=1)

    def linearized(self, parameters: Array) -> LinearProblem:
        """The problem of the first data set about parameters (p,)."""
        whole = self if self.prior is None else replace(self, prior=None)
        residuals, jacobians = whole.least_squares.linearize(parameters[None], np.arange(1))
        return LinearProblem(self, parameters, residuals[0], jacobians[0])

    def jacobian(self, parameters: Array) -> Array:
        """(m d, p) weighted Jacobian of the plan that the data sets share, at parameters (p,), without the prior."""
        jacobian = self.root_weights[:, :, None] * self.model.jacobian(self.postures, parameters, self.conditions)
        return jacobian.reshape(-1, jacobian.shape[-1])


class LinearProblem(NamedTuple):
    """A problem about values x of its parameters, without its prior, in as few rows as say the same.

    residual : (N,) and jacobian : (N, p), both weighted
    """

    problem: Problem
    x: Array
    residual: Array
    jacobian: Array

    def squares(self, prior: Prior, noise: float) -> float:
        """Least weighted squares, of measurements and a prior together, in units of the noise."""
        parameters = self.problem.model.parameters
        rows = prior.rows(parameters, noise)
        whole = np.concatenate([self.jacobian, rows])
        target = np.concatenate([self.residual, rows @ (prior.center(parameters) - self.x)])
        scaled = whole / np.maximum(np.linalg.norm(whole, axis=0), np.finfo(float).tiny)
        left = target - scaled @ np.linalg.lstsq(scaled, target, rcond=None)[0]
        return float(left @ left) / noise**2


# -- the methods -------------------------------------------------------------------------------------------------------
def linear(problem: Problem) -> Solution:
    """Exact global minimiser of a model with a closed form. Raises `InputError` for any other model."""
    form = problem.exact_form
    if form is None:
        allowed = "lengths and offsets, nothing known, and no effect but base_offset; use gauss_newton"
        raise InputError(f"method: linear does not fit this model, allowed: {allowed}")
    parameters, squares = form.solver(problem.postures, problem.weights, problem.tolerance)(problem.positions)
    status = outcomes(np.isfinite(squares), Status.converged, Status.solver_failed)
    return Solution(parameters, squares, np.zeros(parameters.shape, dtype=bool), status, np.ones(len(squares), int))


def damped_gauss_newton(problem: Problem) -> Solution:
    """A stationary point within the bounds, by damped Gauss-Newton steps (Levenberg-Marquardt) from `starts`."""
    return levenberg_marquardt(problem.least_squares, starts(problem))


def paper_steps(problem: Problem) -> Solution:
    """The paper's iteration (Section III, Steps 1-5): the linearised solution of eq. 11, repeated until the correction
    is below 1e-12 of the reach ("required accuracy").

    Step 1 starts at zero errors, Step 2 computes positions, Step 3 solves eq. 11 for the residuals, Step 4 corrects the
    model, Step 5 repeats. Nothing damps it and it knows no bounds. A linear change of coordinates does not change the
    iteration, so orientation offsets (the paper's) and joint offsets (ours) take the same steps.

    Raises `InputError` for parameters with bounds.
    """
    model = problem.model
    for parameter in model.parameters:
        if np.isfinite(parameter.lower) or np.isfinite(parameter.upper):
            bounded = f"{parameter.name} is bounded to [{parameter.lower:g}, {parameter.upper:g}]"
            raise InputError(f"method: paper_steps knows no bounds, {bounded}; allowed: gauss_newton")
    errors, status, iteration = np.zeros(len(model.parameters)), Status.iteration_limit, 0  # Step 1
    while status is Status.iteration_limit and iteration < 50:
        iteration += 1
        residuals, jacobian = (rows[0] for rows in problem.linearize(errors[None], np.arange(1)))  # Step 2
        # Step 3, eq. 11: the least-squares solution, the shortest where the rank is not full
        lengths, zero = column_lengths(np.linalg.norm(jacobian, axis=0), model.scales)
        columns = np.where(zero, 0.0, jacobian / lengths)
        correction = truncated_steps(columns[None], residuals[None], np.zeros(1), problem.tolerance)[0][0] / lengths
        errors = errors + correction  # Step 4
        if not np.all(np.isfinite(errors)):
            errors, status = np.zeros(len(errors)), Status.solver_failed
        elif np.linalg.norm(correction * model.scales) <= 1e-12 * model.reach:  # Step 5
            status = Status.converged
    parameters = errors[None]
    ends = np.array([status], dtype=object), np.array([iteration])
    return Solution(parameters, problem.squares(parameters), np.zeros(parameters.shape, dtype=bool), *ends)


METHODS: Mapping[str, Callable[[Problem], Solution]] = {
    "linear": linear,
    "gauss_newton": damped_gauss_newton,
    "paper_steps": paper_steps,
}


def starts(problem: Problem) -> Array:
    """(K, p) the closed form of the model without its effects, or the best known values where those fit better.

    The closed form makes any size of joint offset harmless: it is the global minimiser of the model without effects.
    """
    best_known = np.tile(problem.start, (len(problem.positions), 1))
    if isinstance(problem.model, Model):
        instrument = problem.model.arm.chain.instrument
        names = {parameter.name for parameter in instrument.parameters}
        if numbers := [k for k, name in enumerate(problem.model.names) if name in names]:
            # those of the instrument as they explain the readings best, and all others as they fit best with those of
            # them that the instrument holds first
            settled, held = instrument.settled(best_known, problem.residuals, numbers)
            least = problem.least_squares

            def linearize(parameters: Array, index: Index) -> tuple[Array, Array]:
                residuals, jacobian = least.linearize(parameters, index)
                jacobian[..., held] = 0.0
                return residuals, jacobian

            return levenberg_marquardt(replace(least, linearize=linearize), settled).parameters if held else settled
    form = problem.model.closed_form
    if form is None:
        return best_known
    solved = best_known.copy()
    solved[:, form.indices] = form.solver(problem.postures, problem.weights, problem.tolerance)(problem.positions)[0]
    if not np.any(problem.start):
        return solved  # nothing is known that the closed form does not know
    return np.where((problem.squares(best_known) < problem.squares(solved))[:, None], best_known, solved)
