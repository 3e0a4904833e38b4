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
from identification.gap.curve_fit import inverse_if_clear
from identification.gap.fit import Fit
from identification.gap.holdout import groups_of
from identification.measurements import POINT, Measurements

# reasons: identification/README.md, "Constants"
FOLDS = 8
CONDITION = 1e-10  # of a normal matrix; its eigenvalues are rounded at 1e-16
QUESTIONS = 2  # transfers that are tested, over which the level is divided


class CrossValidated(NamedTuple):
    """Residuals (m, d) [mm] of rows by fits to the other parts, and (m,) the mean square distance that these fits
    predict for the rows of the same part."""

    residual: Array
    predicted: Array


class Linearized(NamedTuple):
    """A fit as linear least squares: m rows with weights of their own, n free parameters, of which the data determine
    `determined`.

    left : (m, d) [mm];  columns : (m, d, n);  white_left, white : the same, whitened
    normal, moment : (n, n) and (n,) of the prior
    """

    left: Array
    columns: Array
    white_left: Array
    white: Array
    normal: Array
    moment: Array
    determined: float

    @classmethod
    def of(cls, found: Fit) -> Linearized:
        """About the fit's solution."""
        rows, left = replace(found.rows, correlation=0.0), found.left
        columns, prior, left_by_prior = found.regression()
        even = rows.spread is None
        white = columns if even else rows.whiten(columns).reshape(columns.shape)
        white_left = left if even else rows.whiten(left).reshape(left.shape)
        determined = columns.shape[2] if len(prior) == 0 else found.effective
        return cls(left, columns, white_left, white, prior.T @ prior, prior.T @ left_by_prior, determined)


def cross_validate(found: Fit | Linearized, folds: Groups) -> CrossValidated:
    """Predict each part of the rows of a fit from the others;  folds : (m,) number of each row's part."""
    problem = found if isinstance(found, Linearized) else Linearized.of(found)
    parts = [np.flatnonzero(folds == fold) for fold in np.unique(folds)]
    own = [_normal(problem.white[part], problem.white_left[part]) for part in parts]
    normal = problem.normal + sum(square for square, _ in own)
    moment = problem.moment + sum(product for _, product in own)
    left, expected = np.empty_like(problem.left), np.empty(len(problem.left))
    for part, (square, product) in zip(parts, own, strict=True):
        inverse = _inverse(normal - square, np.diag(normal))
        step = inverse @ (moment - product)
        moved = problem.left - problem.columns @ step
        left[part], expected[part] = moved[part], _predicted(problem, part, moved, step, inverse)
    return CrossValidated(left, expected)


def _predicted(problem: Linearized, part: NDArray[np.int64], moved: Array, step: Array, inverse: Array) -> float:
    """Mean square distance of a part's rows that the other rows predict: their noise, and errors of the parameters.

    moved : (m, d) left of all rows after the step from all rows to the others;  inverse : of their normal matrix
    """
    others = np.ones(len(moved), dtype=bool)
    others[part] = False
    d = moved.shape[1]
    freedom = max(int(others.sum()) * d - problem.determined, 1.0)
    white = moved if problem.white is problem.columns else problem.white_left - problem.white @ step
    spread = np.sum(inverse * _gram(problem.columns[part, POINT])) / len(part)
    return float(np.sum(moved[others, POINT] ** 2) * d + np.sum(white[others] ** 2) * spread) / freedom


def _normal(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """J^T J (n, n) and J^T r (n,) of some rows (k, d, n) and (k, d)."""
    return _gram(jacobian), jacobian.reshape(-1, jacobian.shape[2]).T @ residual.reshape(-1)


def _gram(jacobian: Array) -> Array:
    tall = jacobian.reshape(-1, jacobian.shape[2])
    return tall.T @ tall


def _inverse(square: Array, whole: Array) -> Array:
    """Pseudo-inverse of a normal matrix: combinations that the rows do not determine stay as they are.

    whole : (n,) its diagonal for all rows; of a column that is in the part left out alone, subtraction leaves rounding
    """
    own = np.diag(square)
    lengths = np.sqrt(np.where(own > CONDITION * whole, own, np.inf))
    unit = square / np.outer(lengths, lengths)
    found = inverse_if_clear(unit, CONDITION)
    if found is None:
        values, vectors = np.linalg.eigh(unit)
        known = values > CONDITION * values.max(initial=0.0)
        found = (vectors[:, known] / values[known]) @ vectors[:, known].T
    return np.asarray(found / np.outer(lengths, lengths))


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
    fits = Linearized.of(base), Linearized.of(named)
    return tuple(
        confirm(_held_out(*fits, folds), by_groups, transfer, "cross-validation", LEVEL / QUESTIONS, anything)
        for transfer, folds in parts.items()
    )


def _held_out(base: Linearized, named: Linearized, folds: Groups) -> HeldOut:
    left, found = cross_validate(base, folds).residual[:, POINT], cross_validate(named, folds)
    after = found.residual[:, POINT]
    return HeldOut(
        np.square(left).sum(axis=1),
        np.square(after).sum(axis=1),
        Mean(float(np.mean(found.predicted)), 0.0, np.inf),
        np.square(left - after).sum(axis=1),
        float(np.sqrt(np.mean(found.predicted) / after.shape[1])),
        after.shape[1],
    )
