"""Rows that no model of this kind explains: a lost beam, a swapped marker, an arm that was still moving.

An outlier is a row by itself. Where rows that nothing explains come together, all those of one posture or many in one
stretch of a joint's angles, it is what the model lacks there, and they stay in the fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, chdtrc, chdtri, pdtrc

from identification.arrays import Array
from identification.information import column_space, product_inverse

# derived: robust standard deviations in a plane, the same chance in space. At 6 at most 3 in 10,000 clean data sets of
# 8 to 200 rows lose a row; at 4 it would be 3 to 70 in 1,000, at 3 from 4 % to 89 %
OUTLIER = 6.0
MOST_OUTLIERS = 0.25  # of the rows; derived: the robust scale is then 1.26 times too large; more is structure
CHANCE = 1e-3  # convention: of calling outliers that are independent of each other structure, in one data set


def limit_of(d: int) -> float:
    """The squared distance of d coordinates, in units of their variance, beyond which a row is an outlier."""
    return float(chdtri(d, chdtrc(2, OUTLIER**2)))


def outlying(
    residual: Array, columns: Array, held: Array | None = None, left: Array | None = None
) -> NDArray[np.bool_]:
    """(m,) rows whose residual the model does not explain.

    The worst row is taken out and the linear model fitted again, until none is farther off than `OUTLIER`: studentised
    squared residuals of d coordinates, over their robust scale, are chi-square with d degrees of freedom.

    residual : (m, d) whitened, of any fit;  columns : (m d, p) its whitened Jacobian
    held, left : (r, p) rows and (r,) residuals of a prior
    """
    (m, d), p = residual.shape, columns.shape[1]
    basis = column_space(columns if held is None else np.concatenate([columns, held]), np.ones(p))
    blocks, held_basis = basis[: m * d].reshape(m, d, -1), basis[m * d :]
    moment = held_basis.T @ (np.zeros(len(held_basis)) if left is None else left)
    kept, limit = np.ones(m, dtype=bool), limit_of(d)
    for _ in range(int(MOST_OUTLIERS * m) + 1):
        squares = studentised(residual, blocks, kept, held_basis, moment)
        worst = np.argsort(squares)[-(1 + m // 1000) :]  # several at once only to save effort
        if squares[worst[-1]] <= limit:
            return ~kept if np.mean(kept) >= 1.0 - MOST_OUTLIERS else np.zeros(m, dtype=bool)
        kept[worst[squares[worst] > limit]] = False
    return np.zeros(m, dtype=bool)


def together(outlier: NDArray[np.bool_], postures: Array, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(m,) those of the outliers that come together, as rows that are wrong by accident do not.

    If as many outliers fall on rows independently of each other, their number in a group of rows is hypergeometric, and
    the number of groups with x or more of them about Poisson (a little wider than it is, since groups compete for the
    outliers). Groups are the rows of one posture (reflectors, repeats), and the postures in a stretch of a joint's
    angles, with an outlier or without; x is 2, 3, 5, 9 .. Postures and stretches have half of `CHANCE` each, and their
    p-values Bonferroni's correction.

    outlier : (m,) rows that a fit does not explain;  postures : (m, n);  numbers : (m,) posture of each row
    """
    _, first, posture = np.unique(numbers, return_index=True, return_inverse=True)
    posture, count = posture.ravel(), len(first)
    of_posture = np.bincount(posture, outlier) > 0.0
    # up to 16, of eight rows or more: effects of a narrower part of a joint's angles are rare
    parts = max(min(16, count // 8), 1)
    stretches = [np.argsort(np.argsort(angles, kind="stable")) * parts // count for angles in postures[first].T]
    alike = _crowded(outlier, [posture]) & outlier
    return alike | _crowded(of_posture, stretches)[posture] & outlier


def _crowded(wrong: NDArray[np.bool_], groupings: list[NDArray[np.int64]]) -> NDArray[np.bool_]:
    """(m,) items in groups that have more wrong ones than half of `CHANCE` allows;  groupings : (m,) groups of each."""
    p_values, chosen = [], [np.zeros(len(wrong), dtype=bool)]
    for groups in groupings:
        sizes, wrong_in_group = np.bincount(groups), np.bincount(groups, wrong)
        x = 2
        while x <= wrong_in_group.max():
            p_values.append(
                pdtrc(np.sum(wrong_in_group >= x) - 1, np.sum(_tail(x, sizes, int(wrong.sum()), len(wrong))))
            )
            chosen.append((wrong_in_group >= x)[groups])
            x = 2 * x - 1
    limit = 0.5 * CHANCE / max(len(p_values), 1)
    return np.any([rows for rows, p in zip(chosen, [0.0, *p_values], strict=True) if p <= limit], axis=0)


def _tail(x: int, sizes: NDArray[np.int64], wrong: int, count: int) -> Array:
    """(g,) probability of x or more of the wrong ones of a number of items in a group of each size."""
    k = np.arange(x, wrong + 1)[:, None]
    logs = _log_ways(sizes, k) + _log_ways(count - sizes, wrong - k) - _log_ways(np.array(count), np.array(wrong))
    return np.asarray(np.sum(np.exp(logs), axis=0))


def _log_ways(n: NDArray[np.int64], k: NDArray[np.int64]) -> Array:
    """Logarithm of the number of ways to choose k of n."""
    possible = k <= n
    return np.where(possible, -np.log1p(n) - betaln(np.where(possible, n - k, 0) + 1.0, k + 1.0), -np.inf)


def studentised(residual: Array, blocks: Array, kept: NDArray[np.bool_], held_rows: Array, moment: Array) -> Array:
    """(m,) squared residual of each row in units of its own covariance and of the robust scale of the kept rows, after
    a fit to these; 0 of the others.

    residual : (m, d);  blocks : (m, d, k) columns that are orthonormal together with `held_rows`
    held_rows : (r, k) of a prior, r = 0 without;  moment : (k,) held_rows.T times the prior's residuals
    """
    d, k = blocks.shape[1:]
    kept_blocks, inside, squares = blocks[kept], residual[kept], np.zeros(len(kept))
    flat = kept_blocks.reshape(inside.size, k)
    inverse = product_inverse(flat.T @ flat + held_rows.T @ held_rows)
    off = inside - kept_blocks @ (inverse @ (flat.T @ inside.reshape(-1) + moment))
    rest = (1.0 + 1e-6) * np.eye(d) - (flat @ inverse).reshape(kept_blocks.shape) @ kept_blocks.transpose(0, 2, 1)
    squares[kept] = robust_squares(np.einsum("mi,mi->m", off, np.linalg.solve(rest, off[..., None])[..., 0]), d)
    return squares


def robust_squares(squares: Array, d: int) -> Array:
    """Squared distances (m,) of d coordinates in units of their robust variance: the median of chi-square is kept."""
    return np.asarray(squares / max(np.median(squares) / chdtri(d, 0.5), 1e-300))
