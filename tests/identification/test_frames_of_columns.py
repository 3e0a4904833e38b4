"""Results as frames, against their JSON."""

from __future__ import annotations

import numpy as np
import pytest

from identification import Arm, EffectSpec, Plan


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
