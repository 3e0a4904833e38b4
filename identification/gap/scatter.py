"""Components of the noise: each is a covariance of the rows with one parameter, weighed by its marginal likelihood.

The noise is white, or has one of: noise of a joint, along its lever; noise that grows with the reach, or in time;
serial correlation; an error that all rows of one posture share. Given a set of effects, the likelihood of a covariance
W with flat priors for all parameters is, with residual sum of squares R of f degrees of freedom (H. D. Patterson, R.
Thompson, 1971),

    -1/2 log |W| - 1/2 log |J^T W^-1 J| - f/2 log R.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular

from identification.arrays import Array
from identification.gap.fit import Fit, Rows
from identification.information import column_space

UNEVEN = 0.05  # prior probability of each kind of noise that is not white
RATIOS = (0.5, 2.0, 8.0, 32.0)  # of the further variance to the white one; numerical: likelihoods are flat over a step
CORRELATIONS = (0.2, 0.4, 0.6, 0.8, 0.95)  # of one row with the next; numerical, as `RATIOS`


@dataclass(frozen=True)
class Finding:
    """A property of the noise.

    name : `joint_noise:j`, `reach_noise`, `time_noise`, `serial_correlation`, `repeats`;  p : probability that it is
    not there
    size : ratio of the additional to the common variance (at the mean posture), or the correlation
    """

    name: str
    p: float
    size: float

    def __str__(self) -> str:
        kind, _, joint = self.name.partition(":")
        what = {
            "joint_noise": f"larger the farther joint {joint} moves the point, by a relative variance of",
            "reach_noise": "larger far from the base, by a relative variance of",
            "time_noise": f"larger {'early' if self.size < 0.0 else 'late'} in the session, by a relative variance of",
            "serial_correlation": "rows measured one after the other err alike, lag-1 correlation",
            "repeats": "rows of one posture err alike, by a relative variance of",
        }[kind]
        return f"{self.name} ({what} {abs(self.size):.2g}, probability {1.0 - self.p:.2f})"


@dataclass(frozen=True)
class NoiseModel:
    """A covariance of the rows;  name : as of `Finding`, empty: white;  prior : log probability"""

    name: str
    size: float
    rows: Rows
    prior: float


def noises(rows: Rows, at: Fit) -> Iterator[NoiseModel]:
    """White noise, and every other that these rows can have, at a fitted model."""
    where = (rows.postures, at.values, rows.conditions)
    # name of a finding -> (m, d, d) shape of the additional covariance, with mean trace d
    d, shapes = rows.dimension, {}
    for j, lever in enumerate(np.moveaxis(at.model.joint_levers(*where), 2, 0), start=1):
        shapes[f"joint_noise:{j}"] = lever[:, :, None] * lever[:, None, :]
    if not at.model.arm.chain.instrument.contact:  # else nothing says how far away the point is
        position = at.model.position(*where)
        shapes["reach_noise"] = np.sum(position**2, axis=1)[:, None, None] * np.eye(d)
    time = rows.conditions.time if rows.conditions.time is not None else np.zeros(len(rows))
    shapes["time_noise"] = (time - time.min() + 1e-9)[:, None, None] * np.eye(d)
    traces = {name: float(np.einsum("mii->", shape)) for name, shape in shapes.items()}
    forms = {name: shape * (d * len(rows) / traces[name]) for name, shape in shapes.items() if traces[name] > 0.0}
    joints = sum(name.startswith("joint") for name in forms)
    yield NoiseModel("", 0.0, rows, 0.0)
    for name, form in forms.items():
        signs = (1.0, -1.0) if name == "time_noise" else (1.0,)
        kinds = (joints if name.startswith("joint") else 1) * len(RATIOS) * len(signs)
        for sign in signs:
            shape = form if sign > 0.0 else form.max() * np.eye(form.shape[1]) - form
            values, vectors = np.linalg.eigh(shape)
            for ratio in RATIOS:
                deviations = np.sqrt(1.0 + ratio * np.maximum(values, 0.0))
                spread = vectors * deviations[:, None, :] @ vectors.transpose(0, 2, 1)
                more = replace(rows, spread=spread if rows.spread is None else rows.spread @ spread)
                yield NoiseModel(name, sign * ratio, more, float(np.log(UNEVEN / kinds)))
    for rho in CORRELATIONS:
        prior = float(np.log(UNEVEN / len(CORRELATIONS)))
        yield NoiseModel("serial_correlation", rho, replace(rows, correlation=rho), prior)
    if len(np.unique(rows.posture_numbers)) < len(rows):
        for ratio in RATIOS:
            yield NoiseModel("repeats", ratio, replace(rows, shared=ratio), float(np.log(0.5 / len(RATIOS))))


def log_likelihoods(models: Sequence[NoiseModel], left: Array, columns: Array) -> Array:
    """(K,) of covariances, see above, up to a constant;  left : (m, d) residuals [mm];  columns : (m, d, p) of all free
    parameters"""
    tall = columns.reshape(left.size, -1)
    basis = column_space(tall, np.maximum(np.linalg.norm(tall, axis=0), 1e-300))
    table = np.concatenate([basis, left.reshape(-1, 1)], axis=1).reshape(*left.shape, -1)
    costs = []
    for model in models:
        white = model.rows.whiten(table)
        root = np.linalg.cholesky(white[:, :-1].T @ white[:, :-1])
        scores = solve_triangular(root, white[:, :-1].T @ white[:, -1], lower=True)
        squares = max(float(white[:, -1] @ white[:, -1] - scores @ scores), 1e-300)
        volume = model.rows.log_determinant + 2.0 * float(np.sum(np.log(np.diag(root))))
        costs.append((len(white) - len(root)) * np.log(squares) + volume)
    return -0.5 * np.array(costs)
