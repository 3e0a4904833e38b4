"""Rotations against SciPy's, symbolic frames against products of matrices."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from identification.kinematics.frames import Frame, from_roll_pitch_yaw, pose, roll_pitch_yaw, rotation_about

angles = st.floats(-np.pi, np.pi)


@given(angles, angles, angles)
def test_roll_pitch_yaw_are_about_fixed_axes(roll: float, pitch: float, yaw: float) -> None:
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()  # lower case: extrinsic
    np.testing.assert_allclose(from_roll_pitch_yaw(roll, pitch, yaw), expected, atol=1e-12)
    np.testing.assert_allclose(from_roll_pitch_yaw(*roll_pitch_yaw(expected)), expected, atol=1e-9)


@pytest.mark.parametrize("pitch", [np.pi / 2.0, -np.pi / 2.0])
@pytest.mark.parametrize("roll", [0.3, -2.0])
def test_where_only_a_sum_of_angles_counts(pitch: float, roll: float) -> None:
    rotation = from_roll_pitch_yaw(roll, pitch, 0.8)
    found = roll_pitch_yaw(rotation)
    assert found[2] == 0.0
    np.testing.assert_allclose(from_roll_pitch_yaw(*found), rotation, atol=1e-9)


near_lock = st.sampled_from([np.pi / 2.0, -np.pi / 2.0]) | st.floats(1e-16, 1e-3).map(lambda gap: np.pi / 2.0 - gap)


@given(angles, angles | near_lock, angles)
def test_angles_make_their_rotation_to_the_last_digits(roll: float, pitch: float, yaw: float) -> None:
    """Roll and yaw that are each uncertain near gimbal lock belong together."""
    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    for near in (None, (roll, pitch, yaw), (1.0, -2.0, 3.0)):
        made = Rotation.from_euler("xyz", roll_pitch_yaw(rotation, near)).as_matrix()
        np.testing.assert_allclose(made, rotation, rtol=0.0, atol=3e-12)


@given(angles, angles | st.sampled_from([np.pi / 2.0, -np.pi / 2.0]), angles, st.tuples(*[st.floats(-1e-3, 1e-3)] * 3))
def test_of_the_equal_angles_the_nearest(
    roll: float, pitch: float, yaw: float, off: tuple[float, float, float]
) -> None:
    """Angles that were near are found again: also beyond 90 deg of pitch and, in gimbal lock, of a whole line of equal
    ones, from which the nearest is at most as far as those that the rotation was made of."""
    asked = np.array([roll, pitch, yaw])
    found = roll_pitch_yaw(from_roll_pitch_yaw(*asked), asked + off)
    assert np.linalg.norm(found - asked - off) <= np.linalg.norm(off) + 1e-6


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1), angles)
def test_rotation_about_an_axis(axis: tuple[float, float, float], angle: float) -> None:
    unit = np.array(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(rotation_about(unit, angle), Rotation.from_rotvec(angle * unit).as_matrix(), atol=1e-12)


def test_symbolic_frames_are_products_of_matrices() -> None:
    x = ca.SX.sym("x", 2)
    inner = pose((1.0, -2.0, 3.0), from_roll_pitch_yaw(0.1, 0.2, 0.3))
    frame = Frame.world().placed(inner).moved(1, x[0]).turned(2, x[1])
    point = frame.point(ca.SX([5.0, 6.0, 7.0]))
    found = ca.Function("point", [x], [point])([4.0, 0.5]).full().ravel()
    expected = inner @ pose((0.0, 4.0, 0.0)) @ pose(rotation=rotation_about((0.0, 0.0, 1.0), 0.5))
    np.testing.assert_allclose(found, (expected @ [5.0, 6.0, 7.0, 1.0])[:3], atol=1e-12)
