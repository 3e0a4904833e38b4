"""A pan-tilt unit: two joints reach a surface, and no measured position lies on it exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from identification.arm import Arm
from identification.arrays import Array
from identification.compensate import compensate
from identification.compensate.inverse_kinematics import TOLERANCE
from identification.estimation import estimate
from identification.kinematics.denavit_hartenberg import DHRow, chain_of
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.kinematics.test_spatial import tip_by_exponentials

NOISE = 0.05  # [mm] of each coordinate
REFLECTOR = np.array([50.0, 20.0, 30.0])
CHAIN = chain_of([DHRow(80.0, np.radians(90.0), 300.0), DHRow(400.0, 0.0, 0.0)])
ERRORS = {"translation_x:2": 0.4, "translation_z:2": -0.3, "rotation_x:2": 6e-4}


def session(rows: int, seed: int, width: float = 1.2) -> tuple[Array, Array]:
    generator = np.random.default_rng(seed)
    q = generator.uniform(-width, width, (rows, 2))
    tips = np.array([tip_by_exponentials(CHAIN, row, ERRORS, REFLECTOR) for row in q])
    return q, tips + NOISE * generator.standard_normal(tips.shape)


def calibrated() -> tuple[Arm, float]:
    """The arm, and the RMS distance [mm] that its calibration expects of a right position: noise and its own error."""
    arm = Arm(replace(CHAIN, tools={"1": REFLECTOR}, known=frozenset()), sigma=NOISE)
    found = estimate(Model(arm), Measurements(*session(40, 0)))
    assert found.expected_tip is not None
    return replace(found.model.arm, calibration=found.calibration()), float(
        np.hypot(found.rms_after, found.expected_tip)
    )


def test_measured_positions_are_reached() -> None:
    arm, rms = calibrated()
    q, positions = session(30, 1)
    found = compensate(arm, positions)
    assert found.tolerance == pytest.approx(rms * np.sqrt(chi2.isf(1e-3, 3) / 3.0), rel=1e-9)
    assert found.errors.min() > TOLERANCE
    assert found.reached.all()
    # where they were measured: noise across 200 mm of lever, the shortest in these postures, and the calibration's own
    np.testing.assert_allclose(found.commands, q, rtol=0, atol=5.0 * rms / 200.0)
    assert found.to_json()["tolerance_mm"] == found.tolerance
    (said,) = (warning for warning in found.warnings if "missed by" in warning)
    assert said.startswith(f"30 of the targets reached are missed by {found.errors.max():.2g} mm at most")


def test_targets_off_the_surface_are_not() -> None:
    """Moved along the arm by ten times the tolerance, those in between are told apart by the distance alone."""
    arm, _ = calibrated()
    _, positions = session(6, 2)
    axis = positions - positions.mean(axis=0)
    tolerance = compensate(arm, positions).tolerance
    far = compensate(arm, positions + 10.0 * tolerance * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    assert not far.reached[far.errors > tolerance].any()
    assert far.reached[far.errors <= tolerance].all()
    assert (far.errors > tolerance).any()


def test_a_nominal_posture_is_not_left_for_what_nobody_can_tell() -> None:
    """From the posture that was measured: no other branch of the arm is taken because it is nearer by some microns."""
    arm, rms = calibrated()
    q, positions = session(30, 3)
    found = compensate(arm, positions, postures=q)
    assert found.reached.all()
    np.testing.assert_allclose(found.commands, q, rtol=0, atol=5.0 * rms / 200.0)


def test_an_arm_that_can_reaches_exactly() -> None:
    """In a plane two joints reach what is in reach, and the tolerance makes nothing worse."""
    arm = Arm(np.array([300.0, 200.0]), sigma=0.1)
    generator = np.random.default_rng(4)
    q = generator.uniform(-2.0, 2.0, (40, 2))
    tips = Model(arm).position(q) + 0.1 * generator.standard_normal((40, 2))
    fitted = estimate(Model(arm), Measurements(q, tips))
    found = compensate(replace(arm, calibration=fitted.calibration()), tips[np.linalg.norm(tips, axis=1) < 480.0])
    assert found.tolerance > 0.1
    assert found.errors.max() <= TOLERANCE
    assert not found.warnings or not any("missed by" in warning for warning in found.warnings)
