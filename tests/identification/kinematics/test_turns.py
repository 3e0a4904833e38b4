"""Whole turns: angles as a person would move them."""

from __future__ import annotations

import numpy as np
import pytest

from identification.kinematics.counting import turned_into
from identification.kinematics.parameters import PRISMATIC, REVOLUTE


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        (137.0, 137.0),
        (-223.0, 137.0),
        (497.0, 137.0),
        (-580.0, 140.0),  # one turn further
        (175.0, 175.0),  # no turn brings it inside
        (170.0, 170.0),
        (-170.0, -170.0),
    ],
)
def test_into_limits_of_170_degrees(degrees: float, expected: float) -> None:
    lower, upper = np.radians([-170.0]), np.radians([170.0])
    found = turned_into(np.radians([[degrees]]), lower, upper, [REVOLUTE])
    assert np.degrees(found[0, 0]) == pytest.approx(expected, abs=1e-9)


def test_a_sliding_joint_does_not_turn_and_slack_is_inside() -> None:
    lower, upper = np.array([0.0, 0.0]), np.array([3.0, 3.0])
    postures = np.array([[7.0, 7.0], [3.0 + 1e-9, 3.0 + 1e-9]])
    found = turned_into(postures, lower, upper, [PRISMATIC, REVOLUTE], slack=1e-6)
    assert found.tolist() == [[7.0, pytest.approx(7.0 - 2.0 * np.pi)], [3.0 + 1e-9, 3.0 + 1e-9]]
