"""Effects not distinguishable from the base parameters by any measurement of the tip: listed, never named."""

from __future__ import annotations

import casadi as ca

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.kinematics.parameters import Parameter


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
