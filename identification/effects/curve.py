"""`JointErrorCurve`: the error of a joint as a tabulated smooth function of its angle."""

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
    tabulated = True

    def define(self) -> tuple[Parameter, ...]:
        return ()

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        """The interpolated value, supplied by the model; its derivative with respect to the posture is neglected."""
        if chain.errors is None:
            return ca.SX.zeros(chain.links)
        return self.at_joint(chain.errors[self.joint_index], chain)
