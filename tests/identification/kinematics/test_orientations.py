"""Orientations against scipy and Rodrigues' formula, and the symbolic rotation vector against both."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.arrays import Array
from identification.kinematics.frames import (
    from_angles,
    from_own_axes,
    from_quaternions,
    mean_rotation,
    rotation_about,
    rotation_vector,
    to_angles,
    turned,
)

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


def test_of_zeros_it_is_zero() -> None:
    np.testing.assert_array_equal(vector(np.zeros((3, 3))), np.zeros(3))


def test_angles_and_quaternions() -> None:
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    matrices = from_angles(angles)
    for row, matrix in zip(angles, matrices, strict=True):
        np.testing.assert_allclose(matrix, from_own_axes(*row), atol=1e-14)
    np.testing.assert_allclose(to_angles(matrices), angles, atol=1e-13)
    half = np.cos(0.35), np.sin(0.35) * np.array([0.36, -0.48, 0.8])
    found = from_quaternions(1.003 * np.r_[half[0], half[1]][None])
    np.testing.assert_allclose(found[0], rotation_about([0.36, -0.48, 0.8], 0.7), atol=1e-14)


def test_mean_and_difference() -> None:
    middle = rotation_about([0.0, 0.6, 0.8], 2.0)
    steps = 0.1 * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    around = middle @ turned(steps)
    np.testing.assert_allclose(mean_rotation(around), middle, atol=1e-14)
