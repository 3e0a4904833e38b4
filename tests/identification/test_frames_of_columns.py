"""Results as frames, against their JSON."""

from __future__ import annotations

import numpy as np
import pytest

from identification import Plan
from identification.arm import Arm, Calibration, EffectSpec
from identification.compensate import compensate
from identification.estimation import estimate
from identification.model import Model
from tests.identification.estimation.cases import arm, data, plan


def test_an_identification() -> None:
    found = estimate(Model(arm()), data(Model(arm()), plan(20)))
    frame = found.to_frame()
    assert frame.to_dicts() == found.to_json()["corrected_values"]
    assert frame["name"][0] == "length of link 1"


def test_commands() -> None:
    two = Arm([300.0, 200.0], calibration=Calibration.of([1.0, -2.0], [0.01, -0.02]))
    found = compensate(two, [[300.0, 100.0], [900.0, 0.0]])
    frame = found.to_frame()
    assert frame.columns == ["q1", "q2", "x_mm", "y_mm", "error_mm", "reachable", "message"]
    assert frame["reachable"].to_list() == [True, False]
    np.testing.assert_array_equal(frame.select("q1", "q2").to_numpy(), np.degrees(found.commands))


def test_a_plan_and_an_arm_in_a_notebook() -> None:
    found = Plan(np.radians([[10.0, 20.0], [30.0, 40.0]]), np.array([0.5, 0.5]))
    assert found.to_frame().rows() == [
        (1, *map(pytest.approx, (10.0, 20.0, 0.5))),
        (2, *map(pytest.approx, (30.0, 40.0, 0.5))),
    ]
    assert "q2_deg" in found._repr_html_()
    shown = Arm([260.0, 180.0], name="a<b", sigma=0.1, effects=(EffectSpec("backlash", 2),))._repr_html_()
    assert "a&lt;b" in shown
    assert "backlash:2" in shown
    assert shown.count("<tr>") == 3
    assert "-180 deg" in shown
