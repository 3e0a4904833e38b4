"""Postures at targets from nominal ones, and without: turns, the middle of the angles, limits far away."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm, Calibration
from identification.compensate import compensate
from identification.model import Model


def test_a_posture_a_turn_beyond_the_limits_is_the_same_posture() -> None:
    limits, exact = np.radians([170.0, 170.0]), Calibration.of(np.zeros(2), np.zeros(2))
    arm = Arm([300.0, 200.0], lower=-limits, upper=limits, calibration=exact)
    model = Model(arm)
    wanted, read = np.radians([[137.0, -60.0]]), np.radians([[-223.0, 300.0]])
    goals = model.position(wanted, np.zeros(4))
    found = compensate(arm, goals, read)
    assert found.commands == pytest.approx(wanted, abs=1e-6)


def test_of_the_postures_of_a_redundant_arm_one_near_the_middle_is_taken() -> None:
    """Three links reach a target in one posture for each direction of the last one and each elbow: all of them."""
    lengths = np.array([300.0, 200.0, 150.0])
    arm = Arm(
        lengths, lower=(-1.0, -2.0, -2.0), upper=(2.0, 1.0, 2.5), calibration=Calibration.of(np.zeros(3), np.zeros(3))
    )
    middle = (arm.lower + arm.upper) / 2.0
    shape = np.random.default_rng(3).uniform(arm.lower, arm.upper, (40, 3))
    found = compensate(arm, Model(arm).position(shape))
    assert found.reached.all()
    last = np.linspace(-np.pi, np.pi, 4001)
    for target, nominal in zip(found.targets, found.nominal, strict=True):
        wrist = complex(*target) - lengths[2] * np.exp(1j * last)
        cosine = (np.abs(wrist) ** 2 - lengths[:2] @ lengths[:2]) / (2.0 * lengths[0] * lengths[1])
        every = []
        for elbow in (np.arccos(np.clip(cosine, -1.0, 1.0)), -np.arccos(np.clip(cosine, -1.0, 1.0))):
            first = np.angle(wrist / (lengths[0] + lengths[1] * np.exp(1j * elbow)))
            every.append(np.column_stack([first, elbow, np.angle(np.exp(1j * (last - first - elbow)))]))
        q = np.concatenate(every)[np.tile(np.abs(cosine) <= 1.0, 2)]
        q = q[np.all((arm.lower <= q) & (q <= arm.upper), axis=1)]
        nearest = np.linalg.norm(q - middle, axis=1).min()
        assert np.linalg.norm(nominal - middle) < nearest + 0.25


def test_nominal_postures_thousands_of_turns_away() -> None:
    """A redundant arm without constraints, asked for the nearest posture to one that its limits forbid by far."""
    limits, none = np.full(3, 1.7), np.zeros(3)
    arm = Arm([300.0, 240.0, 192.0], lower=-limits, upper=limits, calibration=Calibration.of(none, none))
    nominal = np.random.default_rng(5).uniform(-1e6, 1e6, (6, 3))
    found = compensate(arm, Model(arm).position(np.random.default_rng(6).uniform(-1.7, 1.7, (6, 3))), nominal)
    assert found.reached.all()
    assert np.all(np.abs(found.commands) <= 1.7)
