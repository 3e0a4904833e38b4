"""Gram matrices of columns over parts of the rows, for any serial correlation from a single pass.

Decorrelated for a lag-1 correlation r, rows x_i in the order of measurement become
(x_i - r x_(i-1)) / (1 - r^2)^(1/2), with the first row unchanged. Their Gram matrix is
(A - r L + r^2 B) / (1 - r^2), where A sums the products of each row with itself, L those of each row with the row
before (symmetrized), and B those of the rows before with themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array


class LaggedProducts(NamedTuple):
    """The sums of products over each fold of the rows, (folds, n, n) each.

    first : of the first row;  own : A, of the other rows;  across, before : L and B, None: not needed
    """

    first: Array
    own: Array
    across: Array | None = None
    before: Array | None = None

    def add(self, columns: Array, fold: NDArray[np.int64], d: int) -> None:
        """Add rows of d coordinates, in the order of measurement, in place.

        columns : (N, n), or (d + N, n) with the row before the first of them;  fold : (N,) fold of each
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
