"""The error of a joint as a smooth curve over its angle: what no textbook name fits."""

from __future__ import annotations

import casadi as ca

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.kinematics.parameters import Parameter


@register
class JointErrorCurve(Effect):
    """A function of the joint's own angle, found by `diagnose` from the angles measured; zero beyond them."""

    name = "joint_error_curve"
    summary = "smooth error over the angles measured, as a table"
    per_joint = "required"
    family = "joint_error_curve"
    tabulated = True

    def define(self) -> tuple[Parameter, ...]:
        return ()

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        if self.curve is None:
            return ca.SX.zeros(chain.links)
        x = (chain.q[self.joint_index] - self.curve.start) / self.curve.spacing
        total = ca.SX(0)
        for k, coefficient in enumerate(self.curve.coefficients.tolist()):
            distance = ca.fabs(x - k)  # of the cubic B-spline around node k, see `error_curve.spline`
            wide, narrow = ca.fmax(2.0 - distance, 0.0), ca.fmax(1.0 - distance, 0.0)
            total += coefficient / 6.0 * (wide * wide * wide - 4.0 * narrow * narrow * narrow)
        return self.at_joint(total, chain)
