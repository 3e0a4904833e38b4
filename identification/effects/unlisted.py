"""Errors of any form, of which the place is known: what `diagnose` adds where no effect of the library explains it.

Each is a sum of given functions; `diagnose` says where it is and estimates the values, but never names it. Functions
that are fast or of two angles are smaller, as errors of that kind are.
"""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import combinations_with_replacement, product
from math import prod
from typing import Any

import casadi as ca
import numpy as np

from identification.effects.base import LEVER, ArmState, Effect, Number, Scope, Setting, add_effect, widths
from identification.effects.formulas import SPACE
from identification.kinematics.frames import rotation_to_z

SLOW = 3  # convention: order of the fastest function of several variables, or with several values
FAST = 12  # convention: half periods of the fastest function of time, or of one coordinate over twice the reach
of_any_form = partial(add_effect, unlisted=True)
of_joint = partial(of_any_form, per_joint="required", prior=0.3)


def numbers(count: int, unit: str, *scale: Any) -> list[Number]:
    """`v1`, `v2` .. of so many functions, which have no typical size."""
    return [Number(f"v{k}", unit, None, *scale) for k in range(1, count + 1)]


def turning_waves(angle: ca.SX, orders: Iterable[int]) -> ca.SX:
    """Cosine and sine of each order, periods per turn."""
    return ca.vertcat(*(wave(k * angle) for k in orders for wave in (ca.cos, ca.sin)))


def half_waves(x: ca.SX, count: int) -> ca.SX:
    """Of each coordinate in turn the (count,) waves of 1, 2 .. half periods between 0 and 1, where they are even."""
    return ca.vec(ca.cos(np.pi * ca.mtimes(ca.DM(range(1, count + 1)), x.T)))


def slow_waves(place: ca.SX, with_last: bool = False) -> ca.SX:
    """Products of waves along several coordinates from -1 to 1, the slow ones larger: of orders, in half periods, with
    a sum up to `SLOW`;  with_last : only those in which the last coordinate is"""
    along = [ca.vertcat(1.0, half_waves(0.5 * (x + 1.0), SLOW)) for x in ca.vertsplit(place)]
    orders = [k for k in product(range(SLOW + 1), repeat=len(along)) if 1 <= sum(k) <= SLOW and k[-1] >= with_last]
    return ca.vertcat(*(prod(w[k] for w, k in zip(along, each, strict=True)) / np.dot(each, each) for each in orders))


# -- of a joint --------------------------------------------------------------------------------------------------------
def _by_approach(self: Effect, chain: ArmState, values: ca.SX) -> ca.SX:
    """Of the angle and the last move, with another sign by its direction."""
    j = self.joint_index
    waves = ca.vertcat(1.0, turning_waves(chain.q[j], [1]), ca.exp(-ca.fabs(chain.q[j] - chain.previous[j])))
    return chain.directions[j] * ca.dot(waves, values)


def _load_unit(self: Effect, chain: ArmState) -> float:
    """Torque [N m] of all masses at half the reach."""
    gravity = chain.required_gravity
    weight = (sum(gravity.link_masses) + gravity.payload) * float(np.linalg.norm(gravity.acceleration))
    return max(0.5e-3 * weight * self.reach, 1e-9)


def _by_load(self: Effect, chain: ArmState, values: ca.SX) -> ca.SX:
    """Of the torque, as a spring, play and friction have it."""
    t = chain.torques[self.joint_index] / _load_unit(self, chain)
    return ca.dot(ca.vertcat(t, ca.fabs(t), t * ca.fabs(t), ca.sign(t)), values)


def _across_the_axis(self: Effect, chain: ArmState, values: ca.SX) -> ca.SX:
    """(3,) across the axis, by waves of its angle."""
    across = ca.DM(rotation_to_z(self.chain.joints[self.joint_index].axis)[:, :2])
    waves = turning_waves(chain.q[self.joint_index], range(1, SLOW + 1))
    return ca.mtimes([across, ca.reshape(values, 2, 2 * SLOW), waves])


of_joint(
    "two_joint_error",
    "depends on other joints too: slow waves of the other's angle, and products of those of both",
    numbers(6, "rad", LEVER),
    settings={"other": Setting(1, 99, Scope.other_joints, whole=True, symbolic=False)},
    # of the other joint's angle, and of both angles: not periodic, as a cable that is wound up
    joint_angles=lambda self, chain, values: ca.dot(
        slow_waves(chain.q[[self.joint_index, int(self.chosen["other"]) - 1]] / np.pi, with_last=True), values
    ),
)
of_joint(
    "approach_error",
    "depends on the direction of approach: s (v1 + v2 cos q + v3 sin q + v4 exp(-|last move|))",
    numbers(4, "rad", LEVER),
    needs=frozenset({"directions", "past"}),
    joint_angles=_by_approach,
)
of_joint(
    "load_error",
    "depends on the load: v1 t + v2 |t| + v3 t |t| + v4 sign t, t the gravity torque",
    numbers(4, "rad", LEVER),
    needs=frozenset({"gravity"}),
    joint_angles=_by_load,
)
of_joint(
    "axis_error",
    "tilt or shift across the axis: waves of the joint's angle, tilts at the reach",
    numbers(8 * SLOW, "mm"),
    dimensions=SPACE,
    joint_turns=lambda self, chain, values: _across_the_axis(self, chain, values[: 4 * SLOW] / self.reach),
    joint_shifts=lambda self, chain, values: _across_the_axis(self, chain, values[4 * SLOW :]),
)


# -- in time and with the temperature ----------------------------------------------------------------------------------
def _in_time(chain: ArmState, count: int) -> ca.SX:
    """Waves over the session, the slow ones larger."""
    return half_waves(chain.time + 0.5, count) / ca.DM(range(1, count + 1))


def _moving(
    name: str,
    about: str,
    unit: str,
    places: tuple[str, str],
    count: int,
    functions: Callable[[ArmState, int], ca.SX],
    **more: Any,
) -> None:
    """Add an effect that shifts and turns something, at its places, each by so many functions of what holds in a row;
    unit : of the values, shifts and turns at the reach"""

    def moved(self: Effect, chain: ArmState, values: ca.SX) -> tuple[ca.SX, ca.SX]:
        shift, turn = (widths(self.chain)[place] for place in places)
        both = ca.mtimes(ca.reshape(values, shift + turn, count), functions(chain, count))
        return both[:shift], both[shift:] / self.reach

    def counted(self: Effect) -> list[Number]:
        return numbers(count * sum(widths(self.chain)[place] for place in places), unit)

    each = {place: lambda self, chain, values, k=k: moved(self, chain, values)[k] for k, place in enumerate(places)}
    of_any_form(name, about, counted, **each, **more)


BASE, GEOMETRY = ("base_translation", "base_rotation"), ("joint_shifts", "joint_turns")
TIME, TEMPERATURE = frozenset({"time"}), frozenset({"temperature"})
of_session = partial(_moving, unit="mm/session", functions=_in_time, needs=TIME, once=True)
of_warmth = partial(_moving, unit="mm/K", count=1, functions=lambda chain, _: chain.temperature, needs=TEMPERATURE)
of_session("time_shift", "smooth in time: base moves as waves over the session", places=BASE, count=FAST)
of_session(
    "time_geometry",
    "geometry that changes in time: every joint moves, as slow waves over the session",
    places=GEOMETRY,
    count=SLOW,
    prior=0.3,
)
of_warmth("temperature_shift", "follows the temperature: base moves by v (T - T_mean)", places=BASE)
of_warmth(
    "temperature_geometry",
    "geometry that follows the temperature: every joint moves by v (T - T_mean)",
    places=GEOMETRY,
    prior=0.3,
)
of_any_form(
    "time_load",
    "load that changes in time: angles by the gravity torque, as slow waves over the session",
    lambda self: numbers(SLOW * len(self.chain), "rad/session", self.reach),
    needs=frozenset({"time", "gravity"}),
    once=True,
    prior=0.3,
    joint_angles=lambda self, chain, values: (
        chain.torques
        / _load_unit(self, chain)
        * ca.mtimes(ca.reshape(values, len(self.chain), SLOW), _in_time(chain, SLOW))
    ),
)


# -- over the workspace ------------------------------------------------------------------------------------------------
def _over_workspace(name: str, about: str, functions: Callable[[ca.SX], ca.SX], *, outwards: bool = False) -> None:
    """Add an effect that shifts what is measured by functions of its place, from the base in units of the reach.

    outwards : away from the base, else along each of its axes; so it moves with the base, as errors of an arm do. With
        a UR10's tracker turned by 50 degrees: RMS .569 mm, .604 if it stayed with the tracker, .572 without
    """

    def counted(self: Effect) -> list[Number]:
        d = self.chain.dimension
        return numbers((1 if outwards else d) * functions(ca.SX.sym("place", d)).numel(), "mm")

    def shifted(self: Effect, point: ca.SX, values: ca.SX) -> ca.SX:
        d = self.chain.dimension
        turn, center = (ca.DM(each) for each in (self.chain.base[:d, :d], self.chain.base[:d, 3]))
        place = ca.mtimes(turn.T, point - center) / self.reach
        if outwards:
            shift = place / ca.fmax(ca.norm_2(place), 1e-9) * ca.dot(functions(place), values)
        else:
            shift = ca.mtimes(ca.reshape(values, d, -1), functions(place))
        return ca.mtimes(turn, shift)

    of_any_form(name, about, counted, of_positions=True, prior=0.25, instrument=shifted)


def _fast(x: ca.SX) -> ca.SX:
    """Waves of each coordinate between 0 and 1, the slow ones larger."""
    return half_waves(x, FAST) / ca.repmat(ca.sqrt(ca.DM(range(1, FAST + 1))), x.numel())


_over_workspace("workspace_smooth", "smooth over the workspace: slow waves along the axes of the base", slow_waves)
_over_workspace(
    "workspace_axes",
    "smooth over the workspace: waves along each axis of the base",
    lambda place: _fast(0.5 * (place + 1.0)),
)
_over_workspace(
    "workspace_squares",
    "smooth over the workspace: squares and products of the coordinates from the base",
    lambda place: ca.vertcat(*(a * b for a, b in combinations_with_replacement(ca.vertsplit(place), 2))),
)
_over_workspace(
    "workspace_radius",
    "smooth over the workspace: outwards, by waves of the distance from the base",
    lambda place: _fast(ca.norm_2(place)),
    outwards=True,
)
