"""What must hold before a fit: the data suit the model, and what is known of the noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.prior import Prior
from identification.measurements import Measurements
from identification.model import Model

RELIANCE = ("given", "estimated")


class Noise(NamedTuple):
    """Weights of the rows and the standard deviation of one coordinate; `sigma` is None where it must be estimated.

    reliance : what the intervals rely on, see `uncertainty`
    """

    weights: Array  # (m,) 1/sigma_i^2 where sigma is known, else relative
    sigma: float | None  # root mean square over rows [mm]
    reliance: str | None = None


def check_measurements(model: Model, measurements: Measurements, prior: Prior | None = None) -> None:
    """Raises `InputError` for other kinds, the wrong number of joints, data that effects lack, too few equations.

    prior : of parameters that need no equation, besides those of the model
    """
    _check_kind("model", model, "linearize", "a Model, as in Model(arm)")
    _check_kind("measurements", measurements, "positions", "Measurements, as load_measurements(path) gives")
    n, m, p = model.joints, len(measurements), len(model.parameters)
    if measurements.links != n:
        raise InputError(f"measurements: {measurements.links} joints for an arm of {n} links, allowed: {n}")
    if measurements.dimension not in getattr(model, "dimensions", (model.dimension,)):
        allowed = f"allowed: {model.dimension} as the model has"
        raise InputError(f"measurements: positions of {measurements.dimension} coordinates, {allowed}")
    if p == 0:
        raise InputError("model: every parameter is known, allowed: at least one to estimate")
    _check_needs(model, measurements)
    held = {*model.prior, *(() if prior is None else prior.names)}
    p -= len(held & set(model.names))
    if (d := measurements.dimension) * m < p:
        counted = f"{d} m = {d * m} < p = {p}"
        raise InputError(f"measurements: fewer equations than unknowns: {counted}, allowed: m >= {-(-p // d)}")


def _check_needs(model: Model, measurements: Measurements) -> None:
    for effect in model.effects:
        if "temperature" in effect.needs and measurements.temperature is None:
            raise InputError(
                f"effects: {effect.key} needs the column temperature_C, the measurements have none, allowed: with it"
            )
        if "gravity" in effect.needs and model.arm.gravity is None:
            allowed = "an arm file with a [gravity] table"
            raise InputError(f"effects: {effect.key} needs gravity torques, allowed: {allowed}")
        if "distance" in effect.needs - model.arm.offers:
            allowed = "an arm file with an [instrument] of kind distance"
            raise InputError(f"effects: {effect.key} needs measured distances, allowed: {allowed}")


def _check_kind(name: str, value: object, needed: str, allowed: str) -> None:
    if not hasattr(value, needed):
        raise InputError(f"{name}: found {type(value).__name__}, allowed: {allowed}")


def weighting(
    model: Model, measurements: Measurements, sigma: ArrayLike | str | None, weights: ArrayLike | None
) -> Noise:
    """Which sigma holds (argument, then rows, then arm), and the weights that follow; of rows that are copied the first
    counts, the others have no weight. Raises `InputError`."""
    m = len(measurements)
    relative = np.ones(m) if weights is None else np.asarray(weights, dtype=float)
    if relative.shape != (m,) or not np.all(np.isfinite(relative) & (relative >= 0.0)) or not np.any(relative):
        raise InputError(f"weights: shape {relative.shape}, allowed: ({m},) finite numbers >= 0, not all zero")
    relative = np.where(measurements.originals == np.arange(len(measurements)), relative, 0.0)
    if isinstance(sigma, str) and sigma not in RELIANCE:
        raise InputError(f"sigma: {sigma!r}, allowed: numbers [mm], {' or '.join(map(repr, RELIANCE))}")
    reliance = sigma if isinstance(sigma, str) else None if sigma is None else "given"
    if reliance == "estimated":
        return Noise(relative, None, reliance)
    numbers = None if isinstance(sigma, str) else sigma
    stated = next((s for s in (numbers, measurements.sigma, model.sigma) if s is not None), None)
    if stated is None and reliance == "given":
        allowed = "measurement.sigma_mm in the arm file, or a column sigma_mm in the measurements"
        raise InputError(f"sigma: 'given', but none is given, allowed: {allowed}")
    if stated is None:
        return Noise(relative, None)
    deviations = np.asarray(stated, dtype=float)
    if deviations.shape not in ((), (m,)) or not np.all(np.isfinite(deviations) & (deviations > 0.0)):
        raise InputError(f"sigma_mm: shape {deviations.shape}, allowed: one number or ({m},), each finite and > 0")
    return Noise(relative / deviations**2, float(np.sqrt(np.mean(deviations**2))), reliance)
