"""`Effect`: base class of all physical effects, with a name, parameters with units, and a formula at its place.

    commanded joint angle -> real joint angle -> links -> position in the base -> measured position

An effect is a class with a table of parameters and, by the names of their places, formulas of what it adds there, which
identification/effects/chain.py adds up. `add_effect` makes the library's own; a user's is a class under `register`.

Settings of effects are numbers that are chosen rather than estimated, and the values that a scan tries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.error_curve import ErrorCurve
from identification.errors import InputError
from identification.kinematics.chain import KinematicChain
from identification.kinematics.parameters import PRISMATIC, Parameter
from identification.measurements import Conditions

SESSION = 1.1  # from one session to the next on the clock of steps, a gap of 0.1 between them


@dataclass(frozen=True)
class Scope:
    """Information from which the values of a setting may be computed: the arm, the joint (from 1), and the data."""

    arm: Arm
    joint: int | None = None
    postures: Array | None = None  # (m, n) [rad], None without data
    conditions: Conditions = field(default_factory=Conditions)  # of these rows

    def step_times(self) -> list[float]:
        """Times to try for a step: between rows, evenly spaced, and between sessions."""
        time = self.conditions.time
        if time is None or np.ptp(time) == 0.0:
            return list(np.linspace(-0.5, 0.5, 40)[2:-2])
        sessions = np.zeros(len(time)) if self.conditions.session is None else self.conditions.session
        values = np.unique(clock(time, sessions))
        between = 0.5 * (values[1:] + values[:-1])
        first = int(np.ceil(0.05 * len(between)))  # at either end a step would be a few rows
        inner = between[first : len(between) - first] if 2 * first < len(between) else between
        count = 100 if len(between) <= 400 else 40  # effort: of many rows fewer
        spread = inner[np.unique(np.linspace(0, len(inner) - 1, count).round().astype(int))]
        return [*spread, *((np.unique(sessions)[1:] - 0.5) * SESSION)]


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
    """Common time of all sessions: -0.5 to 0.5 in the first, 1.1 later in each further one.

    time, session : numbers, arrays or CasADi symbols
    """
    return time + SESSION * session


class Number(NamedTuple):
    """A parameter in the declaration of an effect, see `Parameter`.

    scale : [mm] that one unit moves the tip by, in order of magnitude, or the function of the effect that says it
    """

    short: str
    unit: str
    typical: float | None
    scale: float | Callable[[Any], float] = 1.0
    lower: float = -inf
    upper: float = inf


def at_joint(chain: KinematicChain, joint: int, unit: str, scale: float) -> tuple[str, float]:
    """Unit and scale of what is added to the position of a joint (from 1), as of one that turns: sliding ones have
    lengths for angles and forces for torques."""
    slides = chain.joints[joint - 1].type == PRISMATIC and unit in SLIDING
    return (SLIDING[unit], scale / float(chain.levers[joint - 1])) if slides else (unit, scale)


SLIDING = {"rad": "mm", "rad/(N m)": "mm/N"}
LEVER, REACH = attrgetter("link_length"), attrgetter("reach")  # scales of numbers


class Effect:
    """Base class of all effects. Subclasses set the class variables, list the parameters, and have methods with the
    names of places.

    An instance has the nominal `chain`, its `joint` (from 1, None: the whole arm), the values `chosen` of its settings,
    its `parameters`, and is `tagged` where their names have the settings in them, `transmission_ripple:1[k=20].a`, as
    the arm has a similar effect at the same joint (`build_all`).

    Places, each a method of the symbols of the nominal arm (`Chain`) and the values of the parameters that returns
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

    def __init_subclass__(cls) -> None:
        cls.family = cls.family or getattr(cls, "name", "")

    def __init__(
        self,
        chain: KinematicChain,
        joint: int | None = None,
        chosen: Mapping[str, Any] | None = None,
        tagged: bool = False,
    ) -> None:
        self.chain = chain
        self.joint = joint
        self.chosen = dict(chosen or {})
        self.tagged = tagged
        self.place = self.name if joint is None else f"{self.name}:{joint}"
        self.key = self.label if tagged else self.place  # in reports
        self.parameters: tuple[Parameter, ...] = self.define()

    def define(self) -> tuple[Parameter, ...]:
        """The parameters, in the order in which the formulas receive their values."""
        parameters = []
        for number in self.numbers() if callable(self.numbers) else self.numbers:
            scale = number.scale(self) if callable(number.scale) else number.scale
            parameters.append(self.parameter(**number._replace(scale=float(scale))._asdict()))
        return tuple(parameters)

    def parameter(self, short: str, unit: str, *, scale: float, **more: float | None) -> Parameter:
        """A parameter of this effect under its full name;  scale, more : as of `Parameter`"""
        if self.joint is not None and hasattr(self, "joint_angles"):
            unit, scale = at_joint(self.chain, self.joint, unit, scale)
        return Parameter(f"{self.key}.{short}", unit, scale=scale, joint=self.joint, **more)  # type: ignore[arg-type]

    @cached_property
    def label(self) -> str:
        """Unique name from name, joint and settings: `transmission_ripple:2[k=6]`."""
        settings = ";".join(f"{name}={value:g}" for name, value in self.chosen.items())
        return self.place + (f"[{settings}]" if settings else "")

    @property
    def joint_index(self) -> int:
        """The joint from 0, as an index of arrays. Raises `InputError` for an effect of the whole arm."""
        if self.joint is None:
            raise InputError(f"effects: {self.name} needs a joint, allowed: 1 to {len(self.chain)}")
        return self.joint - 1


_LIBRARY: dict[str, type[Effect]] = {}
OWN = "identification.effects"


def register(cls: type[Effect]) -> type[Effect]:
    """Class decorator that adds an effect to the library under its name.

    A user's own class may be defined again, as in notebooks. Raises `InputError` for a name that the library uses.
    """
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
