"""The two implementations of the effects agree: plain numpy from their formulas, and CasADi."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind import hidden_effects, simulator
from doe.studies.blind.cells import random_truth
from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.measurements import Conditions, past_from_order
from identification.model import Model

VALUES = {
    "joint_compliance": ({"c": 2e-5}, {"c": 2e-5}),
    "joint_compliance*": ({"c": np.array([1e-5, 2e-5, 3e-5])}, {"c1": 1e-5, "c2": 2e-5, "c3": 3e-5}),
    "encoder_eccentricity": ({"a": 2e-3, "b": -1e-3},) * 2,
    "encoder_second_harmonic": ({"a": 2e-3, "b": -1e-3},) * 2,
    "transmission_ripple": ({"a": 2e-3, "b": -1e-3, "k": 7},) * 2,
    "gear_ratio": ({"e": 1e-3},) * 2,
    "joint_coupling": ({"c": 1e-3},) * 2,
    "backlash": ({"b": 1e-3},) * 2,
    "gravity_backlash": ({"b": 1e-3},) * 2,
    "link_bending": ({"flexibility": 3e-5},) * 2,
    "thermal_growth": ({"a": 2e-4},) * 2,
    "base_offset": ({"x0": 1.0, "y0": -2.0},) * 2,
    "base_drift": ({"v": np.array([1.0, -2.0])}, {"vx": 1.0, "vy": -2.0}),
    "base_rotation_drift": ({"w": 2e-3},) * 2,
    "axes_skew": ({"a": 1e-3, "b": -2e-3},) * 2,
    "thermal_transient": ({"a": 3e-4, "tau": 0.2},) * 2,
    "joint_step": ({"b": 1e-3, "at": 0.1},) * 2,
    "link_step": ({"d": 0.3, "at": -0.2},) * 2,
    "base_step": ({"x": 0.2, "y": -0.3, "at": 0.05}, {"x": 0.2, "y": -0.3, "at": 0.05, "side": 1.0}),
    "joint_hysteresis": ({"b": 1e-3, "width_deg": np.degrees(0.9)},) * 2,
    "payload_error": ({"d": 2.0},) * 2,
    "gravity_tilt": ({"angle": 0.1},) * 2,
}


@pytest.mark.parametrize("name", VALUES)
def test_two_implementations_agree(name: str) -> None:
    rng = np.random.default_rng(1)
    truth = random_truth(rng, 3)
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (40, 3)), rng)
    joint = None if name in hidden_effects.OF_ARM else 2
    theirs, ours = VALUES[name]
    c = 1e-5 * np.arange(1.0, 4.0) if name in hidden_effects.LOADS else np.zeros(3)
    known = EffectSpec("joint_compliance", None, {f"c{j}": value for j, value in enumerate(c, 1)})
    truth = replace(truth, effects=[(name.rstrip("*"), joint, theirs)])
    if name in hidden_effects.LOADS:
        truth = replace(truth, modelled=[("joint_compliance", None, {"c": c})])
    arm = Arm(
        truth.lengths,
        gravity=Gravity(np.array([0.0, -simulator.G]), truth.masses, np.full(3, truth.center), truth.payload),
        effects=(*((known,) if c.any() else ()), EffectSpec(name.rstrip("*"), joint, ours)),
        calibration=Calibration.of(truth.links[:, 0] - truth.lengths, truth.offsets),
    )
    conditions = Conditions(run.payload, run.warm, run.t, run.s, past=past_from_order(run.q))
    position = Model(arm).position(run.q, None, conditions)
    expected = simulator.position(truth, run)
    # 1e-9 mm: rounding of sums of some 1000 mm; every effect moves the tip by more than 0.01 mm
    np.testing.assert_allclose(position, expected, atol=1e-9)
    assert np.abs(expected - simulator.position(replace(truth, effects=[]), run)).max() > 0.01


def test_a_leaning_axis_seen_in_the_plane() -> None:
    """The chain in space against the effect's first order, whose error is of the size of the fourth power of the lean:
    0.03^4 of 660 mm. The scale that comes with it is one of the lengths beyond the joint."""
    rng, square, beta = np.random.default_rng(3), 9e-4, 0.7
    q, lengths = rng.uniform(-np.pi, np.pi, (20, 4)), np.array([260.0, 180.0, 120.0, 100.0])
    shorter = lengths * np.where(np.arange(4) >= 2, 1.0 - square / 4.0, 1.0)
    factor = square / 4.0 * np.exp(2j * beta)
    arm = Arm(shorter, effects=(EffectSpec("axis_tilt", 3, {"a": factor.real, "b": factor.imag}),))
    zero = np.zeros(4)
    rest = {"masses": zero, "payload": 0.0, "lower": zero, "upper": zero, "sigma": 1.0}
    truth = simulator.TrueArm.planar(lengths, zero, zero, **rest)
    run = simulator.session(truth, q, rng)
    straight = simulator.position(truth, run)
    leaning, mirrored = (
        simulator.position(replace(truth, effects=[("axis_tilt", 3, {"square": sign * square, "beta": beta})]), run)
        for sign in (1.0, -1.0)
    )
    np.testing.assert_allclose(Model(arm).position(q), leaning, atol=660.0 * square**2)
    np.testing.assert_allclose(leaning - straight, straight - mirrored, atol=1e-9)
    assert np.abs(leaning - straight).max() > 0.05


def test_hidden_effect_has_the_size_asked_for() -> None:
    rng = np.random.default_rng(2)
    truth = random_truth(rng, 4)
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (50, 4)), rng)
    names = hidden_effects.LIBRARY_JOINT + hidden_effects.LIBRARY_WHOLE
    effect = hidden_effects.random_effect(names, truth, run, 8.0, rng)
    moved = simulator.position(replace(truth, effects=[effect]), run) - simulator.position(
        replace(truth, effects=[]), run
    )
    # the base errors of the truth turn the effect's column by their size, some 0.01 rad
    size = np.linalg.norm(simulator.off(simulator.base_jacobian(truth, run), moved.ravel())) / truth.sigma
    assert size == pytest.approx(8.0, rel=0.05)


def test_what_simulates_loads_nothing_of_the_model_that_is_judged() -> None:
    """In a fresh interpreter, so that indirect imports count: the arm's description is set up, no model."""
    code = "import sys, doe.studies.blind.cells; print(*sorted(sys.modules))"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    assert "doe.studies.blind.simulator" in loaded
    judged = ("effects", "model", "estimation", "gap", "inspection", "validate", "simulate")
    assert not [name for name in loaded if name.startswith(tuple(f"identification.{module}" for module in judged))]
    ours = {name for name in loaded if name.partition(".")[0] == "doe" and not name.startswith("doe.studies")}
    assert ours <= {"doe"}
