"""Whether an arm sags: simulated small arms with and without compliance, and two sessions of a real one."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from identification import Arm, Measurements, Model, estimate, load_arm, load_measurements
from identification.inspection.inspection import sag
from tests.small_arm import COMPLIANCE, MASSES, OTHERS, drawn_arm, measured, random_postures, small_arm

DATA = Path(__file__).parents[2] / "data"


def looked_at(arm: Arm, data: Measurements, masses: np.ndarray | None = None) -> dict[str, Any]:
    found, sentence = sag(arm, data, estimate(Model(arm), data), None if masses is None else masses.tolist())
    assert found is not None
    assert bool(sentence) is found["recommended"]
    return found


@pytest.mark.parametrize("compliant", [True, False])
def test_equal_masses_show_what_the_real_ones_show(compliant: bool) -> None:
    """Errors of the fit: 0.6 kg on the flange that no file names, encoders off centre, 0.03 mm of each posture."""
    rng, arm = np.random.default_rng(5), drawn_arm(gravity=False)
    truth = small_arm(rng, *OTHERS, compliance=COMPLIANCE * compliant)
    data = measured(truth, random_postures(40, rng), rng)
    equal, real = looked_at(arm, data), looked_at(arm, data, MASSES)
    assert (equal["masses_from"], real["masses_from"]) == ("unit", "urdf")
    assert equal["recommended"] is real["recommended"] is compliant
    if compliant:
        assert real["rms_after_mm"] < 0.5 * real["rms_before_mm"]
        assert equal["rms_after_mm"] < 1.1 * real["rms_after_mm"]
        assert equal["max_after_mm"] < 0.6 * equal["max_before_mm"]
    assert equal["rms_before_mm"] == pytest.approx(real["rms_before_mm"])
    told = tomllib.loads("\n".join(real["lines"]))["gravity"]
    assert told == {"acceleration_m_s2": [0.0, 0.0, -9.81], "link_masses_kg": MASSES.tolist()}


@pytest.mark.parametrize(("session", "gain", "recommended"), [("A", 0.04, True), ("C", 0.013, False)])
def test_two_sessions_of_a_real_arm(session: str, gain: float, recommended: bool) -> None:
    """A heavy arm of stiff joints: what they give way by shows in one session beyond doubt, in the other not."""
    arm = load_arm(DATA / "ur10/ur10.toml")
    with pytest.warns(UserWarning, match="columns are not used"):
        data = load_measurements(DATA / f"ur10/series_{session}.csv", arm)
    found = looked_at(arm, data)
    assert 1.0 - found["rms_after_mm"] / found["rms_before_mm"] == pytest.approx(gain, abs=0.01)
    assert found["recommended"] is recommended


def test_in_the_plane_gravity_points_down_the_last_axis() -> None:
    arm = Arm([612.0, 572.3, 115.7])
    data = load_measurements(DATA / "ur10_planar/measurements.csv", arm)
    found = looked_at(arm, data)
    assert found["lines"][1] == "acceleration_m_s2 = [0.0, -9.81]"
    assert not found["recommended"]  # 0.3 % less


def test_an_arm_with_gravity_is_asked_nothing() -> None:
    rng, arm = np.random.default_rng(1), drawn_arm()
    data = measured(small_arm(rng), random_postures(30, rng), rng)
    assert sag(arm, data, estimate(Model(arm), data)) == (None, "")
