"""Restricted likelihood of noise and sizes against dense matrices and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import minimize_scalar

from identification.estimation.prior import likeliest_noise, restricted_likelihood

Array = NDArray[np.float64]


def drawn() -> tuple[Array, Array, Array]:
    """40 residuals with noise 0.3, of 3 free columns and 8 effects of deviation one."""
    generator = np.random.default_rng(8)
    free, effects = generator.standard_normal((40, 3)), generator.standard_normal((40, 8))
    return 0.3 * generator.standard_normal(40) + effects @ generator.standard_normal(8), free, effects


def minus_log(noise: float, size: float) -> float:
    """-2 log of the normal density of what is orthogonal to the free columns, without its constant."""
    target, free, effects = drawn()
    outside = null_space(free.T)
    covariance = size**2 * outside.T @ effects @ effects.T @ outside + noise**2 * np.eye(outside.shape[1])
    left = outside.T @ target
    return float(np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left))


@pytest.mark.parametrize("size", [0.0, 0.1, 1.0, 7.0])
def test_likeliest_noise_and_its_likelihood(size: float) -> None:
    target, free, effects = drawn()
    value, noise = likeliest_noise(restricted_likelihood(target, free, size * effects), 1e-3, 10.0)
    best = minimize_scalar(minus_log, args=(size,), bounds=(1e-3, 10.0), method="bounded", options={"xatol": 1e-9})
    assert value == pytest.approx(best.fun, rel=1e-9)
    assert noise == pytest.approx(best.x, rel=1e-6)  # SciPy compares values, flat at the square root of rounding


def test_more_effects_than_residuals() -> None:
    """By the smaller normal matrix: the same density, of 6 residuals, a free column and 15 effects."""
    generator = np.random.default_rng(5)
    target, free, effects = (generator.standard_normal(shape) for shape in ((6,), (6, 1), (6, 15)))
    outside = null_space(free.T)
    left = outside.T @ target
    for noise, size in ((0.3, 1.0), (2.0, 0.1)):
        covariance = size**2 * outside.T @ effects @ effects.T @ outside + noise**2 * np.eye(5)
        expected = np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left)
        found = restricted_likelihood(target, free, size * effects)(np.array(noise))
        assert found == pytest.approx(expected, rel=1e-12)


def test_noise_ends_at_its_limits_exactly() -> None:
    """A given sigma above the scatter is kept to the last digit, and so is a given noise."""
    found = restricted_likelihood(*drawn())
    assert likeliest_noise(found, 2.0, 10.0)[1] == 2.0
    value, noise = likeliest_noise(found, 1.0, 1.0)
    assert noise == 1.0
    assert value == pytest.approx(minus_log(1.0, 1.0), rel=1e-12)


@pytest.mark.parametrize("rows", [9, 40])
def test_rows_that_stand_for_a_share_of_themselves(rows: int) -> None:
    """Directions that the share leaves no equations for are noise alone: -2 log has as many logarithms fewer."""
    generator = np.random.default_rng([3, rows])
    target, free, effects = (generator.standard_normal(shape) for shape in ((rows,), (rows, 2), (rows, 4)))
    outside, spare = null_space(free.T), max(round(0.25 * (rows - 2)), 4)
    left, columns = 0.5 * outside.T @ target, 0.5 * outside.T @ effects
    covariance = columns @ columns.T + 0.7**2 * np.eye(rows - 2)
    expected = np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left)
    expected += (spare - (rows - 2)) * 2.0 * np.log(0.7)
    found = restricted_likelihood(0.5 * target, free, 0.5 * effects, spare)(np.array(0.7))
    assert found == pytest.approx(expected, rel=1e-10)
