"""Spatial arms: what a fit needs, and that it starts from nothing and is held by the prior of machining.

Closed form and search against scipy for models with effects, bounds, poor starts; and complex arithmetic.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Measurements, Model, Status, estimate
from identification.arm import Arm, EffectSpec, Machining
from identification.kinematics.chain import KinematicChain
from identification.kinematics.frames import from_roll_pitch_yaw, pose
from tests.identification.estimation.cases import arm, data, plan, scipy_fit
from tests.identification.model.test_placed import CHAIN

SIGMA = 0.05


def measured(model: Model, values: np.ndarray, rows: int, seed: int) -> Measurements:
    generator = np.random.default_rng(seed)
    postures = generator.uniform(-2.5, 2.5, (rows, 6))
    noise = SIGMA * generator.standard_normal((rows, 3))
    return Measurements(postures, model.position(postures, values) + noise)


def true_chain() -> KinematicChain:
    base = pose((2000.0, 300.0, -400.0), from_roll_pitch_yaw(0.2, -0.1, 2.0))
    return replace(CHAIN, base=base, tools={"1": np.array([40.0, -90.0, 60.0])})


def test_machining_decides_how_far_corrections_go() -> None:
    truth = Model(Arm(true_chain()))
    data = measured(truth, np.zeros(len(truth.names)), 60, 2)
    tight = Machining(1e-6, 1e-9)
    found = estimate(Model(Arm(CHAIN, sigma=SIGMA, machining=tight)), data)
    held = [k for k, name in enumerate(found.names) if name in found.model.prior]
    assert np.abs(found.parameters[held]).max() < 1e-5
    assert Model(Arm(replace(CHAIN, fixed=frozenset({"translation_x:2"})))).prior == {}


MODELS = {
    "eccentricity": (EffectSpec("encoder_eccentricity", 2),),
    "two": (EffectSpec("encoder_second_harmonic", 3), EffectSpec("gear_ratio", 1)),
    "compliance": (EffectSpec("joint_compliance"),),
    "bending": (EffectSpec("link_bending"), EffectSpec("base_offset")),
    "thermal": (EffectSpec("thermal_growth"), EffectSpec("base_drift")),
    "backlash": (EffectSpec("backlash", 2), EffectSpec("axes_skew")),
    "ripple": (EffectSpec("transmission_ripple", 1, {"k": 7.0}), EffectSpec("base_rotation_drift")),
}
BASE = (EffectSpec("base_offset"),)


def same(model: Model, measurements: Measurements, weights: np.ndarray | None = None) -> None:
    found = estimate(model, measurements, None if weights is None else weights**-0.5)
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
    if name in ("eccentricity", "compliance"):
        same(model, data(model, plan(40)), np.random.default_rng(5).uniform(0.1, 10.0, 40))


@pytest.mark.parametrize("seed", range(3))
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


def test_poor_start_without_the_closed_form_is_damped() -> None:
    """With one length known the closed form is no start; offsets of 40 degrees must still be found."""
    model = Model(arm(), held={"length_error:1": 0.0})
    true = np.r_[-0.6, -0.4, 0.7, np.radians([40.0, -40.0, 30.0, -30.0])]
    found = estimate(model, Measurements(plan(20), model.position(plan(20), true)))
    assert found.status is Status.converged
    np.testing.assert_allclose(found.parameters, true, rtol=0, atol=1e-9)


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
