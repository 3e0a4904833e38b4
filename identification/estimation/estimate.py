"""`estimate`: checks the data, chooses the method, and states what the data tell and how well."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from identification.arrays import Array
from identification.errors import InputError, JobError, nearest
from identification.estimation.gauss_newton import gauss_newton
from identification.estimation.paper_steps import paper_steps
from identification.estimation.planar_linear import linear
from identification.estimation.problem import Fit, Problem
from identification.estimation.result import Identification
from identification.information import RANK_TOLERANCE, Identifiability, Spectrum, identifiability_of, spectrum
from identification.measurements import Measurements
from identification.model import DIMENSION, Model
from identification.status import Status

METHODS: Mapping[str, Callable[[Problem], Fit]] = {
    "linear": linear,
    "gauss_newton": gauss_newton,
    "paper_steps": paper_steps,
}
LOST_SHARE = 0.1  # a combination whose deviation exceeds this share of the arm's reach is not told by the data


class Noise(NamedTuple):
    """Weights of the rows and the standard deviation of one coordinate; `sigma` is None where it must be estimated."""

    weights: Array  # (m,) 1/sigma_i^2 where sigma is known, else relative
    sigma: float | None  # root mean square over rows [mm]


def estimate(
    model: Model,
    measurements: Measurements,
    method: str | None = None,
    sigma: ArrayLike | Literal["estimated"] | None = None,
    weights: ArrayLike | None = None,
) -> Identification:
    """Least-squares estimates of the model's parameters (eq. 3), with covariance (eq. 17) and 95 % intervals.

    method : `linear` (closed form, the default where the model is linear in its links), `gauss_newton` (the default
        for every other model) or `paper_steps`
    sigma : standard deviation of one coordinate [mm], one number or (m,); "estimated": from the residuals, whatever
        the data say. Left out: the data's sigma per row, else the arm's, else estimated
    weights : (m,) relative weights >= 0 of the rows, on top of sigma: the variance of row i is sigma^2 / weights_i, so
        a row of weight 3 moves the estimates as three equal rows would; rows of weight 0 are left out

    A plan that cannot tell everything is no error: what it does tell is estimated, the rest is named in
    `not_identifiable`, and `status` says so. Raises `InputError` for data that do not fit the model, `JobError` if the
    method fails.
    """
    check(model, measurements)
    noise = weighting(model, measurements, sigma, weights)
    chosen = method or ("linear" if model.linear_in_links else "gauss_newton")
    if chosen not in METHODS:
        raise InputError(f"method: unknown name {chosen!r}, {nearest(chosen, METHODS)}")
    problem = Problem(model, measurements, noise.weights)
    fit, found = _solve(problem, chosen, noise)
    if not fit.status.succeeded:
        raise JobError(f"{chosen}: {fit.status.value} Nothing damps this method; gauss_newton may do better.")
    told = identifiability_of(found, model.names, model.scales)
    return _result(problem, chosen, fit, found, told, noise)


def check(model: Model, measurements: Measurements) -> None:
    """Raises `InputError` for other kinds, the wrong number of joints, data that effects lack, too few equations."""
    _check_kind("model", model, Model, "a Model, as in Model(arm)")
    _check_kind("measurements", measurements, Measurements, "Measurements, as load_measurements(path) gives")
    n, m, p = model.arm.links, len(measurements), len(model.parameters)
    if measurements.links != n:
        raise InputError(f"measurements: {measurements.links} joints for an arm of {n} links, allowed: {n}")
    if measurements.dimension != model.dimension:
        allowed = f"allowed: {model.dimension} as the model has"
        raise InputError(f"measurements: positions of {measurements.dimension} coordinates, {allowed}")
    if p == 0:
        raise InputError("model: every parameter is known, allowed: at least one to estimate")
    for effect in model.effects:
        if "temperature" in effect.needs and measurements.temperature is None:
            raise InputError(f"effects: {effect.key} needs the column temperature_C, the measurements have none")
        if "gravity" in effect.needs and model.arm.gravity is None:
            raise InputError(
                f"effects: {effect.key} needs gravity torques, allowed: an arm file with a [gravity] table"
            )
    if DIMENSION * m < p:
        found = f"{DIMENSION} m = {DIMENSION * m} < p = {p}"
        raise InputError(f"measurements: fewer equations than unknowns: {found}, allowed: m >= {-(-p // DIMENSION)}")


def _check_kind(name: str, value: object, kind: type, allowed: str) -> None:
    if not isinstance(value, kind):
        raise InputError(f"{name}: found {type(value).__name__}, allowed: {allowed}")


def weighting(
    model: Model, measurements: Measurements, sigma: ArrayLike | str | None, weights: ArrayLike | None
) -> Noise:
    """Which sigma holds (argument, then rows, then arm), and the weights that follow. Raises `InputError`."""
    m = len(measurements)
    relative = np.ones(m) if weights is None else np.asarray(weights, dtype=float)
    if relative.shape != (m,) or not np.all(np.isfinite(relative) & (relative >= 0.0)) or not np.any(relative):
        raise InputError(f"weights: shape {relative.shape}, allowed: ({m},) finite numbers >= 0, not all zero")
    if isinstance(sigma, str):
        if sigma != "estimated":
            raise InputError(f"sigma: {sigma!r}, allowed: numbers [mm] or 'estimated'")
        return Noise(relative, None)
    given = next((s for s in (sigma, measurements.sigma, model.arm.sigma) if s is not None), None)
    if given is None:
        return Noise(relative, None)
    deviations = np.asarray(given, dtype=float)
    if deviations.shape not in ((), (m,)) or not np.all(np.isfinite(deviations) & (deviations > 0.0)):
        raise InputError(f"sigma_mm: shape {deviations.shape}, allowed: one number or ({m},), each finite and > 0")
    return Noise(relative / deviations**2, float(np.sqrt(np.mean(deviations**2))))


def _solve(problem: Problem, method: str, noise: Noise) -> tuple[Fit, Spectrum]:
    """Fits; and fits again without the combinations whose deviation turns out too large to mean anything."""
    fit = METHODS[method](problem)
    residuals, jacobian = problem.linearize(fit.parameters)
    found = spectrum(jacobian, problem.model.scales, problem.tolerance)
    sigma = noise.sigma or _estimated(residuals, found.rank) or 0.0
    reach = float(np.sum(problem.model.arm.lengths))
    useful = max(RANK_TOLERANCE, sigma / (np.sqrt(len(problem.measurements)) * LOST_SHARE * reach))
    if found.truncated(min(useful, 0.1)).rank == found.rank:
        return fit, found
    problem = problem.with_tolerance(min(useful, 0.1))
    fit = METHODS[method](problem)
    return fit, spectrum(problem.linearize(fit.parameters)[1], problem.model.scales, problem.tolerance)


def _estimated(residuals: Array, rank: int) -> float | None:
    dof = residuals.size - rank
    return float(np.sqrt(np.sum(residuals**2) / dof)) if dof > 0 else None


def _result(
    problem: Problem, method: str, fit: Fit, found: Spectrum, told: Identifiability, noise: Noise
) -> Identification:
    model, data = problem.model, problem.measurements
    before = data.positions - model.position(data.postures, problem.start, problem.conditions)
    after = data.positions - model.position(data.postures, fit.parameters, problem.conditions)
    weighted = float(np.sum(problem.root_weights**2 * after**2))
    dof = DIMENSION * int(np.count_nonzero(problem.weights)) - told.rank
    known = noise.sigma is not None
    sigma = noise.sigma if known else _estimated((problem.root_weights * after)[problem.weights > 0.0], told.rank)
    unit = 1.0 if known else (np.nan if sigma is None else sigma)
    return Identification(
        model=model,
        parameters=fit.parameters,
        covariance=unit**2 * found.covariance,
        identifiable=told.identifiable,
        not_identifiable=told.combinations,
        sigma=sigma,
        sigma_known=known,
        chi2=weighted if known else None,
        dof=dof,
        residuals_before=before,
        residuals_after=after,
        method=method,
        status=Status.not_identifiable if told.combinations else fit.status,
        iterations=fit.iterations,
        provenance=data.provenance,
    )
