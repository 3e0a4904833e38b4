"""`Effect`: base class of all physical effects, with a name, parameters with units, and a formula at its place.

    commanded joint angle -> real joint angle -> links -> position in the base -> measured position

An effect overrides the hook of its place, or several; `measured_position` (effects/places.py) adds up what the hooks
return. A new effect is one class: see `register`.

Settings of effects are numbers that are chosen rather than estimated, and the values that a scan tries.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from types import MappingProxyType
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.effects.chain import Chain
from identification.error_curve import ErrorCurve
from identification.errors import InputError
from identification.kinematics.chain import KinematicChain
from identification.kinematics.parameters import Parameter
from identification.measurements import Conditions

SESSION = 1.1  # from one session to the next on the clock of steps, a gap of 0.1 between them
DIGITS = 6  # of a value, significant: labels and files hold it exactly


@dataclass(frozen=True)
class Scope:
    """Information from which the values of a setting may be computed: the arm, the joint (from 1), and the data.

    postures : (m, n) [rad], None without data;  conditions : of these rows
    """

    arm: Arm
    joint: int | None = None
    postures: Array | None = None
    conditions: Conditions = field(default_factory=Conditions)


Values = Sequence[float] | Callable[[Scope], Sequence[float]]


@dataclass(frozen=True)
class Setting:
    """A number that is chosen rather than estimated: the order of a wave, the time of a step, a time constant.

    low, high : range allowed in an arm file
    values : to try in `diagnose`, a list or a function of `Scope`; None: all whole numbers from low to high
    whole : whole numbers only
    symbolic : True if the effect's formula accepts a CasADi symbol, so that one function serves all values; False if it
        needs the number itself, as in `range(k)`
    """

    low: float
    high: float
    values: Values | None = None
    whole: bool = False
    symbolic: bool = True

    @classmethod
    def of(cls, setting: Setting | tuple[int, int]) -> Setting:
        """A setting unchanged; a pair (low, high) as the setting of all whole numbers in between."""
        return setting if isinstance(setting, cls) else cls(*setting, whole=True, symbolic=False)  # type: ignore[misc]

    def scan(self, scope: Scope) -> list[float]:
        """The distinct values to try, ascending, rounded as in labels and files."""
        if self.values is None:
            return [float(k) for k in range(int(self.low), int(self.high) + 1)]
        values = self.values(scope) if callable(self.values) else self.values
        kept = {float(f"{value:.{DIGITS}g}") for value in values if self.allows(value)}
        return sorted(kept)

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


def step_times(scope: Scope) -> list[float]:
    """Times to try for a step: between rows, evenly spaced, and between sessions."""
    time = scope.conditions.time
    if time is None or np.ptp(time) == 0.0:
        return list(np.linspace(-0.5, 0.5, 40)[2:-2])
    sessions = np.zeros(len(time)) if scope.conditions.session is None else scope.conditions.session
    values = np.unique(clock(time, sessions))
    between = 0.5 * (values[1:] + values[:-1])
    first = int(np.ceil(0.05 * len(between)))  # at either end a step would be a few rows
    inner = between[first : len(between) - first] if 2 * first < len(between) else between
    count = 100 if len(between) <= 400 else 40  # effort: of many rows fewer
    spread = inner[np.unique(np.linspace(0, len(inner) - 1, count).round().astype(int))]
    return [*spread, *((np.unique(sessions)[1:] - 0.5) * SESSION)]


class Effect:
    """Base class of all effects. Subclasses set the class variables, define the parameters, and override a hook.

    Class variables:

    name : as in the arm file;  summary : one line for people
    per_joint : `required`, `optional` or `none`: whether the effect is given for a single joint
    first_joint : lowest joint (from 1) that can have it
    needs : what the arm or the data must have: gravity, distance (measured ones), directions, temperature, time,
        session, past
    family : class of effects that are rivals for the same physical cause (`diagnose` may merge them); by default
        that of the base class, or the name
    through : kind of effects that it modifies, by what they need: `gravity`; without such effects it does nothing
    settings : numbers that are chosen, not estimated; a pair (low, high) means all whole numbers in between. In
        formulas `self.chosen[name]` is the number, or a CasADi symbol when all values are tried at once
    prior : prior weight relative to the common effects of the library, which have 1
    alias : base parameters from which no measurement of the tip can distinguish it, or None
    nuisance : True if it is no fault of the arm, so that `diagnose` does not search for it
    of_commands : True if it acts between command and encoder reading, so that models of the readings ignore it
        (identification/simulate.py)
    scatter : True if it acts on the noise, so that the model of the mean ignores it (`identification.effects.noise`)
    once : True if it belongs to the session of the identification; in later sessions its final state applies
    of_positions : True if it is of the frame in which positions are measured, which other instruments do not have
    tabulated : True if it is a table of values (`EffectSpec.curve`) without parameters
    dimensions : dimensions of the arms that can have it: 2 in the plane, 3 in space

    Attributes of an instance:

    chain : the nominal geometry;  joint : from 1, None: the whole arm;  chosen : values of the settings
    tagged : True if names include the settings, `transmission_ripple:1[k=20].a`, as the arm has a similar effect at the
        same joint (see `build_all`)
    parameters : as `define` returns them
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    per_joint: ClassVar[str] = "none"
    first_joint: ClassVar[int] = 1
    needs: ClassVar[frozenset[str]] = frozenset()
    family: ClassVar[str] = ""
    through: ClassVar[str] = ""
    settings: ClassVar[Mapping[str, Setting | tuple[int, int]]] = MappingProxyType({})
    prior: ClassVar[float] = 1.0
    alias: ClassVar[str | None] = None
    nuisance: ClassVar[bool] = False
    of_commands: ClassVar[bool] = False
    scatter: ClassVar[bool] = False
    once: ClassVar[bool] = False
    of_positions: ClassVar[bool] = False
    tabulated: ClassVar[bool] = False
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)
    curve: ErrorCurve | None = None

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
        self.parameters: tuple[Parameter, ...] = self.define()

    @property
    def key(self) -> str:
        """Name in reports: `name` or `name:joint`, with the settings if `tagged`."""
        return self.label if self.tagged else EffectSpec(self.name, self.joint).key

    @cached_property
    def label(self) -> str:
        """Unique name from name, joint and settings: `transmission_ripple:2[k=6]`."""
        settings = ";".join(f"{name}={value:g}" for name, value in self.chosen.items())
        return EffectSpec(self.name, self.joint).key + (f"[{settings}]" if settings else "")

    def parameter(
        self,
        short: str,
        unit: str,
        *,
        scale: float,
        lower: float = -inf,
        upper: float = inf,
        typical: float | None = None,
        start: float | None = None,
    ) -> Parameter:
        """A parameter of this effect under its full name; arguments as of `Parameter`."""
        name = f"{self.key}.{short}"
        return Parameter(name, unit, lower, upper, scale, joint=self.joint, typical=typical, start=start)

    @property
    def link_length(self) -> float:
        """Length over which this effect's joint acts [mm]: in the plane of the link behind it."""
        return float(self.chain.levers[self.joint_index])

    @property
    def reach(self) -> float:
        """Length of the stretched arm [mm]."""
        return self.chain.reach

    @property
    def dimension(self) -> int:
        """d, coordinates of a position of the arm."""
        return self.chain.dimension

    @property
    def joint_index(self) -> int:
        """The joint from 0, as an index of arrays. Raises `InputError` for an effect of the whole arm."""
        if self.joint is None:
            raise InputError(f"effects: {self.name} needs a joint, allowed: 1 to {len(self.chain)}")
        return self.joint - 1

    def at_joint(self, angle: ca.SX, chain: Chain) -> ca.SX:
        """(n,) zeros except `angle` at this effect's joint."""
        angles = ca.SX.zeros(chain.links)
        angles[self.joint_index] = angle
        return angles

    def at_frame(self, vector: ca.SX, chain: Chain) -> ca.SX:
        """(3n,) zeros except `vector` (3,) at the frame of this effect's joint."""
        at_frames = ca.SX.zeros(3 * chain.links)
        at_frames[3 * self.joint_index : 3 * self.joint_index + 3] = vector
        return at_frames

    # -- what a subclass defines ------------------------------------------------------------------------------------
    def define(self) -> tuple[Parameter, ...]:
        """The parameters, in the order in which the hooks receive them."""
        raise NotImplementedError

    def payload(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """Added to the payload [kg], for all effects of gravity."""
        return 0.0

    def gravity_turn(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """Rotation of gravity [rad], for all effects of gravity; in space (3,), about the axes of the base."""
        return 0.0

    def payload_shift(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(3,) in space what is added to the place of the payload in the tip's frame [mm]."""
        return 0.0

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(n,) added to the commanded joint angles [rad]."""
        return 0.0

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX | float:
        """(n,) added to the link lengths [mm]."""
        return 0.0

    def bending(self, chain: Chain, values: ca.SX) -> tuple[ca.SX | float, ca.SX | float]:
        """(n,) deflection of each link's end to its left [mm], and (n,) slope there [rad]."""
        return 0.0, 0.0

    def frame_errors(self, chain: Chain, values: ca.SX) -> tuple[ca.SX | float, ca.SX | float]:
        """In space: (3n,) rotations [rad] and (3n,) translations [mm] of each joint's frame after its motion, about and
        along its own x, y, z, joint by joint."""
        return 0.0, 0.0

    def tool(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(d,) offset of the measured point in the frame of the last link [mm]."""
        return 0.0

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """Rotation of the arm about its base [rad]; in space (3,), about its x, y, z."""
        return 0.0

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(d,) translation of the base [mm]."""
        return 0.0

    def instrument(self, position: ca.SX, values: ca.SX) -> ca.SX | float:
        """(d,) added by the instrument to the true position [mm]."""
        return 0.0


class JointAngle(Effect):
    """An effect that adds one parameter times a `shape` to the angle of one joint.

    number : short name, unit and typical size of the parameter;  lower : its lower bound
    """

    per_joint = "required"
    number: ClassVar[tuple[str, str, float]]
    lower: ClassVar[float] = -inf

    def shape(self, chain: Chain) -> ca.SX:
        """Factor of the parameter, a function of posture and conditions."""
        raise NotImplementedError

    def define(self) -> tuple[Parameter, ...]:
        short, unit, typical = self.number
        return (self.parameter(short, unit, scale=self.link_length, lower=self.lower, typical=typical),)

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        return self.at_joint(values[0] * self.shape(chain), chain)


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
