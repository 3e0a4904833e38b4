"""The closed form against scipy and complex arithmetic."""

from __future__ import annotations

import numpy as np
import pytest

from identification import Arm, EffectSpec, Measurements, Model, estimate
from tests.identification.estimation.cases import arm, data, plan, scipy_fit

BASE = (EffectSpec("base_offset"),)


@pytest.mark.parametrize("effects", [(), BASE], ids=["base", "base_offset"])
@pytest.mark.parametrize("m", [6, 200])
def test_equals_scipy_with_weights(effects: tuple[EffectSpec, ...], m: int) -> None:
    model = Model(arm(*effects))
    measurements = data(model, plan(m))
    weights = np.random.default_rng(0).uniform(0.2, 5.0, m)
    closed = estimate(model, measurements, sigma=weights**-0.5)
    other = scipy_fit(model, measurements, weights)
    # scipy stops at a relative change of the cost of 1e-15: about 1e-7 of a standard deviation (0.03 mm)
    np.testing.assert_allclose(closed.parameters * model.scales, other.x * model.scales, rtol=0, atol=1e-7)
    weighted = np.sum(weights[:, None] * closed.residuals_after**2)
    assert weighted <= 2.0 * other.cost * (1.0 + 1e-10)  # residuals of .1 mm, rounded to 1e-13


@pytest.mark.parametrize("n", [1, 3, 6])
def test_exact_data_give_the_exact_arm_whatever_the_offsets(n: int) -> None:
    """Offsets of any size, even half a turn, and lengths 30 % off: there is no start to be poor."""
    generator = np.random.default_rng(n)
    lengths = generator.uniform(50.0, 300.0, n)
    model = Model(Arm(lengths, effects=BASE))
    true = np.r_[
        lengths * generator.uniform(-0.3, 0.3, n), generator.uniform(-3.1, 3.1, n), generator.uniform(-500, 500, 2)
    ]
    postures = generator.uniform(-np.pi, np.pi, (3 * n + 3, n))
    found = estimate(model, Measurements(postures, model.position(postures, true)))
    # up to the condition number of the random plan (below 1e3) times rounding of 1e3 mm
    np.testing.assert_allclose(found.parameters * model.scales, true * model.scales, rtol=0, atol=1e-7)
    assert found.rms_after < 1e-9


@pytest.mark.parametrize(
    "model",
    [Model(arm(EffectSpec("gear_ratio", 2))), Model(arm(), held={"length_error:1": 0.0})],
    ids=["gear", "known"],
)
def test_other_models_are_searched_for(model: Model) -> None:
    assert estimate(model, data(Model(arm()), plan(10))).method == "levenberg_marquardt"
