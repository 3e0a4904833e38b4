"""Data sets on plans of their own, against one fit at a time."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import EffectSpec
from identification.errors import InputError
from identification.estimation import estimate, estimate_each
from identification.estimation.estimate import sessions
from identification.information import covariances, spectrum
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.estimation.cases import SIGMA, arm, plan, scipy_fit, truth
from tests.identification.estimation.test_batch import EFFECTS


def data(model: Model, postures: np.ndarray) -> np.ndarray:
    """(K, m, 2) measurements of all plans."""
    generator = np.random.default_rng(6)
    exact = model.position(postures, truth(model), sessions(postures))
    return exact + SIGMA * generator.standard_normal(exact.shape)


@pytest.mark.parametrize("name", EFFECTS)
def test_equals_single_fits_and_scipy(name: str) -> None:
    model = Model(arm(*EFFECTS[name]))
    n = model.arm.links
    postures = np.random.default_rng(9).uniform(-np.pi, np.pi, (900, 25, n))  # more than one chunk
    positions = data(model, postures)
    fits = estimate_each(model, postures, positions)
    assert fits.converged.all()
    for k in (*range(6), *range(894, 900)):
        single = estimate(model, Measurements(postures[k], positions[k]))
        np.testing.assert_allclose(
            fits.parameters[k] * model.scales, single.parameters * model.scales, rtol=0, atol=1e-7
        )  # mm; a standard deviation is 0.03
        assert fits.rss[k] == pytest.approx(np.sum(single.residuals_after**2), rel=1e-10)
    for k in range(2):
        other = scipy_fit(model, Measurements(postures[k], positions[k]))
        np.testing.assert_allclose(fits.parameters[k] * model.scales, other.x * model.scales, rtol=0, atol=3e-6)


@pytest.mark.parametrize("name", EFFECTS)
def test_covariances_are_those_of_single_plans(name: str) -> None:
    model = Model(arm(*EFFECTS[name]))
    postures = np.random.default_rng(3).uniform(-np.pi, np.pi, (20, 12, model.arm.links))
    jacobians = model.jacobian(postures, truth(model), sessions(postures))
    found = covariances(jacobians, model.scales, 0.2)
    for k, q in enumerate(postures):
        alone = model.jacobian(q, truth(model), Measurements(q, np.zeros((12, 2))).conditions)
        np.testing.assert_allclose(jacobians[k], alone, rtol=1e-14, atol=1e-14)
        rows = alone.reshape(-1, alone.shape[-1]) * (1.0 / model.scales)
        oracle = 0.04 * np.linalg.pinv(rows) @ np.linalg.pinv(rows).T / np.outer(model.scales, model.scales)
        np.testing.assert_allclose(found[k], oracle, rtol=1e-6, atol=1e-9 * np.abs(oracle).max())


@pytest.mark.parametrize("effects", [(), (EffectSpec("encoder_eccentricity", 2),)])
def test_a_plan_that_loses_something_is_not_fitted(effects: tuple[EffectSpec, ...]) -> None:
    model = Model(arm(*effects))
    postures = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 12, model.arm.links))
    postures[1, :, 1] = 0.3  # links 1 and 2 move as one
    fits = estimate_each(model, postures, data(model, postures))
    assert fits.converged.tolist() == [True, False, True]
    assert np.isnan(fits.parameters[1]).all()
    assert np.isnan(covariances(model.jacobian(postures), model.scales)[1]).all()


def test_a_narrow_plan_keeps_its_digits() -> None:
    """Columns of condition 1e5, which squared would cost ten digits; lstsq keeps eleven."""
    model = Model(arm())
    postures = np.random.default_rng(5).uniform(-1e-4, 1e-4, (4, 12, model.arm.links))
    positions = data(model, postures)
    fits = estimate_each(model, postures, positions)
    spread = covariances(model.jacobian(postures), model.scales, 0.1)
    for k, q in enumerate(postures):
        u = np.linalg.lstsq(np.exp(1j * np.cumsum(q, axis=1)), positions[k] @ [1.0, 1.0j], rcond=None)[0]
        lengths = np.abs(u) - model.arm.lengths
        np.testing.assert_allclose(fits.parameters[k, : model.arm.links], lengths, rtol=1e-8)
        alone = 0.01 * spectrum(model.jacobian(q), model.scales).covariance
        np.testing.assert_allclose(spread[k], alone, rtol=1e-5, atol=1e-9 * np.abs(alone).max())


def test_shapes_are_checked() -> None:
    model, postures = Model(arm()), plan(10)
    with pytest.raises(InputError, match=r"postures: shape"):
        estimate_each(model, postures, np.zeros((1, 10, 2)))
    with pytest.raises(InputError, match=r"positions: shape \(1, 9, 2\), allowed: \(1, 10, 2\)"):
        estimate_each(model, postures[None], np.zeros((1, 9, 2)))
