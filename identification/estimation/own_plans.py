"""Many data sets, each on a plan of its own: what random plans are worth, on average.

As `batch`, without what data sets on one plan share: a model that is linear in its links has one small Hermitian system
for each, any other starts there and takes damped Gauss-Newton steps with its own normal matrix (`individual`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.estimation.batch import BatchFit
from identification.estimation.individual import Plans, individual
from identification.estimation.planar_linear import Complex, as_complex, design, parameters_of
from identification.estimation.problem import Problem
from identification.information import full_rank
from identification.measurements import Conditions, Measurements, directions_from_order, session_time
from identification.model import DIMENSION, Model

CHUNK = 20_000  # rows (data sets times postures) at a time: the arrays of one pass stay in the processor's cache
ILL = 1e6  # condition (1-norm) of a normal matrix from which on its inverse is not used


def estimate_each(model: Model, postures: ArrayLike, positions: ArrayLike) -> BatchFit:
    """Fits every data set on its own plan, each as `estimate` would with equal weights.

    postures : (K, m, n) [rad], each plan in the order of measurement;  positions : (K, m, 2) [mm]
    `parameters` are not numbers and `converged` is False where a plan cannot tell all parameters apart.
    Raises `InputError` for shapes that do not fit.
    """
    plans, measured = np.asarray(postures, dtype=float), np.asarray(positions, dtype=float)
    n = model.arm.links
    if plans.ndim != 3 or plans.shape[-1] != n:
        raise InputError(f"postures: shape {plans.shape}, allowed: (K, m, {n})")
    if measured.shape != (*plans.shape[:2], DIMENSION):
        raise InputError(f"positions: shape {measured.shape}, allowed: {(*plans.shape[:2], DIMENSION)}")
    count, m, _ = plans.shape
    parameters, rss = np.full((count, len(model.names)), np.nan), np.full(count, np.nan)
    converged = np.zeros(count, dtype=bool)
    size = max(1, CHUNK // m)
    for part in (slice(start, start + size) for start in range(0, count, size)):
        told = np.flatnonzero(_told(model, plans[part])) + part.start
        fit = _closed_form if model.linear_in_links else _iterated
        parameters[told], rss[told], converged[told] = fit(model, plans[told], measured[told])
    return BatchFit(np.where(converged[:, None], parameters, np.nan), rss, converged)


def sessions(postures: Array) -> Conditions:
    """Conditions (K, m) of plans (K, m, n) that are measured in their order, as `Measurements.conditions` of each."""
    time = np.broadcast_to(session_time(np.arange(postures.shape[1], dtype=float)), postures.shape[:2])
    return Conditions(time=time, directions=directions_from_order(postures))


def _told(model: Model, postures: Array) -> NDArray[np.bool_]:
    """(k,) True where a plan tells all parameters of the model apart, at its best known values."""
    start = np.clip(model.values, [p.lower for p in model.parameters], [p.upper for p in model.parameters])
    return full_rank(model.jacobian(postures, start, sessions(postures)), model.scales)


def _closed_form(model: Model, postures: Array, measured: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """One small system per plan (identification/README.md, "Closed form")."""
    count, m, n = postures.shape
    columns, nominal = design(model, postures.reshape(-1, n))
    columns = columns.reshape(count, m, -1)
    rest = (as_complex(measured) - columns @ nominal)[..., None]
    back = _pseudo_inverse(columns)
    change = back @ rest
    squares = np.abs(rest - columns @ change)[..., 0] ** 2
    rss = np.sum(squares, axis=1)
    return parameters_of(model, nominal + change[..., 0]), rss, np.isfinite(rss)


def _pseudo_inverse(columns: Complex) -> Complex:
    """(k, u, m) of columns (k, m, u) of full rank.

    By the inverse of the normal matrix, which squares the condition, where that costs no digits that matter.
    """
    across = np.swapaxes(columns.conj(), -1, -2)
    normal = across @ columns
    inverse = np.linalg.inv(normal + np.finfo(float).eps * np.eye(normal.shape[-1]))
    found = inverse @ across
    condition = np.linalg.norm(normal, 1, axis=(-2, -1)) * np.linalg.norm(inverse, 1, axis=(-2, -1))
    ill = np.flatnonzero(~(condition < ILL))
    found[ill] = np.linalg.pinv(columns[ill], rcond=1e-13)
    return found


def _iterated(model: Model, postures: Array, measured: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Closed-form lengths and offsets, effects at their best known values; then steps."""
    if len(postures) == 0:
        return np.empty((0, len(model.names))), np.empty(0), np.empty(0, dtype=bool)
    problem = Problem(model, Measurements(postures[0], measured[0]), np.ones(postures.shape[1]))
    starts, base = np.tile(problem.start, (len(postures), 1)), Model(model.arm.with_effects())
    if model.names[: len(base.names)] == base.names:
        starts[:, : len(base.names)] = _closed_form(base, postures, measured)[0]
    return individual(problem, measured, starts, Plans(postures, sessions(postures)))
