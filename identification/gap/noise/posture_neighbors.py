"""Lag-1 correlation of residuals, net of what posture explains.

On a grid, or along a path, consecutive rows are neighbors in posture too, and an effect missing in the model makes
their residuals similar. Each residual is therefore compared with the mean of residuals near in posture but distant in
time; what that mean explains is not serial correlation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.gap.fits.whitening import Rows
from identification.gap.noise.quadratic_forms import Form, LagForm, SparseForm

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# reasons: identification/README.md, "Constants"
FAR = 0.1  # of the session, between two rows that share no slow error
NEIGHBORS, SEARCHED = 4, 64
NOTHING = 1e-20  # of a sum of squares: rounding, which has no correlation
EXPLAINS = 3.0  # standard deviations of the slope on the neighbors' mean


class Lag(NamedTuple):
    """The lag-1 correlation of residuals as a quadratic form.

    size : correlation of the part that posture does not explain, as a fraction of the total variance; None where
        posture explains nothing
    """

    form: Form
    size: float | None


def lag_of(rows: Rows, residual: Array) -> Lag:
    """Lag-1 correlation of u = F e, F = I - c S, the part of residuals e (m d,) that posture does not explain.

    S takes the mean over neighbors; c is the regression slope of the residuals on that mean, 0 where it is not clearly
    positive. White noise exceeds the correlation r = u^T L u / u^T u if e^T F^T (L - r I) F e > 0.
    """
    import scipy.sparse as sp

    m, e = len(rows), residual.reshape(len(rows), -1)
    means = neighbor_means(rows)
    near = means @ e
    slope = float(np.clip(np.sum(e * near) / max(np.sum(near**2), 1e-300), 0.0, 1.0))
    if slope * np.sqrt(np.sum(near**2)) <= EXPLAINS * np.sqrt(np.mean(e**2)):
        return Lag(LagForm(rows.sequence, rows.dimension), None)
    before, after = rows.sequence[:-1], rows.sequence[1:]
    lag = sp.csr_array((np.full(m - 1, 0.5), (before, after)), shape=(m, m))
    lag = lag + lag.T
    left = (sp.eye_array(m, format="csr") - slope * means).tocsr()
    u = left @ e
    if np.sum(u**2) <= NOTHING * np.sum(e**2):
        return Lag(LagForm(rows.sequence, rows.dimension), 0.0)
    found = float(np.sum(u * (lag @ u)) / np.sum(u**2))
    products, squares = left.T @ lag @ left, left.T @ left
    white = float(products.trace() / squares.trace())
    return Lag(
        SparseForm((products - found * squares).tocsr(), rows.dimension),
        float((found - white) * np.sum(u**2) / np.sum(e**2)),
    )


def neighbor_means(rows: Rows) -> csr_array:
    """(m, m) sparse matrix that takes the mean over the `NEIGHBORS` rows nearest in posture and `FAR` apart in time.

    A row without any among its `SEARCHED` nearest is empty.
    """
    import scipy.sparse as sp
    from scipy.spatial import KDTree

    m = len(rows)
    turn = np.empty(m)
    turn[rows.sequence] = np.arange(m)
    near = KDTree(rows.postures).query(rows.postures, min(SEARCHED, m))[1].reshape(m, -1)
    far = np.abs(turn[near] - turn[:, None]) >= max(FAR * m, 2.0)
    used = far & (np.cumsum(far, axis=1) <= NEIGHBORS)
    row, place = np.nonzero(used)
    weights = 1.0 / used.sum(axis=1)[row]
    return sp.csr_array((weights, (row, near[row, place])), shape=(m, m))
