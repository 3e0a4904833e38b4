"""Shifts of the base along its own axes: against complex numbers and rotations written out."""

from __future__ import annotations

import numpy as np
import pytest

from identification.kinematics.base_axes import along, planar_axes


def test_a_planar_shift_turns_with_the_base() -> None:
    found = along(planar_axes(0.3), {"base_offset.x0": 2.0, "joint_offset:1": 0.1})
    turned = 2.0 * np.exp(0.3j)
    assert {name: float(x) for name, x in found.items()} == {
        "base_offset.x0": pytest.approx(turned.real),
        "base_offset.y0": pytest.approx(turned.imag),
    }


def test_a_shift_in_space_turns_by_the_axes_given() -> None:
    axes = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found = along(axes, {"base.x": 1.0, "base.z": 3.0, "base.rx": 0.5})
    assert {name: float(x) for name, x in found.items()} == {"base.x": 0.0, "base.y": 1.0, "base.z": 3.0}


def test_nothing_turns_where_there_is_no_shift() -> None:
    assert along(planar_axes(0.3), {"joint_offset:1": 0.1}) == {}
