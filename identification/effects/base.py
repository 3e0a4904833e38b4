"""`Effect`: base class of all physical effects, with a name, parameters with units, and a formula at its place; and
`ArmState`: the nominal arm at one posture in CasADi symbols, on which formulas may depend.

    loads -> commanded joint angle -> real joint angle -> links -> tool -> position in the base -> measured position

An effect is a class with a table of parameters and, by the names of their places, formulas of what it adds there.
`add_effect` makes the library's own; a user's is a class under `register`. Settings of effects are numbers that are
chosen rather than estimated, and the values that a scan tries.

A contribution acts on the tip through the lever of its place, the derivative of the position with respect to what is
added there. Levers depend on the fitted model only, so they serve all effects that might be missing.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from math import inf
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import casadi as ca
import numpy as np

from identification.arm import Arm, EffectSpec, ErrorCurve, Gravity
from identification.arrays import Array, slices
from identification.errors import InputError
from identification.kinematics.chain import NOTHING, KinematicChain, in_space
from identification.kinematics.frames import Frame
from identification.kinematics.parameters import LENGTH_ERROR, PRISMATIC, REVOLUTE, Parameter
from identification.measurements import REMEMBERED, Conditions

OF_LOAD = ("payload", "gravity_turn", "payload_shift")  # places that are also of `ArmState`
BY_JOINT = ("joint_angles", "extensions", "joint_turns", "joint_shifts")
SESSION = 1.1  # from one session to the next on the clock of steps, a gap of 0.1 between them


@dataclass(frozen=True)
class Scope:
    """Information from which the values of a setting may be computed: the arm, the joint (from 1), and the data."""

    arm: Arm
    joint: int | None = None
    postures: Array | None = None  # (m, n) [rad], None without data
    conditions: Conditions = field(default_factory=Conditions)  # of these rows

    def other_joints(self) -> list[float]:
        """Those that turn, but for its own."""
        joints = enumerate(self.arm.chain.joints, start=1)
        return [float(j) for j, joint in joints if j != self.joint and joint.type != PRISMATIC]

    def step_times(self) -> list[float]:
        """Times to try for a step: between postures, evenly spaced, and between sessions; not where all cups or other
        targets of the instrument are changed: a step there is where they stand, in place of their known distance."""
        time = self.conditions.time
        if time is None or self.postures is None or np.ptp(time) == 0.0:
            return list(np.linspace(-0.5, 0.5, 40)[2:-2])
        sessions = np.zeros(len(time)) if self.conditions.session is None else self.conditions.session
        clocks = clock(time, sessions)
        values, firsts = np.unique(clocks, return_index=True)
        moved = np.any(np.diff(self.postures[firsts], axis=0) != 0.0, axis=1)
        between = np.round(0.5 * (values[1:] + values[:-1])[moved | ~moved.any()], 9) + 0.0
        first = int(np.ceil(0.05 * len(between)))  # at either end a step would be a few rows
        inner = between[first : len(between) - first] if 2 * first < len(between) else between
        count = 100 if len(between) <= 400 else 40  # effort: of many rows fewer
        spread = inner[np.unique(np.linspace(0, len(inner) - 1, count).round().astype(int))]
        if (marker := self.conditions.marker) is not None and self.arm.chain.instrument.targets:
            spread = [at for at in spread if np.intersect1d(marker[clocks < at], marker[clocks > at]).size]
        return [*spread, *((np.unique(sessions)[1:] - 0.5) * SESSION)]

    def step_times_within(self) -> list[float]:
        """Those within sessions: between them each has a base of its own."""
        return [at for at in self.step_times() if abs(at - SESSION * round(at / SESSION)) <= 0.5]


@dataclass(frozen=True)
class Setting:
    """A number that is chosen rather than estimated: the order of a wave, the time of a step, a time constant."""

    low: float  # range allowed in an arm file
    high: float
    # to try in `diagnose`, a list or a function of `Scope`; None: all whole numbers from low to high
    values: Sequence[float] | Callable[[Scope], Sequence[float]] | None = None
    whole: bool = False  # whole numbers only
    symbolic: bool = True  # the formula accepts a CasADi symbol, which serves all values; else as in `range(k)`

    def scan(self, scope: Scope) -> list[float]:
        """The distinct values to try, ascending, rounded to the six digits that labels and files hold."""
        if self.values is None:
            return [float(k) for k in range(int(self.low), int(self.high) + 1)]
        values = self.values(scope) if callable(self.values) else self.values
        return sorted({float(f"{value:.6g}") for value in values if self.allows(value)})

    def allows(self, value: float) -> bool:
        """Whether this value is allowed in an arm file."""
        return self.low <= value <= self.high and not (self.whole and value != np.round(value))

    @property
    def allowed(self) -> str:
        """The allowed range in words, for error messages."""
        return f"a {'whole ' if self.whole else ''}number {self.low:g} to {self.high:g}"


def clock(time: Any, session: Any) -> Any:
    """Common time of all sessions, in numbers, arrays or symbols: -0.5 to 0.5 in the first, 1.1 later in each further
    one."""
    return time + SESSION * session


class Number(NamedTuple):
    """A parameter in the declaration of an effect, see `Parameter`;  scale : [mm] that one unit moves the tip by, in
    order of magnitude, or the function of the effect that says it"""

    short: str
    unit: str
    typical: float | None
    scale: float | Callable[[Any], float] = 1.0
    lower: float = -inf
    upper: float = inf


LEVER, REACH = attrgetter("link_length"), attrgetter("reach")  # scales of numbers


class Effect:
    """Base class of all effects. Subclasses set the class variables, list the parameters, and have methods with the
    names of places.

    An instance has the nominal `chain`, its `joint` (from 1, None: the whole arm), the values `chosen` of its settings,
    its `parameters`, and is `tagged` where their names have the settings in them, `transmission_ripple:1[k=20].a`, as
    the arm has a similar effect at the same joint (`build_all`).

    Places, each a method of the symbols of the nominal arm (`ArmState`) and the values of the parameters that returns
    CasADi SX of this many elements, or a number for all of them. Where n joints or 3 n coordinates are asked for, an
    effect of one joint may return its own.

    payload : added to the payload [kg], for all effects of gravity
    gravity_turn : rotation of gravity [rad], in space (3,) about the axes of the base, for all effects of gravity
    payload_shift : in space (3,) added to the place of the payload in the tip's frame [mm]
    joint_angles : (n,) added to the commanded joint angles [rad]
    extensions : (n,) added to the link lengths [mm], a third argument
    joint_turns, joint_shifts : rotations [rad] and translations [mm] of each joint's frame after its motion, in space
        (3 n,) about and then along its own x, y, z, in the plane (n,) about z and (2 n,) along x and y, the link's left
    tool : (d,) offset of the measured point in the frame of the last link [mm]
    base_rotation : rotation of the arm about its base [rad], in space (3,) about its x, y, z
    base_translation : (d,) translation of the base [mm]
    instrument : (d,) added to the true position [mm], which it has in place of the chain
    """

    name: ClassVar[str]  # as in the arm file
    summary: ClassVar[str]  # one line for people
    numbers: ClassVar[Any] = ()  # the parameters, in the order in which formulas receive their values, or a method
    per_joint: ClassVar[str] = "none"  # `required`, `optional` or `none`: whether it is given for a single joint
    first_joint: ClassVar[int] = 1  # lowest joint (from 1) that can have it
    of_angle: ClassVar[bool] = False  # a function of an angle, which sliding joints have not
    # of arm or data: gravity, distance (measured ones), directions, temperature, time, session, past
    needs: ClassVar[frozenset[str]] = frozenset()
    family: ClassVar[str] = ""  # rivals for the same physical cause, which `diagnose` may merge; its name by default
    through: ClassVar[str] = ""  # kind of effects that it modifies, by what they need; without these it does nothing
    # numbers that are chosen, not estimated. In formulas `self.chosen[name]` is the number, or a CasADi symbol when all
    # values are tried at once
    settings: ClassVar[Mapping[str, Setting]] = MappingProxyType({})
    prior: ClassVar[float] = 1.0  # weight relative to the common effects of the library, which have 1
    alias: ClassVar[str | None] = None  # base parameters from which no measurement of the tip can distinguish it
    nuisance: ClassVar[bool] = False  # it is no fault of the arm, so that `diagnose` does not search for it
    of_commands: ClassVar[bool] = False  # between command and encoder reading: models of the readings ignore it
    scatter: ClassVar[bool] = False  # it acts on the noise (`disturb`): the model of the mean ignores it
    once: ClassVar[bool] = False  # of the session of the identification; in later ones its final state applies
    of_positions: ClassVar[bool] = False  # of the frame in which positions are measured: not of other instruments
    unlisted: ClassVar[bool] = False  # of any form, at a place: `diagnose` writes it, and never names it
    tabulated: ClassVar[bool] = False  # a table of values (`EffectSpec.curve`) without parameters
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)  # of the arms that can have it: 2 in the plane, 3 in space
    disturb: ClassVar[Callable[..., Array]]
    reach = property(attrgetter("chain.reach"))  # of the stretched arm [mm]
    # over which its joint acts [mm]: in the plane of the link behind it
    link_length = property(lambda self: float(self.chain.levers[self.joint_index]))
    curve: ErrorCurve | None = None
    fixed: Mapping[str, float] = MappingProxyType({})  # values of parameters that stay as they are (`EffectSpec`)
    spec = property(lambda self: EffectSpec(self.name, self.joint, self.fixed, self.curve))  # its entry in an arm file

    def __init_subclass__(cls) -> None:
        cls.family = cls.family or getattr(cls, "name", "")

    def __init__(
        self, chain: KinematicChain, joint: int | None = None, chosen: Mapping[str, Any] = NOTHING, tagged: bool = False
    ) -> None:
        self.chain, self.joint, self.chosen, self.tagged = chain, joint, dict(chosen), tagged
        self.key = self.label if tagged else self.spec.key  # in reports
        self.parameters: tuple[Parameter, ...] = self.define()

    def define(self) -> tuple[Parameter, ...]:
        """The parameters, in the order in which the formulas receive their values."""
        parameters = list[Parameter]()
        for number in self.numbers() if callable(self.numbers) else self.numbers:
            scale = float(number.scale(self) if callable(number.scale) else number.scale)
            parameters.append(self.parameter(**number._replace(scale=scale)._asdict()))
        return tuple(parameters)

    def parameter(self, short: str, unit: str, *, scale: float, typical: float | None = None, **more: Any) -> Parameter:
        """A parameter of this effect under its full name;  scale, typical, more : as of `Parameter`"""
        if self.joint is not None and hasattr(self, "joint_angles"):
            unit, many = self.chain.unit_at(self.joint, unit)
            scale, typical = scale / many, typical and typical * many
        return Parameter(f"{self.key}.{short}", unit, scale=scale, typical=typical, joint=self.joint, **more)

    @cached_property
    def label(self) -> str:
        """Unique name from name, joint and settings: `transmission_ripple:2[k=6]`."""
        settings = ";".join(f"{name}={value:g}" for name, value in self.chosen.items())
        return self.spec.key + (f"[{settings}]" if settings else "")

    @property
    def joint_index(self) -> int:
        """The joint from 0, as an index of arrays. Raises `InputError` for an effect of the whole arm."""
        if self.joint is None:
            raise InputError(f"effects: {self.name} needs a joint, allowed: 1 to {len(self.chain)}")
        return self.joint - 1


_LIBRARY: dict[str, type[Effect]] = {}
OWN = "identification.effects"


def register(cls: type[Effect]) -> type[Effect]:
    """Class decorator that adds an effect to the library under its name; a user's own class may be defined again, as in
    notebooks. Raises `InputError` for a name that the library uses."""
    taken = _LIBRARY.get(cls.name)
    if taken is not None and taken.__module__.startswith(OWN) and not cls.__module__.startswith(OWN):
        raise InputError(f"effect: the name {cls.name!r} is taken by the library, allowed: another name")
    _LIBRARY[cls.name] = cls
    return cls


def add_effect(name: str, about: str, numbers: Any = (), **members: Any) -> type[Effect]:
    """Make an effect and add it to the library.

    about : its summary: what it adds, for people;  numbers : its parameters, or a function that lists them
    members : further class variables of `Effect`, and by its place the formula of what it adds there
    """
    summary, _, formula = about.partition(": ")
    members |= {"name": name, "summary": summary, "numbers": numbers, "__doc__": formula, "__module__": OWN}
    return register(type(name, (Effect,), members))


# -- the arm that effects act on ---------------------------------------------------------------------------------------
@dataclass(frozen=True)
class ArmState:
    """Symbols of an arm at one posture, for effects to use: CasADi SX, lengths in mm, angles in rad."""

    geometry: KinematicChain
    gravity: Gravity | None
    q: ca.SX  # (n,) commanded joint angles [rad]
    gravity_turn: ca.SX  # [rad] about the axes of the base that a frame may turn about
    payload_shift: ca.SX  # (d,) of the payload from where the file says [mm], in the tip's frame
    payload: ca.SX  # [kg]
    temperature: ca.SX  # [K] above the mean
    time: ca.SX  # -0.5..0.5 over the session
    session: ca.SX  # number of the session, from 0
    directions: ca.SX  # (n,) +1 or -1
    past: ca.SX | None = None  # (n, 12) turning points before (`past_from_order`) [rad], None: the posture itself
    marker: ca.SX | None = None  # number of the measured point, from 0
    orientation: ca.SX | None = None  # (9,) to compare with, by rows, None: none is measured
    errors: ca.SX | None = None  # (n,) values of error curves at this posture [rad], None: there are none
    off: ca.SX | None = None  # the share of their geometry that does not hold

    @classmethod
    def of(cls, arm: Arm, q: ca.SX, c: ca.SX, columns: Mapping[str, slice]) -> Self:
        """An arm at a posture q (n) under conditions c in these columns (`condition_columns`)."""
        at = {name: c[place] for name, place in columns.items()}
        if "past" in at:
            at["past"] = ca.reshape(at["past"], REMEMBERED, arm.links).T
        return cls(arm.chain, arm.gravity, q, ca.SX.zeros(len(arm.chain.turning)), ca.SX.zeros(arm.dimension), **at)

    # (n,) the posture before [rad]; in the first row the posture itself
    previous = property(lambda self: self.q if self.past is None else self.past[:, -1])
    links = property(lambda self: len(self.geometry))  # n, the number of links
    lengths = property(attrgetter("geometry.lengths"))  # (n,) of the links, nominal [mm]

    @cached_property
    def frames(self) -> list[Frame]:
        """n + 2 nominal frames of base, joints and tip in the frame of the base [mm]."""
        return replace(self.geometry, base=np.eye(4)).frames(self.q, {})

    @property
    def required_gravity(self) -> Gravity:
        """The arm's gravity data. Raises `InputError` if there are none."""
        if self.gravity is None:
            needs = "this effect needs gravity torques, add a [gravity] table to the arm file, allowed: with one"
            raise InputError(f"gravity: {needs}")
        return self.gravity

    @cached_property
    def acceleration(self) -> ca.SX:
        """(3,) acceleration of gravity [m/s^2] in the frame of the base, rotated by `gravity_turn`."""
        gravity = in_space(ca.SX(ca.DM(self.required_gravity.acceleration)))
        if self.gravity_turn.is_zero():
            return gravity
        return ca.mtimes(Frame.world().turned_about(self.geometry.turning, self.gravity_turn).axes, gravity)

    @cached_property
    def loads(self) -> list[tuple[ca.SX, int, ca.SX]]:
        """(mass [kg], link, place (3,) [mm]) of every mass: of a link where the file says, in its joint's frame, or as
        a share of the line to the next; the payload where the file says, else at the first measured point."""
        gravity, chain = self.required_gravity, self.geometry
        at = ca.SX(ca.DM(next(iter(chain.tools.values()))[:3, 3] if gravity.payload_at is None else gravity.payload_at))
        masses = [(self.payload, self.links - 1, self.frames[-1].point(at + in_space(self.payload_shift)))]
        centers = gravity.center_of_mass
        if centers.ndim == 1:
            centers = centers[:, None] * np.array([pose[:3, 3] for pose in chain.link_poses[1:]])
        for k, (mass, center) in enumerate(zip(gravity.link_masses, centers, strict=True)):
            masses.append((ca.SX(mass), k, self.frames[k + 1].point(ca.SX(ca.DM(center)))))
        return masses

    @cached_property
    def torques(self) -> ca.SX:
        """(n,) gravity torques about revolute joints [N m], forces along prismatic ones [N] (identification/README.md,
        "Effects")."""
        joints = enumerate(self.geometry.joints)
        loads = ((joint, self.moment(j) if joint.type == REVOLUTE else self.weight(j, j)) for j, joint in joints)
        return ca.vertcat(*(ca.dot(ca.DM(joint.axis), load) for joint, load in loads))

    def moment(self, joint: int) -> ca.SX:
        """(3,) moment [N m] of all loads beyond a joint, from 0, about the origin of its frame, in the frame's axes."""
        frame = self.frames[joint + 1]
        arms = [mass * (place - frame.origin) / 1000.0 for mass, k, place in self.loads if k >= joint]
        return ca.mtimes(frame.axes.T, ca.cross(sum(arms, ca.SX.zeros(3)), self.acceleration))

    def weight(self, beyond: int, joint: int) -> ca.SX:
        """(3,) force [N] of all loads on links >= `beyond`, from 0, in the axes of a joint's frame."""
        mass = sum((mass for mass, k, _ in self.loads if k >= beyond), ca.SX(0))
        return ca.mtimes(self.frames[joint + 1].axes.T, mass * self.acceleration)


# -- what they add -----------------------------------------------------------------------------------------------------
def widths(chain: KinematicChain) -> dict[str, int]:
    """Place -> its number of elements, in the order of vectors over all places."""
    n, d, turns = len(chain), chain.dimension, len(chain.turning)
    loads = dict(zip(OF_LOAD, (1, turns, d), strict=True))
    joints = {"joint_angles": n, "extensions": n, "joint_turns": turns * n, "joint_shifts": d * n}
    return {**loads, **joints, "tool": d, "base_rotation": turns, "base_translation": d, "instrument": d}


def position_and_state(
    chain: ArmState, effects: Sequence[Effect], values: ca.SX, added: ca.SX | None = None
) -> tuple[ca.SX, ca.SX]:
    """(d,) measured position [mm] (identification/README.md, "Effects"), with three further elements where orientations
    are measured, see `Model.symbols`; and the state on which effects depend besides posture and conditions: payload
    [kg], rotation of gravity [rad], in space shift of the payload [mm], link lengths (n) [mm] without extensions, and
    the tip (d) [mm] before the instrument.

    values : those of the geometry, then the parameters of the effects in order
    added : further contributions at all places, in the order of `widths`
    """
    drawn, sizes = chain.geometry, widths(chain.geometry)
    counts = [len(effect.parameters) for effect in effects]
    geometry, *parts = ca.vertsplit(values, [*accumulate([0, values.numel() - sum(counts), *counts])])
    added = ca.SX.zeros(sum(sizes.values())) if added is None else added
    additions = {place: added[where] for place, where in slices(sizes).items()}

    def add(places: Collection[str], chain: ArmState, lengths: ca.SX | None = None, tip: ca.SX | None = None) -> None:
        for effect, part in zip(effects, parts, strict=True):
            for place in (place for place in places if hasattr(effect, place)):
                additions[place] += contribution(effect, place, chain, part, lengths, tip)

    add(OF_LOAD, chain)
    additions["payload"] += chain.payload
    loads: dict[str, Any] = {place: additions[place] for place in OF_LOAD}
    named = dict(zip(drawn.parameters().names, ca.vertsplit(geometry), strict=True))
    errors = (named.get(f"{LENGTH_ERROR}:{j}", 0.0) for j in range(1, len(drawn) + 1))
    lengths = ca.DM(drawn.lengths) + ca.vertcat(*errors)
    add([place for place in sizes if place not in (*OF_LOAD, "instrument")], replace(chain, **loads), lengths)
    tip, turned = drawn.tip(chain.q + additions["joint_angles"], named, additions, chain.marker, chain.orientation)
    add(["instrument"], chain, tip=tip)
    settings = ca.vertcat(ca.SX(0, 1), *(named[p.name] for p in drawn.instrument.parameters))
    target = ca.vertcat(chain.session, 0.0 if chain.marker is None else chain.marker)
    reading = drawn.instrument.reading(tip + additions["instrument"], settings, target)
    return ca.vertcat(reading, turned), ca.vertcat(*loads.values(), lengths, tip)


def contribution(
    effect: Effect, place: str, chain: ArmState, values: ca.SX, lengths: ca.SX | None = None, tip: ca.SX | None = None
) -> ca.SX:
    """What an effect adds at a place at which it has a formula, for all elements of the place."""
    size = widths(effect.chain)[place]
    lengthened = (lengths,) if place == "extensions" else ()
    value = ca.SX(getattr(effect, place)(tip if place == "instrument" else chain, values, *lengthened))
    if effect.unlisted and effect.joint and chain.off is not None:
        value *= 1.0 - chain.off  # nothing says that what was fitted beside error curves holds beyond them
    values, one = ca.SX.zeros(size), value.numel()
    if effect.joint is None or place not in BY_JOINT or one * len(effect.chain) != size:
        return values + value
    values[one * effect.joint_index : one * (effect.joint_index + 1)] = value
    return values
