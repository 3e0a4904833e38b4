"""Restricted likelihood of noise and sizes against dense matrices and SciPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space
from scipy.optimize import minimize_scalar

from identification.estimation.restricted_likelihood import Restricted

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


def test_likeliest_noise_and_its_likelihood_for_several_sizes() -> None:
    sizes = np.array([0.0, 0.1, 1.0, 7.0])
    values, noises = Restricted.of(*drawn()).likeliest(1e-3, 10.0, sizes)
    for value, noise, size in zip(values, noises, sizes, strict=True):
        best = minimize_scalar(minus_log, args=(size,), bounds=(1e-3, 10.0), method="bounded", options={"xatol": 1e-9})
        np.testing.assert_allclose(value, best.fun, rtol=1e-9)
        np.testing.assert_allclose(
            noise, best.x, rtol=1e-6
        )  # SciPy compares values, flat at the square root of rounding


def test_more_effects_than_residuals() -> None:
    """By the smaller normal matrix: the same density, of 6 residuals, a free column and 15 effects."""
    generator = np.random.default_rng(5)
    target, free, effects = (generator.standard_normal(shape) for shape in ((6,), (6, 1), (6, 15)))
    outside = null_space(free.T)
    left, found = outside.T @ target, Restricted.of(target, free, effects)
    for noise, size in ((0.3, 1.0), (2.0, 0.1)):
        covariance = size**2 * outside.T @ effects @ effects.T @ outside + noise**2 * np.eye(5)
        expected = np.linalg.slogdet(covariance)[1] + left @ np.linalg.solve(covariance, left)
        np.testing.assert_allclose(found.minus_log(np.array(noise), np.array(size)), expected, rtol=1e-12)


def test_noise_ends_at_its_limits_exactly() -> None:
    """A given sigma above the scatter is kept to the last digit, and so is a given noise."""
    found = Restricted.of(*drawn())
    assert found.likeliest(2.0, 10.0, np.ones(1))[1, 0] == 2.0
    values, noises = found.likeliest(1.0, 10.0, np.ones(2), given=True)
    assert noises.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(values, minus_log(1.0, 1.0), rtol=1e-12)
