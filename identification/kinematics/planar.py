"""Forward kinematics of a planar chain of revolute joints: the points of base, joints and tip.

Link j points along theta_j = q_1 + ... + q_j and ends at sum_{k <= j} l_k (cos theta_k, sin theta_k)   (paper, eq. 1).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet

DIMENSION = 2  # coordinates of a point


def orientation_transform(parameters: ParameterSet) -> Array:
    """(n, p) matrix T with dtheta = T parameters: dtheta_j = dq_1 + ... + dq_j of the joint offsets among them.

    The paper's sigma_q (eq. 25) is the standard deviation of dtheta_j, not of the joint offset dq_j.
    """
    offsets = parameters.indices(JOINT_OFFSET)
    transform = np.zeros((len(offsets), len(parameters)))
    transform[:, offsets] = np.tri(len(offsets))
    return transform


def joint_points(lengths: Array, postures: Array) -> Array:
    """(..., n + 1, 2) base, joints and tip, in the unit of the lengths (n,), at postures (..., n) [rad]."""
    theta = np.cumsum(postures, axis=-1)
    steps = np.asarray(lengths)[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    return np.concatenate([np.zeros((*theta.shape[:-1], 1, DIMENSION)), np.cumsum(steps, axis=-2)], axis=-2)


def symbolic_points(lengths: ca.SX | Array, q: ca.SX) -> list[ca.SX]:
    """n + 1 points (2,): base, joints and tip, in the unit of the lengths (n,), at a posture (n,) [rad]."""
    straight = ca.SX.zeros(q.numel())
    return symbolic_chain(ca.SX(lengths), q, straight, straight)[0]


def symbolic_chain(lengths: ca.SX, q: ca.SX, deflections: ca.SX, slopes: ca.SX) -> tuple[list[ca.SX], ca.SX]:
    """n + 1 points (2,) of a chain whose links bend, and the orientation [rad] at the end of the last link.

    deflections : (n,) of each link's end to its left, in the unit of the lengths;  slopes : (n,) there [rad]
    """
    points, theta = [ca.SX.zeros(DIMENSION)], ca.SX(0)
    for j in range(q.numel()):
        theta += q[j]
        points.append(points[-1] + rotate(theta, ca.vertcat(lengths[j], deflections[j])))
        theta += slopes[j]
    return points, theta


def rotate(angle: ca.SX | float, vector: ca.SX) -> ca.SX:
    """(2,) vector turned by an angle [rad]."""
    cosine, sine = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1])
