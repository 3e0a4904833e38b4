"""Gauss-Newton against scipy for models with effects, bounds, poor starts; and the paper's steps."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import EffectSpec
from identification.errors import InputError
from identification.estimation import estimate
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status
from tests.identification.estimation.cases import arm, data, plan, scipy_fit, truth

MODELS = {
    "eccentricity": (EffectSpec("encoder_eccentricity", 2),),
    "two": (EffectSpec("encoder_second_harmonic", 3), EffectSpec("gear_ratio", 1)),
    "compliance": (EffectSpec("joint_compliance"),),
    "bending": (EffectSpec("link_bending"), EffectSpec("base_offset")),
    "thermal": (EffectSpec("thermal_growth"), EffectSpec("base_drift")),
    "backlash": (EffectSpec("backlash", 2), EffectSpec("axes_skew")),
    "ripple": (EffectSpec("transmission_ripple", 1, {"k": 7.0}), EffectSpec("base_rotation_drift")),
    "nothing": (),
}


def same(model: Model, measurements: Measurements, weights: np.ndarray | None = None) -> None:
    found = estimate(model, measurements, "gauss_newton", weights=weights)
    other = scipy_fit(model, measurements, weights)
    assert found.status is Status.converged
    # both are stationary to 1e-9 of the residuals; scipy's bounded search stops at about 1e-6 mm from a bound
    np.testing.assert_allclose(found.parameters * model.scales, other.x * model.scales, rtol=0, atol=3e-6)
    assert found.rms_after > 0.01
    w = np.ones(len(measurements)) if weights is None else weights
    assert np.sum(w[:, None] * found.residuals_after**2) <= 2.0 * other.cost * (1.0 + 1e-10)


@pytest.mark.parametrize("name", MODELS)
def test_equals_scipy(name: str) -> None:
    model = Model(arm(*MODELS[name]))
    same(model, data(model, plan(40)))


@pytest.mark.parametrize("name", ["eccentricity", "compliance"])
def test_equals_scipy_with_weights(name: str) -> None:
    model = Model(arm(*MODELS[name]))
    same(model, data(model, plan(40)), np.random.default_rng(5).uniform(0.1, 10.0, 40))


@pytest.mark.parametrize("seed", range(6))
def test_bounds_are_respected_and_optimal(seed: int) -> None:
    """No compliance in the truth: some of the c_j >= 0 end on their bound; Karush-Kuhn-Tucker from the outside."""
    model = Model(arm(*MODELS["compliance"]))
    measurements = data(model, plan(40), seed=seed, size=0.0)
    found = estimate(model, measurements, sigma=0.1)
    c = found.parameters[8:]
    assert np.all(c >= 0.0)
    gradient = np.einsum("mdp,md->p", model.jacobian(plan(40), found.parameters), found.residuals_after)
    gradient /= np.linalg.norm(model.jacobian(plan(40), found.parameters), axis=(0, 1))
    free = np.r_[np.ones(8, dtype=bool), c > 0.0]
    assert np.any(~free)
    np.testing.assert_allclose(gradient[free], 0.0, atol=1e-8)
    assert np.all(gradient[~free] < 0.0)  # more compliance than none would be worse
    assert np.all(found.intervals[8:, 0] >= 0.0)


def test_known_parameters_are_not_moved() -> None:
    base = arm(EffectSpec("encoder_eccentricity", 2, {"a": 0.01}))
    model = Model(base, known={"length_error:2": -0.6})
    assert len(model.names) == 8
    whole = Model(arm(EffectSpec("encoder_eccentricity", 2)))
    true = truth(whole)
    true[8] = 0.01
    exact = whole.position(plan(20), true)
    found = estimate(model, Measurements(plan(20), exact))
    assert found.length_errors[1] == -0.6
    np.testing.assert_allclose(found.parameters[-1], true[9], rtol=0, atol=1e-11)
    assert found.joint_offset_std.shape == (4,)


@pytest.mark.parametrize("offset", [1.0, 2.0, 3.1])
def test_offsets_of_any_size_are_no_poor_start(offset: float) -> None:
    model = Model(arm(EffectSpec("encoder_eccentricity", 2)))
    true = truth(model)
    true[4:8] = [offset, -offset, offset, -offset]
    found = estimate(model, Measurements(plan(20), model.position(plan(20), true)))
    turns = np.r_[np.zeros(4), np.round((found.parameters[4:8] - true[4:8]) / (2 * np.pi)) * 2 * np.pi, np.zeros(2)]
    np.testing.assert_allclose(found.parameters - turns, true, rtol=0, atol=1e-9)


def test_poor_start_without_the_closed_form_is_damped() -> None:
    """With one length known the closed form is no start; offsets of 40 degrees must still be found."""
    model = Model(arm(), known={"length_error:1": 0.0})
    true = np.r_[-0.6, -0.4, 0.7, np.radians([40.0, -40.0, 30.0, -30.0])]
    found = estimate(model, Measurements(plan(20), model.position(plan(20), true)))
    assert found.status is Status.converged
    np.testing.assert_allclose(found.parameters, true, rtol=0, atol=1e-9)


def test_paper_steps_fit_models_with_effects_and_refuse_bounds() -> None:
    model = Model(arm(*MODELS["two"]))
    measurements = data(model, plan(40))
    steps, newton = (estimate(model, measurements, method) for method in ("paper_steps", "gauss_newton"))
    np.testing.assert_allclose(steps.parameters * model.scales, newton.parameters * model.scales, rtol=0, atol=1e-8)
    bounded = Model(arm(*MODELS["compliance"]))
    with pytest.raises(InputError, match=r"paper_steps knows no bounds, joint_compliance.c1 is bounded to \[0, inf\]"):
        estimate(bounded, data(bounded, plan(40)), "paper_steps")
