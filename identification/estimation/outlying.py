"""Rows that no model of this kind explains: a lost beam, a swapped marker, an arm that was still moving.

An outlier is a row by itself. Where rows that nothing explains come together, all those of one posture or many in one
stretch of a joint's angles, it is what the model lacks there, and they stay in the fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtrc, chdtri, pdtrc

from identification.arrays import Array
from identification.information import column_space

# reasons: identification/README.md, "Constants"
OUTLIER = 6.0  # robust standard deviations in a plane, else the same chance; 3 in 10,000 clean data sets have one
MOST_OUTLIERS = 0.25  # of the rows: the robust scale is then 1.26 times too large; more is structure
AT_ONCE = 1000  # rows, of which one is taken out before the model is fitted again
CHANCE = 1e-3  # of calling outliers that are independent of each other structure, in one data set
STRETCHES, SHORTEST = 16, 8  # of each joint's angles, and rows in each


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
    blocks, known = basis[: m * d].reshape(m, d, -1), basis[m * d :]
    moment = known.T @ (np.zeros(len(known)) if left is None else left)
    kept, limit = np.ones(m, dtype=bool), limit_of(d)
    for _ in range(int(MOST_OUTLIERS * m) + 1):
        squares = studentised(residual, blocks, kept, known, moment)
        worst = np.argsort(squares)[-(1 + m // AT_ONCE) :]
        if squares[worst[-1]] <= limit:
            return ~kept if np.mean(kept) >= 1.0 - MOST_OUTLIERS else np.zeros(m, dtype=bool)
        kept[worst[squares[worst] > limit]] = False
    return np.zeros(m, dtype=bool)


def together(outlier: NDArray[np.bool_], postures: Array, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(m,) those of the outliers that come together, as rows that are wrong by accident do not.

    If as many outliers fall on rows independently of each other, their number in a group of rows is about binomial, and
    the number of groups with x or more of them about Poisson (both a little wider than they are, since groups compete
    for the outliers). Groups are the rows of one posture (reflectors, repeats), and the postures in a stretch of a
    joint's angles, with an outlier or without; x is 2, 3, 5, 9 .., and p-values get Bonferroni's correction.

    outlier : (m,) rows that a fit does not explain;  postures : (m, n);  numbers : (m,) posture of each row
    """
    _, first, posture = np.unique(numbers, return_index=True, return_inverse=True)
    posture, count = posture.ravel(), len(first)
    of_posture = np.bincount(posture, outlier) > 0.0
    parts = max(min(STRETCHES, count // SHORTEST), 1)
    stretches = [np.argsort(np.argsort(angles, kind="stable")) * parts // count for angles in postures[first].T]
    p_values, chosen = [], []
    for wrong, groups in [(outlier, posture), *((of_posture, stretch) for stretch in stretches)]:
        sizes, found = np.bincount(groups), np.bincount(groups, wrong)
        x = 2
        while x <= found.max():
            p_values.append(pdtrc(np.sum(found >= x) - 1, np.sum(bdtrc(x - 1, sizes, np.mean(wrong)))))
            rows = (found >= x)[groups]
            chosen.append(rows if wrong is outlier else rows[posture])
            x = 2 * x - 1
    structure = np.zeros(len(outlier), dtype=bool)
    for p, rows in zip(p_values, chosen, strict=True):
        structure |= rows & outlier & (p <= CHANCE / len(p_values))
    return structure


def studentised(
    residual: Array, blocks: Array, kept: NDArray[np.bool_], known: Array | None = None, moment: Array | None = None
) -> Array:
    """(m,) squared residual of each row in units of its own covariance and of the robust scale of the kept rows, after
    a fit to these; 0 of the others.

    residual : (m, d);  blocks : (m, d, k) columns that are orthonormal together with `known` (r, k), rows of a prior;
    moment : (k,) known.T times the prior's residuals
    """
    d, k = blocks.shape[1:]
    own, inside, squares = blocks[kept], residual[kept], np.zeros(len(kept))
    flat = own.reshape(inside.size, k)
    normal = flat.T @ flat if known is None else flat.T @ flat + known.T @ known
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    right = flat.T @ inside.reshape(-1) if moment is None else flat.T @ inside.reshape(-1) + moment
    off = inside - own @ (inverse @ right)
    rest = (1.0 + 1e-6) * np.eye(d) - (flat @ inverse).reshape(own.shape) @ own.transpose(0, 2, 1)
    squares[kept] = robust_squares(np.einsum("mi,mi->m", off, np.linalg.solve(rest, off[..., None])[..., 0]), d)
    return squares


def robust_squares(squares: Array, d: int) -> Array:
    """Squared distances (m,) of d coordinates in units of their robust variance: the median of chi-square is kept."""
    return np.asarray(squares / max(np.median(squares) / chdtri(d, 0.5), 1e-300))
