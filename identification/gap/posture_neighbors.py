"""What posture explains of residuals, without a model: rows near in posture that were measured at another time.

On a grid, or along a path, consecutive rows are neighbors in posture too, and an effect that is not in the model makes
their residuals alike. So each residual is compared with the mean of those near it in posture and far from it in time;
what that mean explains is not serial correlation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from identification.arrays import Array
from identification.gap.quadratic_forms import Form, LagForm, SparseForm
from identification.gap.whitening import Rows

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# reasons: identification/README.md, "Constants"
FAR = 0.1  # of the session, between two rows that share no slow error
NEIGHBORS, SEARCHED = 4, 64
EXPLAINS = 3.0  # standard deviations of the slope on the neighbors' mean


def lag_form(rows: Rows, residual: Array) -> Form:
    """Lag-1 products of what posture does not explain of residuals (m d,): e^T F^T L F e with F = I - c S.

    S takes the mean over neighbors, c is the slope of the residuals on it; 0 where it is not clearly positive.
    """
    import scipy.sparse as sp

    plain = LagForm(rows.sequence, rows.dimension)
    e = residual.reshape(len(rows), -1)
    means = neighbor_means(rows)
    near = means @ e
    slope = float(np.clip(np.sum(e * near) / max(np.sum(near**2), 1e-300), 0.0, 1.0))
    if slope * np.sqrt(np.sum(near**2)) <= EXPLAINS * np.sqrt(np.mean(e**2)):
        return plain
    m, sequence = len(rows), rows.sequence
    before, after = sequence[:-1], sequence[1:]
    lag = sp.csr_array((np.full(m - 1, 0.5), (before, after)), shape=(m, m))
    left = sp.eye_array(m, format="csr") - slope * means
    return SparseForm((left.T @ (lag + lag.T) @ left).tocsr(), rows.dimension)


def neighbor_means(rows: Rows) -> csr_array:
    """(m, m) that takes the mean over the `NEIGHBORS` rows nearest in posture, at least `FAR` of the session away.

    A row that has none among the `SEARCHED` nearest is left empty.
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
