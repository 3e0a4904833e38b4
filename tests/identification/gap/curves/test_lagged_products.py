"""Products of rows for any correlation, against the rows decorrelated one by one."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.curves.lagged_products import LaggedProducts


@pytest.mark.parametrize("step", [1, 3, 50])
def test_products_of_decorrelated_rows(step: int) -> None:
    rng = np.random.default_rng(5)
    rows, fold = rng.normal(size=(20, 2, 4)), rng.integers(0, 3, 20)
    found = LaggedProducts(*np.zeros((4, 3, 4, 4)))
    for k in range(0, 20, step):
        start = max(k - 1, 0)
        found.add(rows[start : k + step].reshape(-1, 4), np.repeat(fold[k : k + step], 2), 2)
    for rho in (0.0, 0.6):
        white = np.concatenate([rows[:1], (rows[1:] - rho * rows[:-1]) / np.sqrt(1.0 - rho**2)])
        expected = [np.einsum("mdi,mdj->ij", white[fold == k], white[fold == k]) for k in range(3)]
        np.testing.assert_allclose(found.at(rho), expected, rtol=1e-12, atol=1e-12)
