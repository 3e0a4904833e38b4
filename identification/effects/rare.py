"""Less common effects of real robot cells: warm-up, steps in time, wrong loads, hysteresis, a tilted axis.

Their lower `prior` weight lets a common effect be named where it explains the data equally well.
"""

from __future__ import annotations

from itertools import pairwise
from types import MappingProxyType

import casadi as ca
import numpy as np

from identification.effects.base import Effect, JointAngle, Scope, Setting, clock, register, step_times
from identification.effects.chain import Chain
from identification.kinematics.parameters import Parameter

RARE = 0.2  # prior beside a common effect
STEP = Setting(-0.5, 1000.0, step_times)  # time of a step, see `clock`
WIDTHS = (0.05, 0.08, 0.12, 0.18, 0.27, 0.4)  # of hysteresis, in ranges of the joint: below backlash, above gear ratio


class _Rare(Effect):
    prior = RARE


@register
class ThermalTransient(_Rare):
    """Links grow while the arm warms up, one or all alike: l_j (1 + a (1 - exp(-(t + 1/2) / tau))), t = -0.5..0.5."""

    name = "thermal_transient"
    summary = "links grow exponentially while the arm warms up"
    per_joint = "optional"
    needs = frozenset({"time"})
    # times to try, of a session: neighbors are alike to 0.98, beyond them drift or nothing
    settings = MappingProxyType({"tau": Setting(0.001, 10.0, (0.05, 0.1, 0.2, 0.4, 0.8))})

    def define(self) -> tuple[Parameter, ...]:
        scale = self.reach if self.joint is None else self.link_length
        # typical: aluminium that warms by 4 K
        return (self.parameter("a", "1", scale=scale, typical=1e-4),)

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX:
        warm = 1.0 - ca.exp(-(chain.time + 0.5) / self.chosen["tau"])
        if self.joint is None:
            return lengths * values[0] * warm
        return self.at_joint(lengths[self.joint_index] * values[0] * warm, chain)


class _Step(_Rare):
    """Base class of effects that change once during the session."""

    needs = frozenset({"time"})
    once = True
    settings = MappingProxyType({"at": STEP})

    def after(self, chain: Chain) -> ca.SX:
        """1 after the step, 0 before."""
        return clock(chain.time, chain.session) > self.chosen["at"]


@register
class JointStep(_Step, JointAngle):
    """The zero of a joint jumps at a time of the session, as after a collision or a lost count: b for t > at."""

    name = "joint_step"
    summary = "zero of a joint jumps during the session"
    # typical: a few encoder counts lost, or a light collision
    number = ("b", "rad", 2e-4)

    def shape(self, chain: Chain) -> ca.SX:
        return self.after(chain)


@register
class LinkStep(_Step):
    """A link is longer from a time of the session on, as after it was taken off and mounted again: d for t > at."""

    name = "link_step"
    summary = "link is longer after a remounting"
    per_joint = "required"

    def define(self) -> tuple[Parameter, ...]:
        # typical: a flange remounted without dowels
        return (self.parameter("d", "mm", scale=1.0, typical=0.1),)

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX:
        return self.at_joint(values[0] * self.after(chain), chain)


@register
class BaseStep(_Step):
    """The base or the instrument is moved at a time of the session: + (x, y), in space + (x, y, z), on one side of it.

    side : 1 for t > at, -1 for t < at. Where the model has no `base_offset` that is not the same.
    """

    name = "base_step"
    summary = "base or tracker jumps during the session"
    settings = MappingProxyType({"at": STEP, "side": Setting(-1, 1, (-1.0, 1.0), whole=True)})

    def define(self) -> tuple[Parameter, ...]:
        # typical: as of `link_step`
        return tuple(self.parameter(short, "mm", scale=1.0, typical=0.1) for short in self.chain.axes)

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values * (self.chosen["side"] * (clock(chain.time, chain.session) - self.chosen["at"]) > 0)


class _Load(_Rare):
    """Base class of effects that act through the effects of gravity in the arm's model, and modify all of them."""

    needs = frozenset({"gravity"})
    through = "gravity"


@register
class PayloadError(_Load):
    """The payload is not what the file says: + d, for every effect of gravity."""

    name = "payload_error"
    summary = "payload is not what the file says"

    def define(self) -> tuple[Parameter, ...]:
        # typical: cables and adapters that nobody weighed
        return (self.parameter("d", "kg", scale=1.0, typical=0.5),)

    def payload(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values[0]


@register
class PayloadPlace(_Load):
    """The payload hangs elsewhere than the file says: shifted by (x, y, z) in the frame of the tip."""

    name = "payload_place"
    summary = "payload hangs elsewhere than the file says (payload_at_mm)"
    family = "payload_error"
    dimensions = (3,)

    def define(self) -> tuple[Parameter, ...]:
        # typical: grippers are 100 mm long, targets sit on their rims
        return tuple(self.parameter(short, "mm", scale=1.0, typical=50.0) for short in "xyz")

    def payload_shift(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values


@register
class ToolMass(_Load):
    """The tool is so much heavier than the payload that the arm file says: + m, m >= 0, for every effect of gravity.

    For tools that nobody weighed: a guessed mass makes a wrong stiffness of it. With one payload in all rows, the
    masses of the links distinguish mass and compliances; `diagnose` looks for `payload_error` instead. Where nothing
    determines m, it is what tools usually weigh, so that what shows under the tool's weight alone is looked for.
    """

    name = "tool_mass"
    summary = "mass of a tool that nobody weighed"
    family = "payload_error"
    nuisance = True

    def define(self) -> tuple[Parameter, ...]:
        # typical: grippers and adapters of targets
        return (self.parameter("m", "kg", scale=1.0, lower=0.0, typical=2.0, start=2.0),)

    def payload(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values[0]


@register
class GravityTilt(_Load):
    """The base leans: gravity is turned by an angle, in space by two about x and y, for every effect of gravity."""

    name = "gravity_tilt"
    summary = "base leans against gravity"

    def define(self) -> tuple[Parameter, ...]:
        shorts = {1: ("angle",), 3: ("x", "y")}[len(self.chain.turning)]
        # typical: floors are level to some mm per m
        return tuple(self.parameter(short, "rad", scale=1.0, typical=5e-3) for short in shorts)

    def gravity_turn(self, chain: Chain, values: ca.SX) -> ca.SX:
        return ca.vertcat(values, ca.SX.zeros(len(self.chain.turning) - values.numel()))  # about the vertical: nothing


@register
class AxisTilt(_Rare):
    """The axis of a joint leans out of the normal of the plane: what lies beyond is seen foreshortened.

    With s the vector from the joint to the tip and theta the orientation of the link before, in complex numbers:
    s + (a + ib) exp(2i theta) conj(s). A lean by alpha about the direction beta against that link has
    a + ib = alpha^2 exp(2i beta) / 4. In joint 1 that is `axes_skew`.
    """

    name = "axis_tilt"
    summary = "axis leans out of the plane"
    per_joint = "required"
    first_joint = 2
    dimensions = (2,)  # in space the geometry has it

    def define(self) -> tuple[Parameter, ...]:
        scale = float(np.sum(self.chain.lengths[self.joint_index :]))
        # typical: alpha^2 / 4 with alpha = 0.02 rad, bearings 1 mm out of line on 50 mm
        return tuple(self.parameter(short, "1", scale=scale, typical=1e-4) for short in ("a", "b"))

    def _along_and_across(self, chain: Chain, values: ca.SX) -> tuple[ca.SX, ca.SX]:
        """(n,) displacements along and across each link, per unit length: real and imaginary part of
        (a + ib) exp(-2i angle), with the angle of the link against the one before this joint."""
        along, across, angle = ca.SX.zeros(chain.links), ca.SX.zeros(chain.links), ca.SX(0)
        for k in range(self.joint_index, chain.links):
            angle += chain.q[k]
            cosine, sine = ca.cos(2.0 * angle), ca.sin(2.0 * angle)
            along[k] = values[0] * cosine + values[1] * sine
            across[k] = values[1] * cosine - values[0] * sine
        return along, across

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX:
        return lengths * self._along_and_across(chain, values)[0]

    def bending(self, chain: Chain, values: ca.SX) -> tuple[ca.SX, ca.SX | float]:
        return ca.DM(chain.lengths) * self._along_and_across(chain, values)[1], 0.0


def hysteresis_widths(scope: Scope) -> list[float]:
    """Widths to try [deg], from nearly backlash to nearly a wrong gear ratio, for the range of the joint."""
    joint = (scope.joint or 1) - 1
    if scope.postures is None:
        span = float(scope.arm.upper[joint] - scope.arm.lower[joint])
    else:
        span = float(np.ptp(scope.postures[:, joint]))
    return [float(np.degrees(width * span)) for width in WIDTHS] if span > 0.0 else [1.0]


@register
class JointHysteresis(_Rare, JointAngle):
    """Friction winds the gear up until it slips: b times the wind-up, which follows the joint's motion within -1..1.

    The wind-up grows by the motion divided by the width and stays within -1..1 (Prandtl's element); at the start of the
    session it is 0. It remembers earlier postures as long as no motion is wider than twice the width. A width of 0 is
    `backlash`, one beyond the range of the joint `gear_ratio`.
    """

    name = "joint_hysteresis"
    summary = "friction winds the gear up, with a memory of earlier motions"
    needs = frozenset({"past"})
    # typical: as of `backlash`: catalogs give 1 arcmin, too
    number = ("b", "rad", 1.5e-4)
    settings = MappingProxyType({"width_deg": Setting(0.01, 1000.0, hysteresis_widths)})

    def shape(self, chain: Chain) -> ca.SX:
        joint = self.joint_index
        angles = [] if chain.past is None else [chain.past[joint, k] for k in range(chain.past.shape[1])]
        angles.append(chain.q[joint])
        wind_up, width = ca.SX(0), np.pi / 180.0 * self.chosen["width_deg"]
        for before, after in pairwise(angles):
            wind_up = ca.fmax(-1.0, ca.fmin(1.0, wind_up + (after - before) / width))
        return wind_up
