"""Cross-validation without a hold-out: each part of the rows is predicted from the others.

The sets of the posterior are weighed again by their likelihood on the other rows alone, at the sizes that they have,
and their predictions averaged. The sets were found with all rows, so cross-validation can refute a model but cannot
confirm it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from identification.arrays import Array
from identification.gap.confirmation.confirmation import LEVEL, Confirmation, Groups, HeldOut, Mean, confirm
from identification.gap.confirmation.holdout import groups_of
from identification.gap.evidence import SIZES, Index
from identification.gap.posterior import Posterior
from identification.measurements import POINT, Measurements

# reasons: identification/README.md, "Constants"
FOLDS = 8
QUESTIONS = 2  # transfers that are tested, over which the level is divided
MOST = 10  # effort: explanations that are averaged


class LeftOut(NamedTuple):
    """Predictions of rows from other rows: (m, d) residuals [mm] of the base model and of the average, and (m,) mean
    square distance [mm^2] that the average expects."""

    before: Array
    after: Array
    predicted: Array


def left_out(found: Posterior, kept: NDArray[np.bool_], folds: Groups) -> LeftOut:
    """Predict each part of the kept rows from the others;  folds : (kept rows,) number of each row's part.

    All columns are the base's, in an orthonormal basis and with a flat prior, and those of the blocks, with theirs; the
    products of the other rows are those of all less those of the part.
    """
    number, at = found.best.noise, found.at
    problem, rows = found.problems[number], found.noises[number].rows.pick(kept)
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    base = found.library.own_places(at.model)
    added = np.setdiff1d(np.arange(len(at.values)), base)
    y = rows.positions - position + jacobian[:, :, added] @ at.values[added]
    geometry = jacobian[:, :, base] / at.model.scales[base]
    _, s, vt = np.linalg.svd(rows.whiten(geometry), full_matrices=False)
    seen = s > 1e-9 * s.max(initial=0.0)
    geometry = geometry @ (vt[seen].T / s[seen])
    sets = [e for e in found.explanations if e.noise == number][:MOST]
    blocks = sorted({b for e in sets for b in e.weighed.blocks if not problem.blocks[b].row})
    columns = np.concatenate([geometry, *(problem.columns[b][kept] @ problem.roots[b] for b in blocks)], axis=2)
    m, d, g = geometry.shape
    ends = g + np.cumsum([0, *(problem.products.widths[b] for b in blocks)])
    chosen, precisions = [], []
    for one in sets:
        inside = [
            (blocks.index(b), s) for b, s in zip(one.weighed.blocks, one.weighed.sizes, strict=True) if b in blocks
        ]
        chosen.append(np.concatenate([np.arange(g), *(np.arange(ends[k], ends[k + 1]) for k, _ in inside)]))
        of_blocks = [np.full(ends[k + 1] - ends[k], SIZES[size] ** -2.0) for k, size in inside]
        precisions.append(np.concatenate([np.zeros(g), *of_blocks]))
    white = rows.whiten(np.concatenate([columns, y[:, :, None]], axis=2)).reshape(m, d, -1)
    parts = [_products(white[folds == fold]) for fold in range(int(folds.max()) + 1)]
    every = np.sum(parts, axis=0)
    whole = [_ridge(every, p, precision, max(d * m - g, 1)) for p, precision in zip(chosen, precisions, strict=True)]
    before, after, predicted = np.empty_like(y), np.empty_like(y), np.empty(m)
    for fold, part in enumerate(parts):
        test, others = folds == fold, every - part
        bare = _ridge(others, np.arange(g), np.zeros(g), max(d * int(np.sum(~test)) - g, 1))
        before[test] = y[test] - columns[test][:, :, :g] @ bare.mean
        fits = [
            _ridge(others, p, precision, max(d * int(np.sum(~test)) - g, 1))
            for p, precision in zip(chosen, precisions, strict=True)
        ]
        # the prior of a set is what its odds have beyond its likelihood with all rows
        odds = [np.log(e.probability) - w.likelihood + f.likelihood for e, w, f in zip(sets, whole, fits, strict=True)]
        shares = np.exp(np.array(odds) - logsumexp(odds))
        mean, second = np.zeros(columns.shape[2]), np.zeros((columns.shape[2], columns.shape[2]))
        for share, p, of_set in zip(shares, chosen, fits, strict=True):
            mean[p] += share * of_set.mean
            second[np.ix_(p, p)] += share * (of_set.covariance + np.outer(of_set.mean, of_set.mean))
        after[test] = y[test] - columns[test] @ mean
        spread = np.sum((columns[test] @ (second - np.outer(mean, mean))) * columns[test], axis=(1, 2))
        predicted[test] = float(np.mean(spread + d * sum(s * f.variance for s, f in zip(shares, fits, strict=True))))
    return LeftOut(before, after, predicted)


class _Ridge(NamedTuple):
    """Mean and covariance of coefficients, variance of the noise, and log likelihood but for a constant."""

    mean: Array
    covariance: Array
    variance: float
    likelihood: float


def _products(columns: Array) -> Array:
    """(p, p) products of columns (m, d, p)."""
    flat = columns.reshape(-1, columns.shape[2])
    return np.asarray(flat.T @ flat)


def _ridge(products: Array, places: Index, precision: Array, freedom: int) -> _Ridge:
    """Some columns with a prior, fitted to the last one;  products : of all columns;  freedom : of the flat ones"""
    normal = products[np.ix_(places, places)] + np.diag(precision)
    inverse = np.asarray(np.linalg.inv(normal))
    mean = inverse @ products[places, -1]
    squares = max(float(products[-1, -1] - mean @ products[places, -1]), 1e-300)
    volume = np.linalg.slogdet(normal)[1] - np.sum(np.log(precision[precision > 0.0]))
    likelihood = -0.5 * float(volume) - 0.5 * freedom * float(np.log(squares))
    return _Ridge(mean, inverse * (squares / freedom), squares / freedom, likelihood)


def cross_validation(
    found: Posterior,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    generator: np.random.Generator,
    named: bool = True,
) -> tuple[Confirmation, ...]:
    """Test whether the average holds for other postures, and for another interval of time of the same session.

    measurements : the rows of the posterior;  kept : (m,) rows that are no outliers;  named : False if nothing was
    named
    """
    by_groups = groups_of(measurements, kept)
    postures = np.unique(measurements.posture_numbers[kept], return_inverse=True)[1]
    count = int(postures.max()) + 1
    parts = {
        "other postures": (generator.permutation(count) * min(FOLDS, count) // count)[postures],
        "another stretch of time": by_groups[0],
    }
    tests = []
    for transfer, folds in parts.items():
        one = left_out(found, kept, folds)
        before, after = one.before[:, POINT], one.after[:, POINT]
        rows = HeldOut(
            np.square(before).sum(axis=1),
            np.square(after).sum(axis=1),
            Mean(float(np.mean(one.predicted)), 0.0, np.inf),
            np.square(before - after).sum(axis=1),
            float(np.sqrt(np.mean(one.predicted) / after.shape[1])),
            after.shape[1],
        )
        tests.append(confirm(rows, by_groups, transfer, "cross-validation", LEVEL / QUESTIONS, named))
    return tuple(tests)
