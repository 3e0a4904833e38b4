"""Which values of a setting are tried, and which an arm file may say."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm
from identification.effects import Scope, Setting
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
