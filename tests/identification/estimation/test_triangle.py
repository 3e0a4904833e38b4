"""Triangles against the tables that they stand for."""

from __future__ import annotations

import numpy as np
import pytest

from identification.estimation.levenberg_marquardt import BLOCK, compressed, triangle


@pytest.mark.parametrize("rows", [6, 300, 2 * BLOCK + 3])
def test_sums_and_products_stay(rows: int) -> None:
    table = np.random.default_rng(1).standard_normal((rows, 5))
    found = triangle(table[start : start + BLOCK] for start in range(0, rows, BLOCK))
    assert found.shape == (5, 5)
    np.testing.assert_allclose(np.tril(found, -1), 0.0, atol=1e-12 * rows)
    np.testing.assert_allclose(found.T @ found, table.T @ table, rtol=0, atol=1e-13 * rows)


def test_the_solution_is_the_same() -> None:
    """By the normal equations, which the triangle does not see."""
    generator = np.random.default_rng(2)
    jacobian, residual = generator.standard_normal((1, 500, 4)), generator.standard_normal((1, 500))
    short_residual, short = compressed(residual, jacobian)
    assert short.shape == (1, 5, 4)
    expected = np.linalg.solve(jacobian[0].T @ jacobian[0], jacobian[0].T @ residual[0])
    np.testing.assert_allclose(np.linalg.lstsq(short[0], short_residual[0])[0], expected, atol=1e-13)
    assert np.linalg.norm(short_residual) == pytest.approx(np.linalg.norm(residual), rel=1e-13)
    few = jacobian[:, :90], residual[:, :90]
    assert compressed(few[1], few[0])[1] is few[0]
