"""Cross-validation without a hold-out: each part of the rows is predicted by a fit to the other parts.

No fit is repeated from the start: with residuals r and Jacobian J of the fit to all rows, the fit without part g is one
Gauss-Newton step away, (S - S_g)^-1 (v - v_g) with S = J^T J and v = J^T r. For a linear model this is exact.

The effects were chosen with all rows, so cross-validation can refute them but cannot confirm them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.gap.confirmation.confirmation import LEVEL, Confirmation, Groups, HeldOut, Mean, confirm
from identification.gap.confirmation.holdout import groups_of
from identification.gap.curves.curve_fit import inverse_if_clear
from identification.gap.fits.fit import Fit
from identification.measurements import POINT, Measurements

# reasons: identification/README.md, "Constants"
FOLDS = 8
CONDITION = 1e-10  # of a normal matrix; its eigenvalues are rounded at 1e-16
QUESTIONS = 2  # transfers that are tested, over which the level is divided


class CrossValidated(NamedTuple):
    """Predictions of the rows by fits to the other parts.

    residual : (m, d) measured less predicted [mm]
    predicted : (m,) mean square distance [mm^2] that each fit expects in the part it predicts
    """

    residual: Array
    predicted: Array


class LinearizedFit(NamedTuple):
    """A fit of n free parameters to m rows, linearized about its solution.

    left : (m, d) residuals [mm];  columns : (m, d, n) Jacobian;  white_left, white : both whitened
    normal, moment : (n, n) normal matrix and (n,) right-hand side of the prior
    determined : effective number of parameters
    """

    left: Array
    columns: Array
    white_left: Array
    white: Array
    normal: Array
    moment: Array
    determined: float

    @classmethod
    def of(cls, found: Fit) -> LinearizedFit:
        """Linearize a fit; serial correlation of its rows is ignored."""
        rows, left = replace(found.rows, correlation=0.0), found.left
        columns, prior, left_by_prior = found.regression()
        even = rows.spread is None
        white = columns if even else rows.whiten(columns).reshape(columns.shape)
        white_left = left if even else rows.whiten(left).reshape(left.shape)
        determined = columns.shape[2] if len(prior) == 0 else found.effective
        return cls(left, columns, white_left, white, prior.T @ prior, prior.T @ left_by_prior, determined)


def cross_validate(found: Fit | LinearizedFit, folds: Groups) -> CrossValidated:
    """Predict each part of the rows of a fit from the other parts;  folds : (m,) index of each row's part."""
    problem = found if isinstance(found, LinearizedFit) else LinearizedFit.of(found)
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


def _predicted(problem: LinearizedFit, part: NDArray[np.int64], moved: Array, step: Array, inverse: Array) -> float:
    """Mean square distance [mm^2] expected in one part: noise plus the uncertainty of the parameters.

    moved : (m, d) residuals of all rows with the parameters of the other parts [mm]
    step : (n,) change of the parameters;  inverse : (n, n) inverse normal matrix of the other parts
    """
    others = np.ones(len(moved), dtype=bool)
    others[part] = False
    d = moved.shape[1]
    freedom = max(int(others.sum()) * d - problem.determined, 1.0)
    white = moved if problem.white is problem.columns else problem.white_left - problem.white @ step
    spread = np.sum(inverse * _gram(problem.columns[part, POINT])) / len(part)
    return float(np.sum(moved[others, POINT] ** 2) * d + np.sum(white[others] ** 2) * spread) / freedom


def _normal(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """J^T J (n, n) and J^T r (n,) of k rows: Jacobian (k, d, n) and residuals (k, d)."""
    return _gram(jacobian), jacobian.reshape(-1, jacobian.shape[2]).T @ residual.reshape(-1)


def _gram(jacobian: Array) -> Array:
    tall = jacobian.reshape(-1, jacobian.shape[2])
    return tall.T @ tall


def _inverse(square: Array, whole: Array) -> Array:
    """Pseudo-inverse of a normal matrix; combinations that its rows do not determine get no step.

    whole : (n,) diagonal for all rows, to recognize columns of which the subtraction left only rounding
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
    """Test whether the named model holds for other postures, and for another interval of time of the same session.

    base, named : fits to the kept rows;  kept : (m,) rows that are no outliers;  anything : False if nothing was named
    """
    by_groups = groups_of(measurements, kept)
    postures = np.unique(measurements.posture_numbers[kept], return_inverse=True)[1]
    count = int(postures.max()) + 1
    parts = {
        "other postures": (generator.permutation(count) * min(FOLDS, count) // count)[postures],
        "another stretch of time": by_groups[0],
    }
    fits = LinearizedFit.of(base), LinearizedFit.of(named)
    return tuple(
        confirm(_held_out(*fits, folds), by_groups, transfer, "cross-validation", LEVEL / QUESTIONS, anything)
        for transfer, folds in parts.items()
    )


def _held_out(base: LinearizedFit, named: LinearizedFit, folds: Groups) -> HeldOut:
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
