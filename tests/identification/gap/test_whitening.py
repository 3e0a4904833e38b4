"""Rows and the transformation that makes their noise white, in a plane and in space."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.gap.fit import Rows
from identification.measurements import Measurements

RNG = np.random.default_rng(8)


@pytest.mark.parametrize("d", [2, 3])
def test_a_covariance_of_every_row_and_a_memory_become_white(d: int) -> None:
    """Rows e_i = S_i a_i with a_i = rho a_(i-1) + sqrt(1 - rho^2) new have covariance S_i rho^|i-k| S_k.

    For one memory of all rows the whitener undoes the spreads first, then the memory: L C L^T = I.
    """
    m, rho = 6, 0.6
    half = RNG.normal(size=(m, d, d))
    spread = half @ half.transpose(0, 2, 1) + np.eye(d)
    measured = Measurements(RNG.uniform(-1, 1, (m, 2)), RNG.normal(size=(m, d)))
    rows = replace(Rows.of(measured), spread=spread, correlation=rho)
    assert rows.dimension == d
    blocks = np.zeros((m * d, m * d))
    for i in range(m):
        blocks[i * d : (i + 1) * d, i * d : (i + 1) * d] = spread[i]
    memory = rho ** np.abs(np.subtract.outer(np.arange(m), np.arange(m)))
    covariance = blocks @ np.kron(memory, np.eye(d)) @ blocks
    whitener = rows.whiten(np.eye(m * d).reshape(m, d, m * d))
    np.testing.assert_allclose(whitener @ covariance @ whitener.T, np.eye(m * d), atol=1e-10)
    assert rows.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1], rel=1e-12)


def test_a_sigma_per_row_is_a_relative_weight() -> None:
    measured = Measurements(np.zeros((3, 1)), np.arange(9.0).reshape(3, 3), sigma=[1.0, 2.0, 4.0])
    rows = Rows.of(measured)
    np.testing.assert_allclose(rows.whiten(rows.positions).reshape(3, 3), rows.positions / [[0.5], [1.0], [2.0]])
    assert rows.log_determinant == pytest.approx(0.0, abs=1e-12)  # the geometric mean of the weights is one
