"""Products of columns over parts of the rows, for any serial correlation at once.

Rows x_i in the order of measurement, less what a correlation r predicts from the row before, are
(x_i - r x_(i-1)) / (1 - r^2)^(1/2), the first row stays as it is. The products of these with one another are
(A - r L + r^2 B) / (1 - r^2) with A, L, B the products of rows with themselves, of each row with the one before (both
ways), and of the rows before with themselves; so one pass over the rows serves every r.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array


class LaggedProducts(NamedTuple):
    """(folds, n, n) each, over the rows of every fold.

    first : of the first row;  own : of the others;  across, before : with the row before, None: not needed
    """

    first: Array
    own: Array
    across: Array | None = None
    before: Array | None = None

    def add(self, columns: Array, fold: NDArray[np.int64], d: int) -> None:
        """More rows of d coordinates in the order of measurement, in place.

        columns : (N, n), or (d + N, n) with the row before the first of them;  fold : (N,)
        """
        started = len(columns) > len(fold)
        rows = columns[d:] if started else columns
        if not started:
            self.first[fold[0]] += rows[:d].T @ rows[:d]
        later = np.arange(len(fold)) >= (0 if started else d)
        for k in np.unique(fold[later]).tolist():
            own = rows[chosen := np.flatnonzero(later & (fold == k))]
            self.own[k] += own.T @ own
            if self.across is not None and self.before is not None:
                earlier = columns[chosen + len(columns) - len(fold) - d]
                product = own.T @ earlier
                self.across[k] += product + product.T
                self.before[k] += earlier.T @ earlier

    def at(self, correlation: float) -> Array:
        """(folds, n, n) products of the decorrelated rows."""
        if not correlation or self.across is None or self.before is None:
            return self.first + self.own
        squares = self.own - correlation * self.across + correlation**2 * self.before
        return np.asarray(self.first + squares / (1.0 - correlation**2))
