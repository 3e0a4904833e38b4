"""Effects of spatial arms only: compliance and runout of a joint's bearing across its axis."""

from __future__ import annotations

import casadi as ca
import numpy as np

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.effects.rare import RARE
from identification.kinematics.frames import rotation_to_z
from identification.kinematics.parameters import Parameter

NOMINAL_MOMENT = 100.0  # [N m] order of magnitude, for the scale of compliances only


@register
class BearingCompliance(Effect):
    """The bearing of a joint yields across its axis: tilted by c M, M the moment of gravity across the axis, c >= 0."""

    name = "bearing_compliance"
    summary = "bearing tilts across its axis under gravity"
    per_joint = "required"
    needs = frozenset({"gravity"})
    family = "gravity"
    dimensions = (3,)

    def define(self) -> tuple[Parameter, ...]:
        scale = self.link_length * NOMINAL_MOMENT
        # typical: output bearings of strain-wave gears, 4e4 to 4e6 N m/rad across the axis
        return (self.parameter("c", "rad/(N m)", scale=scale, lower=0.0, typical=3e-6),)

    def frame_errors(self, chain: Chain, values: ca.SX) -> tuple[ca.SX, ca.SX | float]:
        axis = chain.geometry.joints[self.joint_index].axis
        across = ca.DM(np.eye(3) - np.outer(axis, axis))
        return self.at_frame(values[0] * ca.mtimes(across, chain.moment(self.joint_index)), chain), 0.0


@register
class AxisRunout(Effect):
    """The axis of a joint runs out of true once per turn: shifted by (a + ib) exp(-i q_j) across itself.

    In complex numbers x + iy in the frame before the joint moves, z along the axis. A shift by (a + ib) exp(+i q_j)
    turns with the link and is an error of its geometry; every runout once per turn is a sum of the two.
    """

    name = "axis_runout"
    summary = "axis runs out of true once per turn"
    per_joint = "required"
    prior = RARE
    dimensions = (3,)

    def define(self) -> tuple[Parameter, ...]:
        # typical: runout of such bearings 5 to 15 um from peak to peak
        return tuple(self.parameter(short, "mm", scale=1.0, typical=3e-3) for short in ("a", "b"))

    def frame_errors(self, chain: Chain, values: ca.SX) -> tuple[ca.SX | float, ca.SX]:
        axis, angle = chain.geometry.joints[self.joint_index].axis, 2.0 * chain.q[self.joint_index]
        cosine, sine = ca.cos(angle), ca.sin(angle)  # in the frame that has turned
        across = ca.vertcat(values[0] * cosine + values[1] * sine, values[1] * cosine - values[0] * sine, 0.0)
        return 0.0, self.at_frame(ca.mtimes(ca.DM(rotation_to_z(axis)), across), chain)
