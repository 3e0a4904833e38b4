"""Effects of the measuring instrument."""

from __future__ import annotations

import casadi as ca

from identification.effects.base import Effect, register
from identification.instruments.distance import distance_to_center
from identification.kinematics.parameters import Parameter


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
