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
from identification.gap.evidence import SIZES, Products
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
    """Predict each part of the kept rows from the others;  folds : (kept rows,) number of each row's part."""
    number = found.best.noise
    problem, noise = found.problems[number], found.noises[number].rows.pick(kept)
    at, rows = found.at, noise
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    base = found.library.own_places(at.model)
    added = np.setdiff1d(np.arange(len(at.values)), base)
    y = rows.positions - position + jacobian[:, :, added] @ at.values[added]
    own = jacobian[:, :, base] / at.model.scales[base]
    sets = [e for e in found.explanations if e.noise == number][:MOST]
    blocks = sorted({b for e in sets for b in e.weighed.blocks if not problem.blocks[b].row})
    columns = [problem.columns[b][kept] @ problem.roots[b] for b in blocks]
    x = np.concatenate([np.zeros((*y.shape, 0)), *columns], axis=2)
    starts = np.concatenate([[0], np.cumsum([c.shape[2] for c in columns])]).astype(np.int64)
    before, after, predicted = np.empty_like(y), np.empty_like(y), np.empty(len(y))
    for fold in range(int(folds.max()) + 1):
        test = folds == fold
        there = rows.pick(~test)
        j, z, target = there.whiten(own[~test]), there.whiten(x[~test]), there.whiten(y[~test])
        u, s, vt = np.linalg.svd(j, full_matrices=False)
        seen = s > 1e-9 * s.max(initial=0.0)
        u, back = u[:, seen], vt[seen].T / s[seen]
        inside, score = u.T @ z, u.T @ target
        z, rest = z - u @ inside, target - u @ score
        signs, limits = np.zeros(len(blocks), dtype=bool), np.full(len(blocks), len(SIZES))
        products = Products(z, rest, max(len(rest) - int(seen.sum()), 1), starts, signs, limits)
        before[test] = y[test] - own[test] @ (back @ score)
        odds, means, spreads = [], [], []
        for one in sets:
            chosen = [
                (blocks.index(b), size)
                for b, size in zip(one.weighed.blocks, one.weighed.sizes, strict=True)
                if b in blocks
            ]
            local = [b for b, _ in chosen]
            sizes = SIZES[[size for _, size in chosen]] if chosen else np.zeros(0)
            own_columns = products.places(local)
            mean, covariance = np.zeros(x.shape[2]), np.zeros((x.shape[2], x.shape[2]))
            variance = products.squares / products.freedom
            if chosen:
                mean[own_columns], covariance[np.ix_(own_columns, own_columns)] = products.estimates(local, sizes)
                variance = (products.squares - float(mean @ products.right)) / products.freedom
            # the prior of the set is what its odds have beyond its likelihood with all rows
            whole = problem.products.ratio(one.weighed.blocks, SIZES[list(one.weighed.sizes)])
            odds.append(np.log(one.probability) - whole + products.ratio(local, sizes))
            means.append(mean)
            spreads.append((variance, covariance))
        shares = np.exp(np.array(odds) - logsumexp(odds))
        mean = np.asarray(shares @ np.array(means))
        moved = x[test] - own[test] @ (back @ inside)
        after[test] = y[test] - own[test] @ (back @ score) - moved @ mean
        off = np.array(means) - mean
        covariance = sum(share * c for share, (_, c) in zip(shares, spreads, strict=True)) + off.T @ (
            shares[:, None] * off
        )
        variance = float(sum(share * v for share, (v, _) in zip(shares, spreads, strict=True)))
        spread = np.einsum("mdi,ij,mdj->m", moved, covariance, moved, optimize=True)
        leverage = np.sum(np.square(own[test] @ back), axis=(1, 2))
        predicted[test] = float(np.mean(spread + variance * (leverage + y.shape[1])))
    return LeftOut(before, after, predicted)


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
