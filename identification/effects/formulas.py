"""The library: every effect, with its parameters and what it adds at its place (`add_effect`).

The reason for each typical size stands beside it. Less common effects of real robot cells have a lower `prior`, which
lets a common effect be named where it explains the data equally well. Effects that no measurement of the tip can
distinguish from the base parameters are listed, never named (`alias`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from identification.arrays import Array
from identification.effects.base import LEVER, REACH, ArmState, Effect, Number, Scope, Setting, add_effect, clock
from identification.instruments import distance_to_center
from identification.kinematics.frames import rotation_to_z

RARE = 0.2  # prior beside a common effect
TORQUE = 100.0  # [N m] order of magnitude, for scales only
PLANE, SPACE = (2,), (3,)
STEP = Setting(-0.5, 1000.0, Scope.step_times)  # time of a step, see `clock`

of_gravity = partial(add_effect, needs=frozenset({"gravity"}), family="gravity")
# acts through the effects of gravity in the arm's model, and modifies all of them
of_load = partial(add_effect, needs=frozenset({"gravity"}), through="gravity", prior=RARE)
of_time = partial(add_effect, needs=frozenset({"time"}))
of_joint = partial(add_effect, per_joint="required")
of_turning_joint = partial(of_joint, of_angle=True)


def each(shorts: Iterable[str], *more: Any) -> list[Number]:
    """Numbers of these short names that are alike."""
    return [Number(short, *more) for short in shorts]


def _wave(order: float | ca.SX, angle: ca.SX, values: ca.SX) -> ca.SX:
    """A wave of this order, periods per turn."""
    return values[0] * ca.cos(order * angle) + values[1] * ca.sin(order * angle)


def _turned_back(values: ca.SX, angle: ca.SX) -> ca.SX:
    """Real and imaginary part of (a + ib) exp(-i angle)."""
    cosine, sine = ca.cos(angle), ca.sin(angle)
    return ca.vertcat(values[0] * cosine + values[1] * sine, values[1] * cosine - values[0] * sine)


# -- between the commanded and the real joint angle --------------------------------------------------------------------
def _compliances(self: Effect) -> list[Number]:
    """Of its joint, or of all."""
    numbers = list[Number]()
    for j in [self.joint] if self.joint else range(1, len(self.chain) + 1):
        unit, many = self.chain.unit_at(j, "rad/(N m)")
        scale = float(self.chain.levers[j - 1]) * TORQUE / many
        numbers.append(Number(f"c{'' if self.joint else j}", unit, 1e-5 * many, scale, 0.0))
    return numbers


of_gravity(
    "joint_compliance",
    "joint winds up under gravity torque: q_j + c_j tau_j, c_j >= 0",
    _compliances,  # typical: 1e5 N m/rad; strain-wave gears have 5e3 to 2.5e5, cycloidal ones 1e5 to 1e6
    per_joint="optional",
    joint_angles=lambda self, chain, values: (
        values * (chain.torques[self.joint_index] if self.joint else chain.torques)
    ),
)
of_turning_joint(
    "encoder_eccentricity",
    "encoder disc off centre, once per turn: a cos q_j + b sin q_j",
    each("ab", "rad", 5e-4, LEVER),  # typical: 20 um of eccentricity on a ring of 40 mm radius
    joint_angles=lambda self, chain, values: _wave(1, chain.q[self.joint_index], values),
)
of_turning_joint(
    "encoder_second_harmonic",
    "encoder disc tilted or oval, twice per turn: a cos 2 q_j + b sin 2 q_j",
    each("ab", "rad", 2e-4, LEVER),  # typical: ovality of 8 um on 40 mm radius
    joint_angles=lambda self, chain, values: _wave(2, chain.q[self.joint_index], values),
)


def _ripple_orders(scope: Scope) -> list[float]:
    """Whole numbers for gear teeth and, where the arm file has the gear ratio of the joint, once to four times per turn
    of the motor; a wave of another order is looked up where the data show one."""
    orders = [float(k) for k in range(3, 65)]
    if scope.arm.gear_ratios is not None and scope.joint is not None:
        ratio = float(scope.arm.gear_ratios[scope.joint - 1])
        orders += [k * ratio for k in (1.0, 2.0, 3.0, 4.0) if ratio > 2.0]
    return orders


of_turning_joint(
    "transmission_ripple",
    "gear ripple, k times per turn: a cos k q_j + b sin k q_j, of gear teeth or a flex-spline",
    each("ab", "rad", 1e-4, LEVER),  # typical: strain-wave gears, 1 arcmin from peak to peak, over sqrt(2) for a and b
    settings={"k": Setting(0.25, 2000.0, _ripple_orders)},
    joint_angles=lambda self, chain, values: _wave(self.chosen["k"], chain.q[self.joint_index], values),
)
of_joint(
    "gear_ratio",
    "gear ratio in the controller is wrong: e q_j",
    [Number("e", "1", 1e-4, LEVER)],  # typical: diameter of a pulley of 50 to 100 mm within 5 to 10 um
    joint_angles=lambda self, chain, values: values * chain.q[self.joint_index],
)


def _coupling(self: Effect) -> list[Number]:
    """In the units of this joint and the one before."""
    by, before = self.chain.unit_at(self.joint_index, "rad")
    moved, many = self.chain.unit_at(self.joint_index + 1, "rad")
    return [Number("c", "1" if moved == by else f"{moved}/{by}", 1e-4 * many / before, LEVER)]


of_joint(
    "joint_coupling",
    "the previous joint turns this one a little: c q_(j-1), of a belt or a wrist",
    _coupling,  # typical: as of `gear_ratio`: what a controller leaves of a coupling
    first_joint=2,
    joint_angles=lambda self, chain, values: values * chain.q[self.joint_index - 1],
)
of_joint(
    "backlash",
    "gear play, by direction of approach: b s_j, s_j = +1/-1",
    [Number("b", "rad", 1.5e-4, LEVER)],  # typical: lost motion of robot gears 1 arcmin, half to either side
    needs=frozenset({"directions"}),
    joint_angles=lambda self, chain, values: values * chain.directions[self.joint_index],
)
of_gravity(
    "gravity_backlash",
    "gear play, pushed to one side by gravity: b sign(tau_j), b >= 0",
    [Number("b", "rad", 1.5e-4, LEVER, 0.0)],  # typical: as of `backlash`
    per_joint="required",
    joint_angles=lambda self, chain, values: values * ca.sign(chain.torques[self.joint_index]),
)
of_joint(
    "servo_error",
    "controller leaves the joint off its command: b + h s_j; positions follow what is read",
    each("bh", "rad", 5e-5, LEVER),  # typical: a count of an encoder of 17 bits, 4.8e-5 rad
    of_commands=True,
)
of_turning_joint(
    "joint_error_curve",
    "smooth error over the measured angles, as a table: a function of the joint's own angle, found by `diagnose`; "
    "zero beyond these",
    tabulated=True,
    # supplied by the model; its derivative with respect to the posture is neglected
    joint_angles=lambda self, chain, values: 0.0 if chain.errors is None else chain.errors[self.joint_index],
)

# -- less common ones --------------------------------------------------------------------------------------------------
of_time(
    "thermal_transient",
    "links grow exponentially while the arm warms up: l_j (1 + a (1 - exp(-(t + 1/2) / tau))), t = -0.5..0.5, one "
    "or all alike",
    # typical: aluminium that warms by 4 K
    [Number("a", "1", 1e-4, lambda self: self.link_length if self.joint else self.reach)],
    per_joint="optional",
    prior=RARE,
    # times to try, of a session: neighbors are alike to 0.98, beyond them drift or nothing
    settings={"tau": Setting(0.001, 10.0, (0.05, 0.1, 0.2, 0.4, 0.8))},
    extensions=lambda self, chain, values, lengths: (
        (lengths[self.joint_index] if self.joint else lengths)
        * values[0]
        * (1.0 - ca.exp(-(chain.time + 0.5) / self.chosen["tau"]))
    ),
)


def _after(effect: Effect, chain: ArmState) -> ca.SX:
    """1 after the step, 0 before."""
    return clock(chain.time, chain.session) > effect.chosen["at"]


def _beside(effect: Effect, chain: ArmState) -> ca.SX:
    """1 on one side of the step, of a later session in that alone, since each has a base of its own; 0 elsewhere."""
    at, session = effect.chosen["at"], chain.session
    there = ca.fmax(at <= 0.5, ca.fabs(at - clock(0.0, session)) <= 0.5)
    return there * (effect.chosen["side"] * (clock(chain.time, session) - at) > 0)


of_step = partial(of_time, prior=RARE, once=True, settings={"at": STEP})
of_step(
    "joint_step",
    "zero of a joint jumps at some time: b for t > at, as after a collision or a lost count; t = -0.5..0.5, in each "
    "further session 1.1 later",
    [Number("b", "rad", 2e-4, LEVER)],  # typical: a few encoder counts lost, or a light collision
    per_joint="required",
    joint_angles=lambda self, chain, values: values * _after(self, chain),
)
of_step(
    "link_step",
    "link is longer after remounting: d for t > at, as after it was taken off and mounted again",
    [Number("d", "mm", 0.1)],  # typical: a flange remounted without dowels
    per_joint="required",
    extensions=lambda self, chain, values, lengths: values * _after(self, chain),
)
of_step(
    "base_step",
    "base or instrument jumps at some time: + (x, y), in space + (x, y, z), on one side of a time",
    lambda self: each(self.chain.axes, "mm", 0.1),  # typical: as of `link_step`
    # side 1: for t > at, -1: for t < at; where the model has no `base_offset` that is not the same
    settings={"at": replace(STEP, values=Scope.step_times_within), "side": Setting(-1, 1, (-1.0, 1.0), whole=True)},
    base_translation=lambda self, chain, values: values * _beside(self, chain),
)
of_load(
    "payload_error",
    "payload is not what the file says: + d, for every effect of gravity",
    [Number("d", "kg", 0.5)],  # typical: cables and adapters that nobody weighed
    payload=lambda self, chain, values: values,
)
of_load(
    "payload_place",
    "payload hangs in another place than the file says (payload_at_mm): shifted by (x, y, z) in the frame of the tip",
    each("xyz", "mm", 50.0),  # typical: grippers are 100 mm long, targets sit on their rims
    family="payload_error",
    dimensions=SPACE,
    payload_shift=lambda self, chain, values: values,
)
of_load(
    "gravity_tilt",
    "base is tilted against gravity: turned by an angle, in space by two about x and y, for every effect of gravity",
    # typical: floors are level to some mm per m
    lambda self: each({1: ("angle",), 3: "xy"}[len(self.chain.turning)], "rad", 5e-3),
    gravity_turn=lambda self, chain, values: (  # about the vertical nothing
        ca.vertcat(values, ca.SX.zeros(len(self.chain.turning) - values.numel()))
    ),
)


def _leaning(effect: Effect, chain: ArmState, values: ca.SX) -> ca.SX:
    """(2 n,) displacements along and across each link: its length times real and imaginary part of
    (a + ib) exp(-2i angle), with the angle of the link against the one before the joint of the effect."""
    first = effect.joint_index
    angles, lengths = ca.vertsplit(ca.cumsum(chain.q[first:])), chain.lengths[first:].tolist()
    shifts = (length * _turned_back(values, 2.0 * angle) for length, angle in zip(lengths, angles, strict=True))
    return ca.vertcat(ca.SX.zeros(2 * first), *shifts)


# with s the vector from the joint to the tip and theta the orientation of the link before, in complex numbers:
# s + (a + ib) exp(2i theta) conj(s). A lean by alpha about the direction beta against that link has
# a + ib = alpha^2 exp(2i beta) / 4. In joint 1 that is `axes_skew`
of_joint(
    "axis_tilt",
    "axis is tilted out of the plane: everything beyond it is seen foreshortened",
    # typical: alpha^2 / 4 with alpha = 0.02 rad, bearings 1 mm out of line on 50 mm
    lambda self: each("ab", "1", 1e-4, float(np.sum(self.chain.lengths[self.joint_index :]))),
    first_joint=2,
    prior=RARE,
    dimensions=PLANE,  # in space the geometry has it
    joint_shifts=_leaning,
)


def _hysteresis_widths(scope: Scope) -> list[float]:
    """Widths to try [deg], from nearly backlash to nearly a wrong gear ratio, for the range of the joint."""
    angles = np.array([scope.arm.lower, scope.arm.upper]) if scope.postures is None else scope.postures
    span = float(np.degrees(np.ptp(angles[:, (scope.joint or 1) - 1])))  # of which the widths are shares
    return [share * span for share in (0.05, 0.08, 0.12, 0.18, 0.27, 0.4)] if span > 0.0 else [1.0]


def _wound_up(effect: Effect, chain: ArmState) -> ca.SX:
    """The wind-up grows by the motion divided by the width and stays within -1..1 (Prandtl's element); at the start of
    the session it is 0. It remembers earlier postures as long as no motion is wider than twice the width. A width of 0
    is `backlash`, one beyond the range of the joint `gear_ratio`."""
    past = [] if chain.past is None else ca.horzsplit(chain.past[effect.joint_index, :])
    wind_up, width = ca.SX(0), np.pi / 180.0 * effect.chosen["width_deg"]
    for before, now in pairwise([*past, chain.q[effect.joint_index]]):
        wind_up = ca.fmax(-1.0, ca.fmin(1.0, wind_up + (now - before) / width))
    return wind_up


of_turning_joint(
    "joint_hysteresis",
    "friction winds the gear up, with a memory of earlier motions: b times the wind-up, which follows the motion "
    "within -1..1",
    [Number("b", "rad", 1.5e-4, LEVER)],  # typical: as of `backlash`: catalogs give 1 arcmin, too
    needs=frozenset({"past"}),
    prior=RARE,
    settings={"width_deg": Setting(0.01, 1000.0, _hysteresis_widths)},
    joint_angles=lambda self, chain, values: values * _wound_up(self, chain),
)


# -- links and bearings ------------------------------------------------------------------------------------------------
def _bent(chain: ArmState, values: ca.SX, by_force: tuple[int, int], by_moment: tuple[int, int]) -> ca.SX:
    """(n,) flexibility times F L^a / b + M L^c / d for pairs (a, b), (c, d): of each link with its length L [m], the
    force F [N] to its left and the moment M [N m] at its tip. The link's own mass is not a load beyond it."""
    bends, last = [], chain.links - 1
    for j, length in enumerate((chain.lengths / 1000.0).tolist()):
        force = chain.weight(j + 1, j)[1]
        if j == last:  # the payload hangs on its tip, so it is beyond it; its moment there is 0
            force += chain.payload * ca.dot(chain.frames[j + 1].axes[:, 1], chain.acceleration)
        moment = chain.moment(j + 1)[2] if j < last else 0.0
        bends.append(force * length ** by_force[0] / by_force[1] + moment * length ** by_moment[0] / by_moment[1])
    return values * ca.vertcat(*bends)


of_gravity(  # Euler-Bernoulli: deflection F L^3 / 3EI + M L^2 / 2EI, slope F L^2 / 2EI + M L / EI
    "link_bending",
    "links bend under the loads beyond them: as cantilever beams of one stiffness EI",
    # typical: EI = 1e5 N m^2, an aluminium tube of 90 mm with walls of 6 mm
    # scale: one unit of 1/(EI) under some 100 N at the end of each link: L^3 / 3 [m^3] * 100 N * 1000 mm/m
    [Number("flexibility", "1/(N m^2)", 1e-5, lambda self: np.sum(self.chain.lengths**3) / 3e4, 0.0)],
    dimensions=PLANE,
    # of the link's end to its left
    joint_shifts=lambda self, chain, values: 1000.0 * ca.kron(_bent(chain, values, (3, 3), (2, 2)), ca.DM([0.0, 1.0])),
    # of the next joint's frame; what is measured is a point at the end of the last link
    joint_turns=lambda self, chain, values: ca.vertcat(0.0, _bent(chain, values, (2, 2), (1, 1))[:-1]),
)
add_effect(
    "thermal_growth",
    "links grow with temperature: l_j (1 + a (T - T_mean))",
    [Number("a", "1/K", 2e-5, REACH)],  # typical: steel 12e-6, aluminium 23e-6
    needs=frozenset({"temperature"}),
    extensions=lambda self, chain, values, lengths: lengths * values[0] * chain.temperature,
)


def _axis_of(effect: Effect) -> Array:
    """(3,) of the effect's joint in its own frame."""
    return effect.chain.joints[effect.joint_index].axis


of_gravity(
    "bearing_compliance",
    "bearing tilts across its axis under gravity: by c M, M the moment of gravity across the axis, c >= 0",
    # typical: output bearings of strain-wave gears, 4e4 to 4e6 N m/rad across the axis
    [Number("c", "rad/(N m)", 3e-6, lambda self: self.link_length * TORQUE, 0.0)],
    per_joint="required",
    dimensions=SPACE,
    joint_turns=lambda self, chain, values: (
        values[0]
        * ca.mtimes(ca.DM(np.eye(3) - np.outer(_axis_of(self), _axis_of(self))), chain.moment(self.joint_index))
    ),
)
# in complex numbers x + iy in the frame before the joint moves, z along the axis. A shift by (a + ib) exp(+i q_j) turns
# with the link and is an error of its geometry; every runout once per turn is a sum of the two
of_turning_joint(
    "axis_runout",
    "axis runs out of true once per turn: shifted by (a + ib) exp(-i q_j) across itself",
    each("ab", "mm", 3e-3),  # typical: runout of such bearings 5 to 15 um from peak to peak
    prior=RARE,
    dimensions=SPACE,
    joint_shifts=lambda self, chain, values: ca.mtimes(  # in the frame that has turned
        ca.DM(rotation_to_z(_axis_of(self))[:, :2]), _turned_back(values, 2.0 * chain.q[self.joint_index])
    ),
)

# -- base and instrument -----------------------------------------------------------------------------------------------
add_effect(
    "base_offset",
    "base not at the origin of the measurements: + (x0, y0)",
    each(("x0", "y0"), "mm", 1.0),  # typical: a base set up with dowels or by touching off
    of_positions=True,
    dimensions=PLANE,  # in space the base is part of the geometry
    base_translation=lambda self, chain, values: values,
)
of_time(
    "base_drift",
    "base or instrument creeps during the session: + (vx, vy) t, t = -0.5..0.5; in space + (vx, vy, vz) t",
    # typical: creep of tripods, floors and warming frames in an hour or two
    lambda self: each([f"v{axis}" for axis in self.chain.axes], "mm/session", 0.05),
    once=True,
    base_translation=lambda self, chain, values: values * chain.time,
)
of_time(
    "base_rotation_drift",
    "base or instrument turns during the session: by w t, t = -0.5..0.5; in space by (wx, wy, wz) t",
    lambda self: each(self.chain.turn_names, "rad/session", 5e-5, REACH),  # typical: as of `base_drift`, at 1 m
    once=True,
    base_rotation=lambda self, chain, values: values * chain.time,
)


def _of_session(effect: Effect, chain: ArmState, values: ca.SX) -> ca.SX:
    """(d + r,) shift and rotation of the row's session, zero for the first."""
    in_session = ca.vertcat(*(chain.session == number for number in range(1, int(effect.chosen["sessions"]))))
    return ca.mtimes(ca.reshape(values, -1, in_session.numel()), in_session)


# nothing physical is missing: arm or instrument was set up again. `identify` and `diagnose` add it by themselves where
# the data name sessions, and leave it out of what they write
add_effect(
    "session_base",
    "arm or instrument set up again for each session: after the first + (x, y), rotation by w, relative to that",
    # typical: arm or instrument anywhere in the cell, turned by any angle
    lambda self: [
        number._replace(short=f"{number.short}{session}")
        for session in range(2, int(self.chosen["sessions"]) + 1)
        for number in each(self.chain.axes, "mm", 1000.0) + each(self.chain.turn_names, "rad", 3.0, REACH)
    ],
    needs=frozenset({"session"}),
    settings={"sessions": Setting(2, 99, whole=True, symbolic=False)},
    nuisance=True,
    base_rotation=lambda self, chain, values: _of_session(self, chain, values)[chain.geometry.dimension :],
    base_translation=lambda self, chain, values: _of_session(self, chain, values)[: chain.geometry.dimension],
)
add_effect(
    "axes_skew",
    "instrument axes of unequal scale or not square: p + (a + ib) conj(p), p = x + iy",
    each("ab", "1", 5e-5, REACH),  # typical: laser trackers 1e-5, cameras 1e-4 of the distance
    of_positions=True,
    dimensions=PLANE,
    instrument=lambda self, p, values: ca.vertcat(
        values[0] * p[0] + values[1] * p[1], values[1] * p[0] - values[0] * p[1]
    ),
)
add_effect(
    "length_offset",
    "all distances too long by the same amount: + c, the zero of a draw wire, the reference length of a ball bar",
    [Number("c", "mm", 0.5)],  # typical: wires are zeroed by hand, bars measured between rims
    needs=frozenset({"distance"}),
    dimensions=SPACE,
    instrument=lambda self, p, values: values[0] * p / distance_to_center(p),  # the center is the origin
)
add_effect(
    "measurement_scale",
    "instrument scale is wrong: p (1 + s)",
    [Number("s", "1", 5e-5, REACH)],  # typical: as of `axes_skew`
    alias="a common factor of all link lengths, where no joint slides",
    prior=RARE,
    instrument=lambda self, p, values: values[0] * p,
)
add_effect(
    "tool_offset",
    "target not at the tip: (x, y) in the frame of the last link",
    each("xy", "mm", 1.0),  # typical: adapter of a target, not measured
    alias="the length and the joint offset of the last link",
    dimensions=PLANE,  # in space the tool is part of the geometry
    tool=lambda self, chain, values: values,
)
add_effect(
    "base_rotation",
    "base rotated against the measurements: by an angle",
    [Number("angle", "rad", 1e-3, lambda self: self.chain.levers[0])],  # typical: as `base_offset`, 1 mm at 1 m
    alias="the offset of joint 1",
    dimensions=PLANE,  # in space the base is part of the geometry
    base_rotation=lambda self, chain, values: values,
)


# -- the noise, not the mean: `simulate` applies these, `diagnose` screens for them, models ignore them ----------------
# each has a method `disturb`, which transforms the (m, d) errors of the measured positions [mm], in the order of the
# arm file; values : of its parameters as given in the arm file, else 0; nothing is estimated
of_noise = partial(add_effect, scatter=True)


class Scene(NamedTuple):
    """Quantities on which noise may depend, for m measured postures."""

    positions: Array  # (m, 2 or 3) exact [mm]
    levers: Array  # (m, d, n) derivative of the tip by each joint angle [mm/rad]
    time: Array  # (m,) -0.5..0.5 over the session
    sigma: float  # of the instrument [mm]
    generator: np.random.Generator


def _far_off(self: Effect, errors: Array, scene: Scene, values: Sequence[float]) -> Array:
    """A share of the rows in directions uniform over all; of lengths longer or shorter."""
    (share, size), draw = values, scene.generator
    count = round(share * len(errors))
    rows = draw.choice(len(errors), count, replace=False)
    width = min(self.chain.dimension, errors.shape[1])  # a length is one number
    drawn, changed = draw.standard_normal((count, width)), errors.copy()
    changed[rows, :width] += size * scene.sigma * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return changed


def _correlated(self: Effect, errors: Array, scene: Scene, values: Sequence[float]) -> Array:
    """Each row with a part of the one before."""
    (rho,), changed = values, errors.copy()
    for i in range(1, len(errors)):
        changed[i] = rho * changed[i - 1] + np.sqrt(1.0 - rho**2) * errors[i]
    return changed


of_noise(
    "joint_noise",
    "joint does not come to rest at the same angle: the tip scatters along the joint's lever",
    [Number("std", "rad", 5e-5, LEVER, 0.0)],  # typical: repeatability of 0.05 mm at 1 m (ISO 9283)
    per_joint="required",
    disturb=lambda self, errors, scene, values: (
        errors
        + scene.levers[:, :, self.joint_index] * values[0] * scene.generator.standard_normal(len(errors))[:, None]
    ),
)
of_noise(
    "reach_noise",
    "scatter grows with the distance from the base: errors times sqrt(1 + (g |p| / reach)^2)",
    # typical: error half constant, half proportional to the distance: sqrt(2) at full reach
    [Number("g", "1", 1.0, lower=0.0)],
    disturb=lambda self, errors, scene, values: (
        errors * np.hypot(1.0, values[0] * np.linalg.norm(scene.positions, axis=1) / self.reach)[:, None]
    ),
)
of_noise(
    "time_noise",
    "scatter changes during the session: errors times exp(g t)",
    [Number("g", "1", 0.5)],  # typical: scatter changes by exp(0.5) = 1.6 over the session
    disturb=lambda self, errors, scene, values: errors * np.exp(values[0] * scene.time)[:, None],
)
of_noise(
    "outliers",
    "some rows are far off: a share of them, drawn at random, by `size` standard deviations of the instrument in a "
    "random direction; not of orientations",
    # typical: arm not at rest, target turned away; well beyond the scatter, as a broken beam is
    [Number("share", "1", 0.02, lower=0.0, upper=1.0), Number("size", "1", 10.0, lower=0.0)],
    disturb=_far_off,
)
of_noise(
    "serial_correlation",
    "serially correlated errors: e_i = rho e_(i-1) + sqrt(1 - rho^2) new, of the same size as without",
    # typical: air and temperature change over minutes, rows follow faster
    [Number("rho", "1", 0.5, lower=-0.99, upper=0.99)],
    disturb=_correlated,
)
