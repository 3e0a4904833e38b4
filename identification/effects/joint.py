"""Effects between the commanded and the real joint angle."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar

import casadi as ca

from identification.effects.base import Effect, JointAngle, Scope, Setting, register
from identification.effects.chain import Chain
from identification.kinematics.parameters import Parameter


@register
class JointCompliance(Effect):
    """Joints wind up under gravity torque: q_j + c_j tau_j, c_j >= 0."""

    name = "joint_compliance"
    summary = "joint winds up under gravity torque"
    per_joint = "optional"
    needs = frozenset({"gravity"})
    family = "gravity"

    def define(self) -> tuple[Parameter, ...]:
        if self.joint is not None:
            return (self._compliance("c", self.link_length),)
        return tuple(self._compliance(f"c{j}", length) for j, length in enumerate(self.chain.levers, start=1))

    def _compliance(self, short: str, length: float) -> Parameter:
        # typical: 1e5 N m/rad; strain-wave gears have 5e3 to 2.5e5, cycloidal ones 1e5 to 1e6
        torque = 100.0  # [N m] order of magnitude, for the scale only
        return self.parameter(short, "rad/(N m)", scale=float(length) * torque, lower=0.0, typical=1e-5)

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        if self.joint is None:
            return values * chain.torques
        return self.at_joint(values[0] * chain.torques[self.joint - 1], chain)


class _Harmonic(Effect):
    """a cos(k q_j) + b sin(k q_j) at one joint."""

    per_joint = "required"
    typical: ClassVar[float]  # of a and b [rad]

    def define(self) -> tuple[Parameter, ...]:
        return tuple(self.parameter(short, "rad", scale=self.link_length, typical=self.typical) for short in ("a", "b"))

    def order(self) -> float | ca.SX:
        """k, periods per turn."""
        raise NotImplementedError

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        angle = self.order() * chain.q[self.joint_index]
        return self.at_joint(values[0] * ca.cos(angle) + values[1] * ca.sin(angle), chain)


@register
class EncoderEccentricity(_Harmonic):
    """The encoder disc is off centre: a cos q_j + b sin q_j."""

    name = "encoder_eccentricity"
    summary = "encoder disc off centre, once per turn"
    # typical: 20 um of eccentricity on a ring of 40 mm radius
    typical = 5e-4

    def order(self) -> float | ca.SX:
        return 1


@register
class EncoderSecondHarmonic(_Harmonic):
    """The encoder disc is tilted or oval: a cos 2 q_j + b sin 2 q_j."""

    name = "encoder_second_harmonic"
    summary = "encoder disc tilted or oval, twice per turn"
    # typical: ovality of 8 um on 40 mm radius
    typical = 2e-4

    def order(self) -> float | ca.SX:
        return 2


def ripple_orders(scope: Scope) -> list[float]:
    """Periods per turn to try: whole numbers for gear teeth, and multiples of the gear ratio for turns of the motor."""
    orders = [float(k) for k in range(3, 65)]
    if scope.arm.gear_ratios is not None and scope.joint is not None:
        ratio = float(scope.arm.gear_ratios[scope.joint - 1])
        orders += [k * ratio for k in (1.0, 2.0, 3.0, 4.0) if ratio > 2.0]
    return orders


@register
class TransmissionRipple(_Harmonic):
    """Gear teeth or flex-spline error: a cos k q_j + b sin k q_j.

    Tried are the whole k from 3 to 64 and, where the arm file has the gear ratio of the joint, once to four times per
    turn of the motor; a wave of another order is looked up where the data show one.
    """

    name = "transmission_ripple"
    summary = "gear ripple, k times per turn"
    # typical: strain-wave gears, 1 arcmin from peak to peak, over sqrt(2) for a and b
    typical = 1e-4
    settings = MappingProxyType({"k": Setting(0.25, 2000.0, ripple_orders)})

    def order(self) -> float | ca.SX:
        return self.chosen["k"]


@register
class GearRatio(JointAngle):
    """The gear ratio in the controller is wrong: e q_j."""

    name = "gear_ratio"
    summary = "gear ratio in the controller is wrong"
    # typical: diameter of a pulley of 50 to 100 mm within 5 to 10 um
    number = ("e", "1", 1e-4)

    def shape(self, chain: Chain) -> ca.SX:
        return chain.q[self.joint_index]


@register
class JointCoupling(JointAngle):
    """Moving joint j-1 turns joint j a little (belt or wrist coupling): c q_(j-1)."""

    name = "joint_coupling"
    summary = "the joint before turns this one a little"
    first_joint = 2
    # typical: as of `gear_ratio`: what a controller leaves of a coupling
    number = ("c", "1", 1e-4)

    def shape(self, chain: Chain) -> ca.SX:
        return chain.q[self.joint_index - 1]


@register
class Backlash(JointAngle):
    """Play in the gear, resolved by the direction of approach s_j = +1/-1: b s_j."""

    name = "backlash"
    summary = "gear play, by direction of approach"
    needs = frozenset({"directions"})
    # typical: lost motion of robot gears 1 arcmin, half to either side
    number = ("b", "rad", 1.5e-4)

    def shape(self, chain: Chain) -> ca.SX:
        return chain.directions[self.joint_index]


@register
class GravityBacklash(JointAngle):
    """Play in the gear, pushed to one side by gravity: b sign(tau_j), b >= 0."""

    name = "gravity_backlash"
    summary = "gear play, pushed to one side by gravity"
    needs = frozenset({"gravity"})
    family = "gravity"
    # typical: as of `backlash`
    number = ("b", "rad", 1.5e-4)
    lower = 0.0

    def shape(self, chain: Chain) -> ca.SX:
        return ca.sign(chain.torques[self.joint_index])


@register
class ServoError(Effect):
    """The joint comes to rest, and is read, beside its command by b + h s_j. Positions follow what is read."""

    name = "servo_error"
    summary = "controller leaves the joint beside its command"
    per_joint = "required"
    of_commands = True

    def define(self) -> tuple[Parameter, ...]:
        # typical: a count of an encoder of 17 bits, 4.8e-5 rad
        return tuple(self.parameter(short, "rad", scale=self.link_length, typical=5e-5) for short in ("b", "h"))


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
