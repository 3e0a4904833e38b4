"""Effects that change the shape of the links, and of the bearings of the joints."""

from __future__ import annotations

import casadi as ca
import numpy as np

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.effects.rare import RARE
from identification.kinematics.frames import rotation_to_z
from identification.kinematics.parameters import Parameter


@register
class LinkBending(Effect):
    """Links bend as cantilever beams of one stiffness EI under the loads beyond their tips.

    For a link of length L with transverse force F and moment M at its tip (Euler-Bernoulli):
    deflection F L^3 / 3EI + M L^2 / 2EI, slope F L^2 / 2EI + M L / EI. The link's own mass is not a load beyond it.
    """

    name = "link_bending"
    summary = "links bend under the loads beyond them"
    dimensions = (2,)
    needs = frozenset({"gravity"})
    family = "gravity"

    def define(self) -> tuple[Parameter, ...]:
        # one unit of 1/(EI) under some 100 N at the end of links of some length: L^3 / 3 [m^3] * 100 N * 1000 mm/m
        scale = float(sum((length / 1000.0) ** 3 for length in self.chain.lengths)) / 3.0 * 1e5
        # typical: EI = 1e5 N m^2, an aluminium tube of 90 mm with walls of 6 mm
        return (self.parameter("flexibility", "1/(N m^2)", scale=scale, lower=0.0, typical=1e-5),)

    def bending(self, chain: Chain, values: ca.SX) -> tuple[ca.SX, ca.SX]:
        deflections, slopes = [], []
        last = chain.links - 1
        for j, length in enumerate((chain.lengths / 1000.0).tolist()):  # [m]
            force = chain.weight(j + 1, j)[1]  # [N] to the left of the link
            if j == last:  # the payload hangs on its tip, so it is beyond it; its moment there is 0
                force += chain.payload * ca.dot(chain.frames[j + 1].axes[:, 1], chain.acceleration)
            moment = chain.moment(j + 1)[2] if j < last else 0.0  # [N m]
            deflections.append((force * length**3 / 3.0 + moment * length**2 / 2.0) * 1000.0)
            slopes.append(force * length**2 / 2.0 + moment * length)
        return values[0] * ca.vertcat(*deflections), values[0] * ca.vertcat(*slopes)


@register
class ThermalGrowth(Effect):
    """Links grow with temperature: l_j (1 + a (T - T_mean))."""

    name = "thermal_growth"
    summary = "links grow with temperature"
    needs = frozenset({"temperature"})

    def define(self) -> tuple[Parameter, ...]:
        # typical: steel 12e-6, aluminium 23e-6
        return (self.parameter("a", "1/K", scale=self.reach, typical=2e-5),)

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX:
        return lengths * values[0] * chain.temperature


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
        scale = self.link_length * 100.0  # [N m] order of magnitude
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
