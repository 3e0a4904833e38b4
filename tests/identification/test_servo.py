"""Commands beside readings: what is measured of them, kept in arm files, and taken off commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Calibration, EffectSpec, Model, estimate, load_arm, with_effects
from identification.compensate import compensate
from identification.files.measurement import measurement_text
from identification.measurements import Measurements, load_measurements
from identification.simulate import servo_shift, simulate, with_servo_errors

ARM = Arm([300.0, 250.0], sigma=0.05)
SLACK = {1: (2e-4, 5e-5), 2: (-3e-4, 8e-5)}
SPECS = tuple(EffectSpec("servo_error", j, {"b": b, "h": h}) for j, (b, h) in SLACK.items())
TRUTH = replace(ARM, effects=SPECS, calibration=Calibration.of([0.4, -0.3], [0.002, -0.001]))


def data(rows: int = 40) -> Measurements:
    postures = np.random.default_rng(1).uniform(-2.0, 2.0, (rows, 2))
    return simulate(TRUTH, postures, np.random.default_rng(2))


def test_what_a_controller_leaves() -> None:
    """The two numbers of each joint come back; positions are those of the joints as read."""
    found = data()
    known, entries = with_servo_errors(ARM, found)
    assert [spec.joint for spec in known.effects] == [1, 2]
    for spec, entry in zip(known.effects, entries, strict=True):
        b, h = SLACK[entry["joint"]]
        assert (spec.values["b"], spec.values["h"]) == pytest.approx((b, h), abs=1e-12)
        assert (entry["offset"], entry["reversal"]) == pytest.approx(np.degrees([b, h]), abs=1e-10)
        assert entry["rest"] < 1e-10
        assert entry["largest"] == pytest.approx(np.degrees(abs(b) + h))
        left = (found.postures - found.commanded)[:, entry["joint"] - 1]
        assert entry["rms"] == pytest.approx(np.degrees(np.sqrt(np.mean(left**2))))
    exact = Model(replace(TRUTH, effects=())).position(found.postures)
    assert np.std(found.positions - exact) == pytest.approx(0.05, rel=0.2)


def test_fits_do_not_care() -> None:
    """A model of what is read is the same with servo errors in the arm and without."""
    found = data()
    with_them = estimate(Model(with_servo_errors(ARM, found)[0]), found)
    np.testing.assert_array_equal(with_them.parameters, estimate(Model(ARM), found).parameters)


def test_commands_are_asked_for_so_that_the_joints_are_read_right() -> None:
    """The true arm, asked for them, is at the targets; else up to 3.5e-4 rad x 250 mm beside them."""
    nominal = np.random.default_rng(3).uniform(-1.5, 1.5, (30, 2))
    targets = Model(ARM).position(nominal)
    for arm, off in ((TRUTH, 0.0), (replace(TRUTH, effects=()), 0.07)):
        commands = compensate(arm, targets, nominal).commands
        there = simulate(TRUTH, commands, np.random.default_rng(4), sigma=0.0)
        missed = np.linalg.norm(there.positions - targets, axis=1)
        assert missed.max() < 2e-6 if off == 0.0 else missed.max() > off


def test_files(tmp_path: Path) -> None:
    """Commands in measurement files, all joints or none, and servo errors in arm files."""
    found, path = data(5), tmp_path / "data.csv"
    path.write_text(measurement_text(found))
    assert "commanded1_deg,commanded2_deg" in path.read_text()
    read = load_measurements(path, 2)
    np.testing.assert_allclose(read.commanded, found.commanded, atol=1e-13)
    text = "links_mm = [300.0, 250.0]\n"
    (tmp_path / "arm.toml").write_text(with_effects(text, SPECS))
    shift = servo_shift(load_arm(tmp_path / "arm.toml"), np.ones((1, 2)))
    np.testing.assert_allclose(shift, servo_shift(TRUTH, np.ones((1, 2))), atol=1e-15)
    path.write_text("q1_deg,q2_deg,commanded1_deg,x_mm,y_mm\n1,2,1,3,4\n")
    with pytest.raises(Exception, match="column 'commanded2_deg' is missing"):
        load_measurements(path, 2)
