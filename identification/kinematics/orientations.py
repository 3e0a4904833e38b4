"""Measured orientations: rotation matrices from what files say, and how far one orientation is from another.

The difference of two orientations is a rotation vector: the axis of the rotation from one to the other, as long as its
angle [rad]. A fit counts it in millimetres, `SpatialChain.angle_scale` [mm/rad] for each radian.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.kinematics.frames import own_axes_angles

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SERIES = 1e-3  # squared tangent of half an angle below which five terms of the arc tangent's series are exact: 1e-3^5


def from_angles(angles: Array) -> Array:
    """(m, 3, 3) rotation matrices of angles (m, 3) [rad] about own axes, x, then y, then z."""
    return np.asarray(_scipy().from_euler("XYZ", angles).as_matrix())


def to_angles(rotations: Array) -> Array:
    """(m, 3) angles [rad] of which `from_angles` makes these rotations (m, 3, 3)."""
    return np.array([own_axes_angles(rotation) for rotation in rotations])


def from_quaternions(quaternions: Array) -> Array:
    """(m, 3, 3) rotation matrices of quaternions (m, 4), the real part first, of any length."""
    return np.asarray(_scipy().from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix())


def turned(vectors: Array) -> Array:
    """(m, 3, 3) rotation matrices of rotation vectors (m, 3) [rad]."""
    return np.asarray(_scipy().from_rotvec(vectors).as_matrix())


def mean_rotation(rotations: Array) -> Array:
    """(3, 3) rotation with the smallest sum of squared differences of matrix entries from rotations (m, 3, 3)."""
    left, _, right = np.linalg.svd(rotations.mean(axis=0))
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)


def rotation_vector(rotation: ca.SX) -> ca.SX:
    """(3,) rotation vector [rad] of a rotation matrix (3, 3) in CasADi, smooth where it is none; of a matrix of zeros
    zero."""
    across = ca.vertcat(
        rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    )
    half = across / ca.fmax(1.0 + ca.trace(rotation), 1e-30)  # the axis times the tangent of half the angle
    squared = ca.dot(half, half)
    root = ca.sqrt(ca.fmax(squared, SERIES))
    series = 1.0 - squared * (1.0 / 3.0 - squared * (1.0 / 5.0 - squared * (1.0 / 7.0 - squared / 9.0)))
    return 2.0 * half * ca.if_else(squared < SERIES, series, ca.atan(root) / root)


def _scipy() -> type[Rotation]:
    """SciPy's rotations: to load them takes as long as to load all that a planar arm needs."""
    from scipy.spatial.transform import Rotation

    return Rotation
