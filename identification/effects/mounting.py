"""Effects between the arm's base and the frame of the measurements."""

from __future__ import annotations

import casadi as ca

from identification.effects.base import Effect, register
from identification.effects.chain import Chain
from identification.kinematics.parameters import Parameter


@register
class BaseOffset(Effect):
    """The base does not stand at the origin of the measurements: + (x0, y0)."""

    name = "base_offset"
    summary = "base not at the origin of the measurements"
    family = "base_offset"

    def define(self) -> tuple[Parameter, ...]:
        return tuple(self.parameter(short, "mm", scale=1.0, typical=1.0) for short in ("x0", "y0"))

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values


@register
class BaseDrift(Effect):
    """The base (or the tracker) creeps during the session: + (vx, vy) t, t = -0.5..0.5."""

    name = "base_drift"
    summary = "base or tracker creeps during the session"
    needs = frozenset({"time"})
    family = "base_drift"

    def define(self) -> tuple[Parameter, ...]:
        return tuple(self.parameter(short, "mm/session", scale=1.0, typical=0.05) for short in ("vx", "vy"))

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values * chain.time


@register
class BaseRotationDrift(Effect):
    """The base (or the tracker) turns during the session: rotation by w t, t = -0.5..0.5."""

    name = "base_rotation_drift"
    summary = "base or tracker turns during the session"
    needs = frozenset({"time"})
    family = "base_rotation_drift"

    def define(self) -> tuple[Parameter, ...]:
        return (self.parameter("w", "rad/session", scale=self.reach, typical=5e-5),)

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX:
        return values[0] * chain.time
