"""Rows that no model of this kind explains: a lost beam, a swapped marker, an arm that was still moving."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from identification.arrays import Array
from identification.information import column_space

# reasons: identification/README.md, "Constants"
OUTLIER = 6.0  # robust standard deviations in a plane, else the same chance; 3 in 10,000 clean data sets have one
MOST_OUTLIERS = 0.25  # of the rows: the robust scale is then 1.26 times too large; more is structure
AT_ONCE = 1000  # rows, of which one is taken out before the model is fitted again


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
