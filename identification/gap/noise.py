"""The noise: its components, each with a marginal likelihood."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from identification.arrays import Array
from identification.gap.fit import Fitted, Rows
from identification.gap.likelihood import orthonormal

UNEVEN = 0.05  # prior probability of each kind of noise that is not white
LASTING = 5e-4  # the same where it lasts as a drift does; with less, such noise is called a drift now and then
RATIOS = (0.5, 2.0, 8.0, 32.0)  # of the further variance to the white one; numerical: likelihoods are flat over a step
CORRELATIONS = (0.2, 0.4, 0.6, 0.8, 0.95)  # of one row with the next; numerical, as `RATIOS`


class NoiseModel(NamedTuple):
    """A covariance of the rows.

    name : `joint_noise:j`, `reach_noise`, `time_noise`, `serial_correlation`, `repeats`, empty: white
    size : ratio of the additional to the common variance (at the mean posture), negative where it falls with time; or
        the correlation
    prior : log probability
    """

    name: str
    size: float
    rows: Rows
    prior: float


def noises(at: Fitted) -> Iterator[NoiseModel]:
    """White noise, and every other that these rows can have, at a fitted model."""
    rows, (position, _) = at.rows, at.linearized
    m, d = position.shape
    # name -> (m, d, d) shape of the additional covariance, with mean trace d
    levers = enumerate(np.moveaxis(at.levers, 2, 0), start=1)
    shapes = {f"joint_noise:{j}": lever[:, :, None] * lever[:, None, :] for j, lever in levers}
    if not at.model.arm.chain.instrument.contact:  # else nothing says how far away the point is
        shapes["reach_noise"] = np.sum(position**2, axis=1)[:, None, None] * np.eye(d)
    time = rows.conditions.time if rows.conditions.time is not None else np.zeros(m)
    shapes["time_noise"] = (time - time.min() + 1e-9)[:, None, None] * np.eye(d)
    traces = {name: float(np.einsum("mii->", shape)) for name, shape in shapes.items()}
    forms = {name: shape * (d * m / traces[name]) for name, shape in shapes.items() if traces[name] > 0.0}
    yield NoiseModel("", 0.0, rows, 0.0)
    for name, form in forms.items():
        signs = (1.0, -1.0) if name == "time_noise" else (1.0,)
        alike = sum(other.partition(":")[0] == name.partition(":")[0] for other in forms)  # at how many joints
        for sign in signs:
            values, vectors = np.linalg.eigh(form if sign > 0.0 else form.max() * np.eye(d) - form)
            for ratio in RATIOS:
                deviations = np.sqrt(1.0 + ratio * np.maximum(values, 0.0))
                spread = vectors * deviations[:, None, :] @ vectors.transpose(0, 2, 1)
                uneven = replace(rows, spread=spread if rows.spread is None else rows.spread @ spread)
                yield NoiseModel(name, sign * ratio, uneven, float(np.log(UNEVEN / alike / len(RATIOS) / len(signs))))
    for rho in CORRELATIONS:
        # errors that stay alike for a fifth of the session are likelier a drift, which is a block of time
        prior = float(np.log((UNEVEN if (1.0 - rho) * m >= 5.0 else LASTING) / len(CORRELATIONS)))
        yield NoiseModel("serial_correlation", rho, replace(rows, correlation=rho), prior)
    if rows.posture_numbers.max() + 1 < m:
        for ratio in RATIOS:
            yield NoiseModel("repeats", ratio, replace(rows, shared=ratio), float(np.log(0.5 / len(RATIOS))))


def log_likelihoods(models: Sequence[NoiseModel], left: Array, base: Array, columns: Array, sizes: Array) -> Array:
    """(K,) of covariances, up to a constant: restricted ones (H. D. Patterson, R. Thompson, 1971), in which columns
    have normal coefficients.

    left : (m, d) residuals [mm];  base : (m, d, g) columns of free parameters;  columns : (m, d, p);  sizes : (p,) of
    them, standard deviations of their coefficients in units of the noise
    """
    tall = base.reshape(left.size, -1)
    free = (tall @ orthonormal(tall.T @ tall)).reshape(*left.shape, -1)
    table = np.concatenate([free, columns, left[:, :, None]], axis=2)
    precision = np.concatenate([np.zeros(free.shape[2]), sizes**-2.0])
    costs = []
    for model in models:
        white = model.rows.whiten(table)
        root = np.linalg.cholesky(white[:, :-1].T @ white[:, :-1] + np.diag(precision))
        scores = solve_triangular(root, white[:, :-1].T @ white[:, -1], lower=True)
        squares = max(float(white[:, -1] @ white[:, -1] - scores @ scores), 1e-300)
        volume = model.rows.log_determinant + 2.0 * float(np.sum(np.log(np.diag(root))))
        costs.append((len(white) - free.shape[2]) * np.log(squares) + volume)
    return -0.5 * np.array(costs)
