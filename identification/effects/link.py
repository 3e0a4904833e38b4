"""Effects that change the shape of the links."""

from __future__ import annotations

import casadi as ca

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
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
