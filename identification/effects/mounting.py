"""Effects of the base and of the measuring instrument; those that no measurement of the tip can distinguish from the
base parameters are listed, never named.
"""

from __future__ import annotations

from types import MappingProxyType

import casadi as ca

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.instruments.distance import distance_to_center
from identification.kinematics.parameters import Parameter


@register
class BaseOffset(Effect):
    """The base does not stand at the origin of the measurements: + (x0, y0)."""

    name = "base_offset"
    summary = "base not at the origin of the measurements"
    of_positions = True
    dimensions = (2,)  # in space the base is part of the geometry

    def define(self) -> tuple[Parameter, ...]:
        # typical: a base set up with dowels or by touching off
        return tuple(self.parameter(short, "mm", scale=1.0, typical=1.0) for short in ("x0", "y0"))

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values


@register
class BaseDrift(Effect):
    """The base (or the tracker) creeps during the session: + (vx, vy) t, t = -0.5..0.5; in space + (vx, vy, vz) t."""

    name = "base_drift"
    summary = "base or tracker creeps during the session"
    needs = frozenset({"time"})
    once = True

    def define(self) -> tuple[Parameter, ...]:
        shorts = (f"v{axis}" for axis in self.chain.axes)
        # typical: creep of tripods, floors and warming frames in an hour or two
        return tuple(self.parameter(short, "mm/session", scale=1.0, typical=0.05) for short in shorts)

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values * chain.time


@register
class BaseRotationDrift(Effect):
    """The base (or the tracker) turns during the session: by w t, t = -0.5..0.5; in space by (wx, wy, wz) t."""

    name = "base_rotation_drift"
    summary = "base or tracker turns during the session"
    needs = frozenset({"time"})
    once = True

    def define(self) -> tuple[Parameter, ...]:
        names = self.chain.turn_names
        # typical: as of `base_drift`, at 1 m
        return tuple(self.parameter(short, "rad/session", scale=self.reach, typical=5e-5) for short in names)

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values * chain.time


@register
class SessionBase(Effect):
    """Each session after the first has its own base: + (x, y), rotation by w, relative to that of the first.

    In space + (x, y, z) and rotations by (wx, wy, wz) about the axes of the base.

    Nothing physical is missing: arm or instrument was set up again. `identify` and `diagnose` add it by themselves
    where the data name sessions, and leave it out of what they write.
    """

    name = "session_base"
    summary = "arm or instrument set up again for each session"
    needs = frozenset({"session"})
    settings = MappingProxyType({"sessions": (2, 99)})
    nuisance = True

    def define(self) -> tuple[Parameter, ...]:
        """Parameters of each session after the first, in order."""
        # typical: arm or instrument anywhere in the cell, turned by any angle
        shifts = [(short, "mm", 1.0, 1000.0) for short in self.chain.axes]
        turns = [(short, "rad", self.reach, 3.0) for short in self.chain.turn_names]
        return tuple(
            self.parameter(f"{short}{number}", unit, scale=scale, typical=typical)
            for number in range(2, int(self.chosen["sessions"]) + 1)
            for short, unit, scale, typical in (*shifts, *turns)
        )

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return self._own(chain, values)[self.dimension :]

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return self._own(chain, values)[: self.dimension]

    def _own(self, chain: Chain, values: ca.SX) -> ca.SX:
        """Translation and rotation of the row's session, zero for the first."""
        in_session = self._sessions(chain)
        return ca.mtimes(ca.reshape(values, -1, in_session.numel()), in_session)

    def _sessions(self, chain: Chain) -> ca.SX:
        """Indicator of each session after the first: 1 for the row's session, else 0."""
        return ca.vertcat(*(chain.session == number for number in range(1, int(self.chosen["sessions"]))))


@register
class AxesSkew(Effect):
    """Unequal scales and axes that are not square: p + (a + ib) conj(p), p = x + iy."""

    name = "axes_skew"
    summary = "instrument axes of unequal scale or not square"
    of_positions = True
    dimensions = (2,)

    def define(self) -> tuple[Parameter, ...]:
        # typical: laser trackers 1e-5, cameras 1e-4 of the distance
        return tuple(self.parameter(short, "1", scale=self.reach, typical=5e-5) for short in ("a", "b"))

    def instrument(self, position: ca.SX, values: ca.SX) -> ca.SX:
        x, y = position[0], position[1]
        return ca.vertcat(values[0] * x + values[1] * y, values[1] * x - values[0] * y)


@register
class LengthOffset(Effect):
    """A measured distance is longer than it is by the same everywhere, + c: the zero of a draw wire, the reference
    length of a ball bar."""

    name = "length_offset"
    summary = "all measured distances too long by the same"
    needs = frozenset({"distance"})
    dimensions = (3,)

    def define(self) -> tuple[Parameter, ...]:
        # typical: wires are zeroed by hand, bars measured between rims
        return (self.parameter("c", "mm", scale=1.0, typical=0.5),)

    def instrument(self, position: ca.SX, values: ca.SX) -> ca.SX:
        return values[0] * position / distance_to_center(position)  # the center is the origin


@register
class MeasurementScale(Effect):
    """The instrument's unit is wrong by a factor: p (1 + s)."""

    name = "measurement_scale"
    summary = "instrument scale is wrong"
    alias = "a common factor of all link lengths"

    def define(self) -> tuple[Parameter, ...]:
        # typical: as of `axes_skew`
        return (self.parameter("s", "1", scale=self.reach, typical=5e-5),)

    def instrument(self, position: ca.SX, values: ca.SX) -> ca.SX:
        return values[0] * position


@register
class ToolOffset(Effect):
    """The measured target is not at the tip: (x, y) in the frame of the last link."""

    name = "tool_offset"
    summary = "target not at the tip"
    alias = "the length and the joint offset of the last link"
    dimensions = (2,)  # in space the tool is part of the geometry

    def define(self) -> tuple[Parameter, ...]:
        # typical: adapter of a target, not measured
        return tuple(self.parameter(short, "mm", scale=1.0, typical=1.0) for short in ("x", "y"))

    def tool(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values


@register
class BaseRotation(Effect):
    """The base is turned against the frame of the measurements."""

    name = "base_rotation"
    summary = "base turned against the measurements"
    alias = "the offset of joint 1"
    dimensions = (2,)  # in space the base is part of the geometry

    def define(self) -> tuple[Parameter, ...]:
        # typical: as `base_offset`, 1 mm at 1 m
        return (self.parameter("angle", "rad", scale=float(self.chain.levers[0]), typical=1e-3),)

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values[0]
