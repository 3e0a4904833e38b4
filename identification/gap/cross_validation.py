"""Without a hold-out: every part of the rows is predicted by fits to the other parts.

The fits are not repeated from the start: with residuals r and Jacobian J of the fit to all rows, the fit without part g
is one Gauss-Newton step away, (S - S_g)^-1 (v - v_g) with S = J^T J and v = J^T r. For a linear model this is exact.

The name of an effect was chosen with all rows, so cross-validation can refute it and cannot confirm it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.gap.confirmation import LEVEL, Confirmation, Groups, HeldOut, Mean, confirm
from identification.gap.fit import Fit
from identification.gap.holdout import groups_of
from identification.measurements import Measurements

# reasons: identification/README.md, "Constants"
FOLDS = 8
CONDITION = 1e-10  # of a normal matrix; its eigenvalues are rounded at 1e-16
QUESTIONS = 2  # transfers that are tested, over which the level is divided


class CrossValidated(NamedTuple):
    """Residuals (m, d) [mm] of rows by fits to the other parts, and (m,) the mean square that these fits predict."""

    residual: Array
    predicted: Array


def cross_validate(found: Fit, folds: Groups) -> CrossValidated:
    """Predict each part of the rows of a fit from the others;  folds : (m,) number of each row's part."""
    rows = replace(found.rows, correlation=0.0)  # each row has its own weight
    m, d = rows.positions.shape
    residual = rows.positions - found.model.position(rows.postures, found.values, rows.conditions)
    jacobian, prior, left_by_prior = found.regression()
    white, right = rows.whiten(jacobian).reshape(m, d, -1), rows.whiten(residual).reshape(m, d)
    square, product = _normal(white, right)
    square, product = square + prior.T @ prior, product + prior.T @ left_by_prior
    determined = jacobian.shape[2] if len(prior) == 0 else found.effective
    left, expected = np.empty((m, d)), np.empty(m)
    for fold in np.unique(folds):
        part, rest = folds == fold, folds != fold
        own_square, own_product = _normal(white[part], right[part])
        inverse = _inverse(square - own_square)
        step = inverse @ (product - own_product)
        left[part] = residual[part] - jacobian[part] @ step
        remaining = right[rest] - white[rest] @ step
        freedom = max(remaining.size - determined, 1.0)
        noise = np.sum((residual[rest] - jacobian[rest] @ step) ** 2) * d / freedom
        moved = jacobian[part] @ inverse
        spread = np.sum(remaining**2) / freedom * np.einsum("mip,mip->m", moved, jacobian[part])
        expected[part] = noise + spread
    return CrossValidated(left, expected)


def _normal(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """J^T J (p, p) and J^T r (p,) of some rows (k, d, p) and (k, d)."""
    tall = jacobian.reshape(-1, jacobian.shape[2])
    return tall.T @ tall, tall.T @ residual.reshape(-1)


def _inverse(square: Array) -> Array:
    """Pseudo-inverse of a normal matrix: combinations that the rows do not determine stay as they are."""
    lengths = np.sqrt(np.maximum(np.diag(square), 1e-300))
    values, vectors = np.linalg.eigh(square / np.outer(lengths, lengths))
    known = values > CONDITION * values.max(initial=0.0)
    turned = vectors[:, known] / lengths[:, None]
    return np.asarray((turned / values[known]) @ turned.T)


def cross_validation(
    base: Fit,
    named: Fit,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    generator: np.random.Generator,
    anything: bool = True,
) -> tuple[Confirmation, ...]:
    """Whether the named model holds for other postures, and for another stretch of time of the same session.

    base, named : fits to the rows that are kept;  anything : False where nothing was named
    """
    by_groups = groups_of(measurements, kept)
    postures = np.unique(measurements.posture_numbers[kept], return_inverse=True)[1]
    count = int(postures.max()) + 1
    parts = {
        "other postures": (generator.permutation(count) * min(FOLDS, count) // count)[postures],
        "another stretch of time": by_groups[0],
    }
    return tuple(
        confirm(_held_out(base, named, folds), by_groups, transfer, "cross-validation", LEVEL / QUESTIONS, anything)
        for transfer, folds in parts.items()
    )


def _held_out(base: Fit, named: Fit, folds: Groups) -> HeldOut:
    before, after = cross_validate(base, folds), cross_validate(named, folds)
    return HeldOut(
        np.square(before.residual).sum(axis=1),
        np.square(after.residual).sum(axis=1),
        Mean(float(np.mean(after.predicted)), 0.0, np.inf),
        np.square(before.residual - after.residual).sum(axis=1),
        float(np.sqrt(np.mean(after.predicted) / after.residual.shape[1])),
        after.residual.shape[1],
    )
