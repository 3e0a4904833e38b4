"""What an effect is: a name, parameters with units, and a formula at one place of the chain.

    commanded joint angle -> real joint angle -> links -> position in the base -> measured position

An effect overrides the hook of its place, or several; `measured_position` (effects/places.py) adds up what the hooks
return. A new effect is one class: see `register`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from math import inf
from types import MappingProxyType
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from identification.arm import EffectSpec
from identification.arrays import Array
from identification.effects.chain import Chain
from identification.effects.settings import Setting
from identification.error_curve import ErrorCurve
from identification.errors import InputError
from identification.kinematics.parameters import Parameter


class Effect:
    """Base class of all effects. Subclasses set the class variables and override one hook.

    name : as in the arm file;  summary : one line for people
    per_joint : `required`, `optional` or `none`: whether the effect applies to one joint
    needs : what the arm or the data must have: gravity, directions, temperature, time, session, past
    family : effects of one family are rivals for the same physical cause (`diagnose` merges them when it must)
    through : what effects of the arm's model it changes, by what they need: `gravity`; without them it does nothing
    settings : numbers that are chosen, not estimated; a pair is every whole number from the first to the last.
        In formulas `self.chosen[name]` is the number, or a CasADi symbol that stands for all values tried
    prior : how likely the effect is beside the common ones of the library, which have 1
    alias : why no measurement of the tip can tell this effect from the base parameters, or None
    nuisance : True for what is no fault of the arm, which `diagnose` does not look for
    of_commands : True for what stands between a command and the joint as read, which models of what is read ignore
        (identification/servo.py)
    scatter : True for an effect on the noise, which the model of the mean ignores (`identification.effects.noise`)
    once : True for what happened in the session of the identification: in another one it is as it was at the end
    tabulated : True for an effect that is a table of values (`EffectSpec.curve`) and has no parameters
    dimensions : coordinates of the arms that may have it: 2 in the plane, 3 in space

    dimension : coordinates of this effect's arm

    tagged : whether the names say the settings, `transmission_ripple:1[k=20].a`: where an arm has another such effect
        at the same joint (`build_all` knows)
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
    tabulated: ClassVar[bool] = False
    dimensions: ClassVar[tuple[int, ...]] = (2, 3)
    curve: ErrorCurve | None = None

    def __init__(
        self,
        lengths: Array,
        joint: int | None = None,
        chosen: Mapping[str, Any] | None = None,
        tagged: bool = False,
        dimension: int = 2,
    ) -> None:
        self.lengths = lengths
        self.joint = joint
        self.chosen = dict(chosen or {})
        self.tagged = tagged
        self.dimension = dimension
        self.parameters: tuple[Parameter, ...] = self.define()

    @property
    def key(self) -> str:
        """Name in reports: `name` or `name:joint`, with the settings where another effect has the same."""
        return self.label if self.tagged else EffectSpec(self.name, self.joint).key

    @cached_property
    def label(self) -> str:
        """What makes two effects one and the same: name, joint and settings, `transmission_ripple:2[k=6]`."""
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
        """A parameter of this effect, with its full name; `typical`, `start` and the rest as of `Parameter`."""
        name = f"{self.key}.{short}"
        return Parameter(name, unit, lower, upper, scale, joint=self.joint, typical=typical, start=start)

    @property
    def link_length(self) -> float:
        """Length of the link behind this effect's joint [mm]."""
        return float(self.lengths[self.joint_index])

    @property
    def reach(self) -> float:
        """Length of the stretched arm [mm]."""
        return float(np.sum(self.lengths))

    @property
    def joint_index(self) -> int:
        """The joint from 0, for arrays; raises `InputError` for an effect of the whole arm."""
        if self.joint is None:
            raise InputError(f"effects: {self.name} needs a joint, allowed: 1 to {len(self.lengths)}")
        return self.joint - 1

    def at_joint(self, angle: ca.SX, chain: Chain) -> ca.SX:
        """(n,) zeros but for `angle` at this effect's joint."""
        angles = ca.SX.zeros(chain.links)
        angles[self.joint_index] = angle
        return angles

    def at_frame(self, vector: ca.SX, chain: Chain) -> ca.SX:
        """(3n,) zeros but for `vector` (3,) at the frame of this effect's joint."""
        found = ca.SX.zeros(3 * chain.links)
        found[3 * self.joint_index : 3 * self.joint_index + 3] = vector
        return found

    # -- what a subclass defines ------------------------------------------------------------------------------------
    def define(self) -> tuple[Parameter, ...]:
        """The parameters, in the order in which the hooks receive them."""
        raise NotImplementedError

    def payload(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """What is added to the payload [kg] that every effect of gravity sees."""
        return 0.0

    def gravity_turn(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """Angle [rad] by which gravity is turned for all effects of gravity; in space (3,), about the base's axes."""
        return 0.0

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(n,) what is added to the commanded joint angles [rad]."""
        return 0.0

    def extensions(self, chain: Chain, values: ca.SX, lengths: ca.SX) -> ca.SX | float:
        """(n,) what is added to the link lengths [mm]."""
        return 0.0

    def bending(self, chain: Chain, values: ca.SX) -> tuple[ca.SX | float, ca.SX | float]:
        """(n,) deflection of each link's tip to its left [mm] and (n,) slope there [rad]."""
        return 0.0, 0.0

    def frame_errors(self, chain: Chain, values: ca.SX) -> tuple[ca.SX | float, ca.SX | float]:
        """In space (3n,) rotations [rad] and (3n,) shifts [mm] of each joint's frame after it moved, about and along
        its own x, y, z, joint after joint."""
        return 0.0, 0.0

    def tool(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(d,) offset of the measured point in the frame of the last link [mm]."""
        return 0.0

    def base_rotation(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """Rotation of the arm about its base [rad]; in space (3,), about its x, y, z."""
        return 0.0

    def base_translation(self, chain: Chain, values: ca.SX) -> ca.SX | float:
        """(d,) shift of the base [mm]."""
        return 0.0

    def instrument(self, position: ca.SX, values: ca.SX) -> ca.SX | float:
        """(d,) what the instrument adds to the true position [mm]."""
        return 0.0


class JointAngle(Effect):
    """One number times a `shape`, added to the angle of one joint.

    number : its short name, unit and `typical` size;  lower : its least value
    """

    per_joint = "required"
    number: ClassVar[tuple[str, str, float]]
    lower: ClassVar[float] = -inf

    def shape(self, chain: Chain) -> ca.SX:
        """What the number is multiplied by."""
        raise NotImplementedError

    def define(self) -> tuple[Parameter, ...]:
        short, unit, typical = self.number
        return (self.parameter(short, unit, scale=self.link_length, lower=self.lower, typical=typical),)

    def joint_angles(self, chain: Chain, values: ca.SX) -> ca.SX:
        return self.at_joint(values[0] * self.shape(chain), chain)


_LIBRARY: dict[str, type[Effect]] = {}
OWN = "identification.effects"


def register(cls: type[Effect]) -> type[Effect]:
    """Class decorator that makes an effect known by its name, everywhere.

    A class of the user's own may be defined again, as notebooks do. Raises `InputError` for a name of the library's.
    """
    taken = _LIBRARY.get(cls.name)
    if taken is not None and taken.__module__.startswith(OWN) and not cls.__module__.startswith(OWN):
        raise InputError(f"effect: the name {cls.name!r} is taken by the library, allowed: another name")
    _LIBRARY[cls.name] = cls
    return cls
