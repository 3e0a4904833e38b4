"""Which values of a setting are tried, and which an arm file may say."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm
from identification.effects import Scope, Setting
from identification.effects.base import clock, step_times
from identification.measurements import Conditions

SCOPE = Scope(Arm([300.0, 200.0]), 2, np.zeros((3, 2)), Conditions(time=np.array([-0.5, 0.1234567, 0.5])))


def test_a_pair_is_every_whole_number() -> None:
    pair = Setting.of((3, 6))
    assert pair.scan(SCOPE) == [3.0, 4.0, 5.0, 6.0]
    assert (pair.allows(4.0), pair.allows(4.5), pair.allows(7.0)) == (True, False, False)
    assert pair.allowed == "a whole number 3 to 6"
    assert Setting.of(pair) is pair


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.3, 0.1, 0.3, 9.0), [0.1, 0.3]),  # in order, each once, none that is not allowed
        (lambda scope: scope.conditions.time, [-0.5, 0.123457, 0.5]),  # as labels and files hold them
        (lambda scope: scope.arm.lengths / 1000.0 + scope.joint / 10.0, [0.4, 0.5]),
    ],
)
def test_values_are_listed_or_computed(values: object, expected: list[float]) -> None:
    assert Setting(-0.5, 0.5, values).scan(SCOPE) == expected  # type: ignore[arg-type]


def test_steps_are_tried_between_rows_and_between_sessions() -> None:
    time = np.linspace(-0.5, 0.5, 9)
    one = step_times(Scope(SCOPE.arm, 1, np.zeros((9, 2)), Conditions(time=time)))
    np.testing.assert_allclose(one, time[1:-2] + 0.0625)  # between rows, but for the first and the last
    two = Conditions(time=np.tile(time, 2), session=np.repeat([0.0, 1.0], 9))
    found = step_times(Scope(SCOPE.arm, 1, np.zeros((18, 2)), two))
    assert any(at == pytest.approx(0.55) for at in found)
    assert max(found) == pytest.approx(1.1 + 0.5 - 0.1875)
    assert clock(0.5, 0) < 0.55 < clock(-0.5, 1)


def test_many_rows_have_fewer_steps() -> None:
    many = Conditions(time=np.linspace(-0.5, 0.5, 1000))
    found = step_times(Scope(SCOPE.arm, 1, np.zeros((1000, 2)), many))
    assert len(found) == 40
    assert step_times(SCOPE) == pytest.approx([-0.18827165, 0.31172835])
    assert all(-0.5 < at < 0.5 for at in step_times(Scope(SCOPE.arm)))
