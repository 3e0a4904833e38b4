"""Fits with a prior: against ridge regression, the marginal likelihood of all rows, and simulated coverage."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from identification.arm import Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation import estimate, estimate_with_prior
from identification.gap.library_prior import library_prior
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0], sigma=0.1)
LIBRARY = library_prior(ARM, names=["encoder_eccentricity", "gear_ratio"])
MODEL, PRIOR = LIBRARY.model, LIBRARY.prior
SIZES = MODEL.parameters.vector(PRIOR.deviations)


def measured(generator: np.random.Generator, rows: int, noise: float) -> tuple[Measurements, Array]:
    """Rows of an arm with small errors and effects of the prior, and its parameters."""
    truth = SIZES * generator.standard_normal(len(SIZES))
    truth[:4] = [0.05, -0.02, 1e-4, 2e-4]  # small: linear theory is the oracle
    postures = generator.uniform(-np.pi, np.pi, (rows, 2))
    positions = MODEL.position(postures, truth)
    return Measurements(postures, positions + noise * generator.standard_normal(positions.shape)), truth


def linear(data: Measurements) -> tuple[Array, Array]:
    """(N,) residuals of the nominal arm and (N, p) Jacobian there."""
    zero = np.zeros(len(SIZES))
    return (data.positions - MODEL.position(data.postures, zero)).ravel(), MODEL.jacobian(data.postures, zero).reshape(
        -1, len(SIZES)
    )


def test_it_is_ridge_regression_where_the_noise_is_given() -> None:
    data, _ = measured(np.random.default_rng(0), 8, 0.1)
    found = estimate_with_prior(MODEL, data, PRIOR, sigma="given")
    residual, jacobian = linear(data)
    precision = jacobian.T @ jacobian / 0.01 + np.diag(np.where(SIZES > 0.0, 1.0 / np.maximum(SIZES, 1e-300), 0.0) ** 2)
    covariance = np.linalg.inv(precision)
    assert np.diag(found.covariance) == pytest.approx(np.diag(covariance), rel=1e-3)
    expected = covariance @ jacobian.T @ residual / 0.01
    assert np.abs(found.parameters - expected).max() <= 1e-2 * np.sqrt(np.diag(covariance)).max()
    assert found.uncertainty.kind == "given"
    assert found.std[4:].max() <= 5e-4  # no less sure than the prior


def test_noise_is_that_of_the_largest_marginal_likelihood() -> None:
    """Of all rows' covariance, the geometry's with a variance that is as good as infinite."""
    data, _ = measured(np.random.default_rng(1), 15, 0.4)
    found = estimate_with_prior(MODEL, data, PRIOR)
    residual, jacobian = linear(data)
    variances = np.where(SIZES > 0.0, SIZES, 1e3 / MODEL.parameters.scales) ** 2

    def minus_log(noise: float) -> float:
        covariance = jacobian * variances @ jacobian.T + noise**2 * np.eye(len(residual))
        return float(np.linalg.slogdet(covariance)[1] + residual @ np.linalg.solve(covariance, residual))

    expected = minimize_scalar(minus_log, bounds=(0.1, 2.0), method="bounded").x
    assert found.scatter == pytest.approx(expected, rel=1e-2)
    assert found.uncertainty.kind == "scatter"
    assert found.sigma == 0.1  # what was given is still said, and that chi2 rejects it
    assert found.p_value is not None
    assert found.p_value < 0.01
    alone = estimate_with_prior(MODEL, data, PRIOR, sigma="estimated")
    assert alone.sigma == pytest.approx(expected, rel=1e-2)


def test_noise_is_no_less_than_what_is_given() -> None:
    data, _ = measured(np.random.default_rng(2), 15, 0.01)
    assert estimate_with_prior(MODEL, data, PRIOR).scatter == 0.1


def test_geometry_carries_the_uncertainty_of_the_effects() -> None:
    """95 % intervals of the geometry of 40 arms with effects of the prior: with it they hold, least squares' do not.

    A binomial share of 400 correlated values, four of each arm: standard error at most sqrt(.05 * .95 / 40) = 3.4 %.
    """
    generator, held, plain = np.random.default_rng(3), [], []
    for _ in range(40):
        data, truth = measured(generator, 8, 0.1)
        for kept, found in (
            (held, estimate_with_prior(MODEL, data, PRIOR, sigma="given")),
            (plain, estimate(Model(ARM), data, sigma="given")),
        ):
            low, high = found.intervals[:4].T
            kept.append((low <= truth[:4]) & (truth[:4] <= high))
    assert np.mean(held) == pytest.approx(0.95, abs=4 * 0.034)
    assert np.mean(plain) < 0.8


def test_fewer_rows_than_parameters_are_enough() -> None:
    data, _ = measured(np.random.default_rng(4), 3, 0.1)
    assert estimate_with_prior(MODEL, data, PRIOR).identifiable.all()
    with pytest.raises(InputError, match="fewer equations than unknowns: 2 m = 2 < p = 4"):
        estimate_with_prior(MODEL, measured(np.random.default_rng(4), 1, 0.1)[0], PRIOR)
