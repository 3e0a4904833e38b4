"""The two implementations of the effects agree: plain numpy from identification/README.md, "Effects", and CasADi."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from doe.studies.blind import hidden_effects, simulator
from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.measurements import Conditions
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
    "link_bending": ({"f": 3e-5}, {"flexibility": 3e-5}),
    "thermal_growth": ({"a": 2e-4},) * 2,
    "base_offset": ({"x": 1.0, "y": -2.0}, {"x0": 1.0, "y0": -2.0}),
    "base_drift": ({"x": 1.0, "y": -2.0}, {"vx": 1.0, "vy": -2.0}),
    "base_rotation_drift": ({"w": 2e-3},) * 2,
    "axes_skew": ({"a": 1e-3, "b": -2e-3},) * 2,
}


@pytest.mark.parametrize("name", VALUES)
def test_two_implementations_agree(name: str) -> None:
    rng = np.random.default_rng(1)
    truth = simulator.random_truth(rng, 3)
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (40, 3)), rng)
    joint = None if name in hidden_effects.LIBRARY_WHOLE else 2
    theirs, ours = VALUES[name]
    truth = replace(truth, effects=[(name.rstrip("*"), joint, theirs)])
    arm = Arm(
        truth.lengths,
        gravity=Gravity(np.array([0.0, -simulator.G]), truth.masses, truth.center, truth.payload),
        effects=(EffectSpec(name.rstrip("*"), joint, ours),),
        calibration=Calibration.of(truth.length_errors, truth.joint_offsets),
    )
    position = Model(arm).position(run.q, None, Conditions(run.payload, run.warm, run.t, run.s))
    expected = simulator.position(truth, run)
    # 1e-9 mm: rounding of sums of some 1000 mm; every effect moves the tip by more than 0.01 mm
    np.testing.assert_allclose(position @ [1.0, 1.0j], expected, atol=1e-9)
    assert np.abs(expected - simulator.position(replace(truth, effects=[]), run)).max() > 0.01


def test_hidden_effect_has_the_size_asked_for() -> None:
    rng = np.random.default_rng(2)
    truth = simulator.random_truth(rng, 4)
    run = simulator.session(truth, rng.uniform(-np.pi, np.pi, (50, 4)), rng)
    effect = hidden_effects.random_effect(truth, run, 8.0, rng)
    moved = simulator.position(replace(truth, effects=[effect]), run) - simulator.position(
        replace(truth, effects=[]), run
    )
    stacked = np.column_stack([moved.real, moved.imag]).ravel()
    # the base errors of the truth turn the effect's column by their size, some 0.01 rad
    size = np.linalg.norm(hidden_effects.off(hidden_effects.base_jacobian(truth, run), stacked)) / truth.sigma
    assert size == pytest.approx(8.0, rel=0.05)


def test_what_simulates_loads_nothing_of_the_model_that_is_judged() -> None:
    """In a fresh interpreter, so that deferred and indirect imports count: numpy and plain data only."""
    code = "import sys, doe.studies.blind.cells; print(*sorted(sys.modules))"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    assert "doe.studies.blind.simulator" in loaded
    assert "casadi" not in loaded  # no CasADi, no model
    plain = {"identification", "identification.arm", "identification.conditions", "identification.measurements"}
    plain |= {"identification.arrays", "identification.errors"}
    plain |= {"identification.kinematics", "identification.kinematics.parameters"}  # names and units
    assert {name for name in loaded if name.partition(".")[0] == "identification"} <= plain
    ours = {name for name in loaded if name.partition(".")[0] == "doe" and not name.startswith("doe.studies")}
    assert ours <= {"doe"}
