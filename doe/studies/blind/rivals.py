"""Gaps to compare with: of the true model, of the whole library at once, of a Gaussian process on the residuals."""

from __future__ import annotations

import numpy as np

from doe.studies.blind.data_set import DataSet
from identification.arrays import Array
from identification.gap.fit import fit, links_start
from identification.gap.holdout import rms_distance
from identification.gap.hypotheses import hypotheses
from identification.gap.whitening import Rows
from identification.model import Model


def true_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the true model, fitted to the rows that are not outliers."""
    assert data.holdout is not None
    model = Model(data.arm.with_effects(*data.arm.effects, *data.specs))
    kept = np.ones(len(data.measurements), dtype=bool)
    kept[[row - 1 for row in data.wrong_rows]] = False
    rows, fresh = Rows.of(data.measurements).pick(kept), Rows.of(data.holdout)
    values = fit(model, rows, links_start(model, rows)).values
    return rms_distance(fresh.positions - model.position(fresh.postures, values, fresh.conditions))


def library_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the model with every effect of the library; orders of ripple and single joints left out."""
    assert data.holdout is not None
    library = hypotheses(data.arm, data.measurements.given)
    specs = (h.spec for h in library.unscanned if not h.key.startswith("joint_compliance:"))
    return rms_distance(_missed(data, Model(data.arm.with_effects(*specs)))[1])


def process_gap(data: DataSet) -> float:
    """Held-out gap [mm] of the base model corrected by a Gaussian process of its residuals."""
    assert data.holdout is not None
    residual, fresh = _missed(data, Model(data.arm))
    guess = gaussian_process(data.measurements.postures, residual, data.holdout.postures)
    return rms_distance(fresh - guess)


def _missed(data: DataSet, model: Model) -> tuple[Array, Array]:
    """Residuals of a fitted model on the data and on the hold-out."""
    assert data.holdout is not None
    rows, fresh = Rows.of(data.measurements), Rows.of(data.holdout)
    values = fit(model, rows, links_start(model, rows)).values
    here = rows.positions - model.position(rows.postures, values, rows.conditions)
    return np.asarray(here), np.asarray(fresh.positions - model.position(fresh.postures, values, fresh.conditions))


def gaussian_process(postures: Array, residual: Array, fresh: Array) -> Array:
    """(k, 2) mean prediction at fresh postures (k, n) from residuals (m, 2) at postures (m, n).

    Squared exponential kernel on (cos q, sin q); length and noise by the likelihood, over a grid.
    """

    def distance(a: Array, b: Array) -> Array:
        return np.asarray(np.sum(2.0 - 2.0 * np.cos(a[:, None, :] - b[None, :, :]), axis=2))

    near, far = distance(postures, postures), distance(fresh, postures)
    m, best, guess = len(postures), np.inf, np.zeros((len(fresh), 2))
    for length in np.geomspace(0.5, 8.0, 9):
        for noise in np.geomspace(0.02, 50.0, 12):
            kernel = np.exp(-0.5 * near / length**2) + noise * np.eye(m)
            solved = np.linalg.solve(kernel, residual)
            variance = np.sum(residual * solved) / (2 * m)
            cost = 2 * m * np.log(variance) + 2 * np.linalg.slogdet(kernel)[1]
            if cost < best:
                best, guess = cost, np.exp(-0.5 * far / length**2) @ solved
    return guess
