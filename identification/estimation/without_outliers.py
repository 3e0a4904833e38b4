"""Fits again and again without the rows that the last fit does not explain, until it explains all that are left."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from identification.estimation.result import Identification
from identification.measurements import Measurements


def without_outliers(
    fit: Callable[[Measurements], Identification], measurements: Measurements
) -> tuple[Identification, tuple[int, ...]]:
    """The fit to the rows that are no outliers of it, and the numbers (from 1) of the rows left out.

    fit : `lambda rows: estimate(model, rows)`, say; it is called with fewer rows each time, and once more than the
        rounds that find an outlier

    A gravity that the model lacks makes outliers, too, so look at the rows that were left out. Raises what `fit` does.
    """
    kept = np.arange(len(measurements))
    while True:
        fitted = fit(measurements.rows(kept))
        if not fitted.outlier_rows:
            left_out = np.setdiff1d(np.arange(len(measurements)), kept)
            return fitted, tuple((left_out + 1).tolist())
        kept = np.delete(kept, np.array(fitted.outlier_rows) - 1)
