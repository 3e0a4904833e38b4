"""Rotations and orientations against SciPy's."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from identification import Array
from identification.kinematics.frames import (
    from_angles,
    from_quaternions,
    from_roll_pitch_yaw,
    roll_pitch_yaw,
    rotation_about,
    rotation_vector,
    to_angles,
)

angles = st.floats(-np.pi, np.pi)


near_lock = st.sampled_from([np.pi / 2.0, -np.pi / 2.0]) | st.floats(1e-16, 1e-3).map(lambda gap: np.pi / 2.0 - gap)


@given(angles, angles | near_lock, angles)
def test_angles_make_their_rotation_to_the_last_digits(roll: float, pitch: float, yaw: float) -> None:
    """Roll and yaw that are each uncertain near gimbal lock belong together."""
    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()  # lower case: about fixed axes
    np.testing.assert_allclose(from_roll_pitch_yaw(roll, pitch, yaw), rotation, atol=1e-12)
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


SYMBOL = ca.SX.sym("r", 3, 3)
VECTOR = rotation_vector(SYMBOL)
FUNCTION = ca.Function("vector", [SYMBOL], [VECTOR, ca.jacobian(VECTOR, ca.vec(SYMBOL))])


def vector(matrix: Array) -> Array:
    return FUNCTION(matrix)[0].full()[:, 0]


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.06, 0.0633, 1.0, 3.1])
def test_rotation_vector(angle: float) -> None:
    """Below and above the limit of the series, 2 atan(sqrt(1e-3)) = 0.0632."""
    axis = np.array([0.36, -0.48, 0.8])
    np.testing.assert_allclose(vector(rotation_about(axis, angle)), angle * axis, atol=1e-12)


def test_its_derivative() -> None:
    """By a small rotation from the left, against differences of scipy's logarithm."""
    for angle in (0.0, 0.01, 0.5):
        start = Rotation.from_rotvec(angle * np.array([0.36, -0.48, 0.8]))
        jacobian = FUNCTION(start.as_matrix())[1].full()
        for k, axis in enumerate(np.eye(3)):
            step = Rotation.from_rotvec(1e-6 * axis)
            ends = [(turn * start).as_rotvec() for turn in (step, step.inv())]
            across = np.cross(np.eye(3)[k], start.as_matrix(), axisb=0, axisc=0)  # derivative of the matrix
            found = jacobian @ across.ravel(order="F")
            np.testing.assert_allclose(found, (ends[0] - ends[1]) / 2e-6, atol=1e-8)


def test_angles_and_quaternions() -> None:
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    matrices = from_angles(angles)
    for row, matrix in zip(angles, matrices, strict=True):
        np.testing.assert_allclose(matrix, from_angles(row), atol=1e-14)
    np.testing.assert_allclose(to_angles(matrices), angles, atol=1e-13)
    half = np.cos(0.35), np.sin(0.35) * np.array([0.36, -0.48, 0.8])
    found = from_quaternions(1.003 * np.r_[half[0], half[1]][None])
    np.testing.assert_allclose(found[0], rotation_about([0.36, -0.48, 0.8], 0.7), atol=1e-14)
