"""Forward kinematics of a planar chain of revolute joints: the points of base, joints and tip.

Link j points along theta_j = q_1 + ... + q_j and ends at sum_{k <= j} l_k (cos theta_k, sin theta_k)   (paper, eq. 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from identification.arrays import Array, ByValue
from identification.instruments import TRACKER
from identification.kinematics.parameters import JOINT_OFFSET, REVOLUTE, ParameterSet, chain_parameters

DIMENSION = 2  # coordinates of a point


@dataclass(frozen=True, eq=False)
class PlanarGeometry(ByValue):
    """Links of nominal lengths (n,) [mm] behind revolute joints, with length errors and joint offsets."""

    lengths: Array
    dimension = DIMENSION
    instrument = TRACKER  # planar arms are measured by positions

    @property
    def joint_types(self) -> tuple[str, ...]:
        """(n) `revolute`, every one."""
        return (REVOLUTE,) * len(self.lengths)

    def parameters(self, best: Mapping[str, float]) -> ParameterSet:
        """(2 n) length errors and joint offsets, scaled by the best known lengths, as far as anything is left."""
        nominal = chain_parameters(self.lengths)
        lengths = self.lengths + nominal.vector(best)[: len(self.lengths)]
        return chain_parameters(np.where(lengths == 0.0, self.lengths, np.abs(lengths)))

    def link_lengths(self, values: ca.SX) -> ca.SX:
        """(n,) lengths [mm] at values (2 n) of the parameters."""
        return ca.SX(ca.DM(self.lengths)) + values[: len(self.lengths)]

    def tip(
        self, q: ca.SX, values: ca.SX, added: Mapping[str, ca.SX], *of_spatial_arms: ca.SX | None
    ) -> tuple[ca.SX, ca.SX]:
        """(2,) measured point [mm] at real joint angles (n,) but for their offsets, before the instrument, and (0,).

        added : what effects add at each place of the chain (identification/effects/places.py)
        """
        lengths, offsets = self.link_lengths(values) + added["extensions"], values[len(self.lengths) :]
        points, theta = symbolic_chain(lengths, q + offsets, added["deflections"], added["slopes"])
        tip = points[-1] + rotate(theta, added["tool"])
        return rotate(added["base_rotation"], tip) + added["base_translation"], ca.SX(0, 1)

    def symbolic_points(self, q: ca.SX, values: Array) -> list[ca.SX]:
        """n + 1 points (2,) of base, joints and tip [mm] at a posture (n,) and values (2 n) of the parameters."""
        lengths, offsets = np.split(values, 2)
        return symbolic_points(self.lengths + lengths, q + ca.DM(offsets))

    def points(self, postures: Array, values: Array) -> Array:
        """(..., n + 1, 2) the same at postures (..., n)."""
        lengths, offsets = np.split(values, 2)
        return joint_points(self.lengths + lengths, postures + offsets)


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
