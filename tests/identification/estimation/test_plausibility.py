"""Fits that are no results: links that flip, data in another frame; and postures outside the joint limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.estimation import estimate
from identification.estimation.plausibility import another_frame, copied_rows, outside_limits
from identification.measurements import Measurements
from identification.model import Model
from identification.status import Status
from tests.identification.estimation.cases import LENGTHS, SIGMA, TRUTH, arm, data, plan


def moved(measurements: Measurements, shift: tuple[float, float], turn: float = 0.0) -> Measurements:
    """The same positions in a frame that is shifted [mm] and turned [rad]."""
    turned = measurements.positions @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return replace(measurements, positions=turned + np.array(shift))


def test_a_good_fit_is_not_doubted() -> None:
    found = estimate(Model(arm()), data(Model(arm()), plan(30)))
    assert (found.status, found.doubts) == (Status.converged, ())


def test_data_in_the_frame_of_a_tracker_are_offered_a_base_offset() -> None:
    measured = moved(data(Model(arm()), plan(30)), (2500.0, -800.0), 1.2)
    found = estimate(Model(arm()), measured)
    assert found.status is Status.implausible
    assert found.doubts[0].startswith("implausible: the fit leaves ")
    assert 'add [[effects]] name = "base_offset"' in " ".join(found.doubts)
    assert str(found).startswith("implausible: ")
    assert not str(found).endswith("Converged.")
    taken = estimate(Model(arm(EffectSpec("base_offset"))), measured)
    assert (taken.status, taken.doubts) == (Status.converged, ())
    np.testing.assert_allclose(taken.parameters[8:], [2500.0, -800.0], atol=0.3)
    # any rotation is the offset of joint 1
    assert abs(taken.joint_offsets[0] - (TRUTH[4] + 1.2)) < 0.002


def test_a_small_offset_of_the_base_is_left_to_the_diagnosis() -> None:
    """The RMS must fall to half; an offset of the size of the noise does less."""
    measured = moved(data(Model(arm()), plan(60)), (0.08, 0.08))
    assert another_frame(arm(), measured) == []


def test_chance_is_no_other_frame() -> None:
    """With 4 degrees of freedom left two more parameters often halve the residuals of pure noise."""
    found = [another_frame(arm(), data(Model(arm()), plan(7, seed), seed)) for seed in range(200)]
    assert sum(map(bool, found)) < 10  # 1 % of 200, with Poisson's error


def test_a_link_of_another_length_is_implausible() -> None:
    drawn = Arm((260.0, 180.0, 120.0, 30.0))  # the last link is 100 mm long
    found = estimate(Model(drawn), data(Model(arm()), plan(30)))
    assert found.status is Status.implausible
    assert found.doubts == ("implausible: link 4 of 30 mm comes out 100.7 mm long; another arm, frame or unit?",)
    assert found.to_json()["status"] == "implausible"


def test_postures_outside_the_joint_limits_are_counted() -> None:
    narrow = Arm(LENGTHS, lower=np.radians([-90, -180, -180, -180]), upper=np.radians([90, 180, 180, 180]), sigma=SIGMA)
    q = np.radians(
        [
            [10.0, 190.0, 0.0, 0.0],
            [-90.005, 0.0, 0.0, 0.0],
            [-91.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0],
            [100.0, 0, 0, 0],
        ]
    )
    (sentence,) = outside_limits(narrow, Measurements(q, np.zeros((5, 2))))
    # joint 2 has the limits of an arm file without any
    first = "row 3: joint 1 at -91 deg, allowed -90 to 90"
    assert sentence == f"2 of 5 postures lie outside the joint limits, the first in {first}"
    assert outside_limits(narrow, Measurements(q[:2], np.zeros((2, 2)))) == []


def test_rows_that_are_copied_are_said_and_repeats_are_not() -> None:
    measured = data(Model(arm()), plan(10))
    assert copied_rows(measured) == []
    (sentence,) = copied_rows(measured.rows([*range(10), 3, 7]))
    assert sentence.startswith("2 of 12 rows are exact copies of others, the first row 11 of row 4: ")
    again = replace(measured, positions=measured.positions + 0.01)
    repeats = np.concatenate([measured.positions, again.positions])
    assert copied_rows(Measurements(np.tile(measured.postures, (2, 1)), repeats)) == []
