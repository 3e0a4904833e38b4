"""Columns of what may be missing: derivatives of the tip position with respect to its parameters.

An effect adds something at places of the chain. Its column is the lever of the place (derivative of the position with
respect to what is added there, the same for all effects) times the slope (derivative of what is added with respect to
the effect's parameter). One CasADi function with the settings as arguments gives the slopes of one effect at all
joints for all values tried. What is outside the library has columns that are functions of angles, time or place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import Effect, Setting
from identification.effects.chain import Chain, condition_slices, contributions, in_state, state_slices
from identification.error_curve import ErrorCurve, local_splines
from identification.model import Model
from identification.vectorize import vectorize

WAVES = 30  # half periods of an error curve over the angles of its joint; convention: what a person would call smooth
# an effect's class, joint, and names of its settings where they are scanned, else names and values
Key = tuple[type[Effect], int | None, tuple[str, ...] | tuple[tuple[str, float], ...]]


class Symbols:
    """CasADi symbols of posture q (n), conditions c and state, and the nominal chain, with and without loads.

    remembers : the conditions include the past
    """

    def __init__(self, arm: Arm, remembers: bool) -> None:
        n, self.arm, self.remembers = arm.links, arm, remembers
        self.q, self.state = (
            ca.SX.sym("q", n),
            ca.SX.sym("state", max(place.stop for place in state_slices(arm.chain).values())),
        )
        extra = ("past",) if remembers else ()
        self.c = ca.SX.sym("c", max(place.stop for place in condition_slices(n, extra).values()))
        self.chain = Chain.of(arm, self.q, self.c, extra)
        self.loaded = in_state(self.chain, self.state)

    def added(self, effect: Effect) -> tuple[ca.SX, ca.SX]:
        """(P,) contributions of an effect at all places, and the symbols of its parameters."""
        v = ca.SX.sym("v", len(effect.parameters))
        return contributions(effect, self.chain, self.loaded, v, self.state), v


@dataclass(frozen=True)
class Formulas:
    """Symbolic slopes of some effects.

    effects : with CasADi symbols in place of scanned settings;  symbols : (S,) these symbols
    """

    at: Symbols
    effects: tuple[Effect, ...]
    symbols: ca.SX

    @cached_property
    def _slopes(self) -> list[ca.SX]:
        """For each effect (P, size) derivatives of what it adds at all places with respect to its parameters, at their
        neutral values."""
        slopes = []
        for effect in self.effects:
            added, v = self.at.added(effect)
            neutral = ca.DM([p.neutral for p in effect.parameters])
            slopes.append(ca.sparsify(ca.substitute(ca.jacobian(added, v), v, neutral)))
        return slopes

    @cached_property
    def places(self) -> list[list[list[tuple[int, int]]]]:
        """For each effect and parameter the pairs (place, index of the slope) of its nonzero slopes."""
        places, count = [], 0
        for slopes in self._slopes:
            listed: list[list[tuple[int, int]]] = [[] for _ in range(slopes.shape[1])]
            for row, column in zip(*slopes.sparsity().get_triplet(), strict=True):
                listed[column].append((row, count))
                count += 1
            places.append(listed)
        return places

    @cached_property
    def function(self) -> Callable[..., tuple[np.ndarray, ...]]:
        """Function of arrays (q, c, state, settings) that returns the Z slopes not identically zero, (..., Z, 1)."""
        values, at = ca.vertcat(*(ca.SX(s.nz[:]) for s in self._slopes)), self.at
        return vectorize(ca.Function("slopes", [at.q, at.c, at.state, self.symbols], [ca.cse(values)]))


@dataclass(frozen=True)
class Bundle:
    """Effects whose slopes are evaluated by one function.

    members : for each effect the indices of its hypotheses, one for each row of `settings`
    settings : (K, S) all scanned settings side by side, padded with the last value
    """

    formulas: Formulas
    members: tuple[tuple[int, ...], ...]
    settings: Array

    def columns(
        self, postures: Array, conditions: Conditions, state: Array, levers: Array
    ) -> Iterator[tuple[int, Array]]:
        """Index of each hypothesis with its (m, d, size) columns at (m, n) postures [rad], from (m, S) state and
        (m, d, P) levers."""
        at = self.formulas.at
        payload = 0.0 if at.arm.gravity is None else at.arm.gravity.payload
        table = conditions.table(len(postures), at.arm.links, payload, postures if at.remembers else None)
        given = postures[:, None], table[:, None], state[:, None], self.settings[None]
        slopes = self.formulas.function(*given)[0][..., 0]  # (m, K, Z)
        for members, places in zip(self.members, self.formulas.places, strict=True):
            count = len(members)
            block = np.zeros((*levers.shape[:2], count, len(places)))
            for column, listed in enumerate(places):
                for place, number in listed:
                    block[..., column] += levers[:, :, place, None] * slopes[:, None, :count, number]
            yield from ((member, block[:, :, k]) for k, member in enumerate(members))


def bundles(arm: Arm, effects: Sequence[tuple[int, Effect]]) -> tuple[Bundle, ...]:
    """Group effects so that each group is evaluated by one function.

    effects : pairs (index of the hypothesis, effect)

    Effects without scanned settings form one group; each scanned effect forms one with all its joints and settings.
    """
    arm = Arm(arm.chain, gravity=arm.gravity)  # all that the formulas have in them
    remembers = any("past" in effect.needs for _, effect in effects)
    plain: list[list[tuple[int, Effect]]] = []
    scanned: dict[str, dict[int | None, list[tuple[int, Effect]]]] = {}
    for number, effect in effects:
        if effect.chosen and all(Setting.of(setting).symbolic for setting in effect.settings.values()):
            scanned.setdefault(effect.name, {}).setdefault(effect.joint, []).append((number, effect))
        else:
            plain.append([(number, effect)])
    groups = [(plain, False), *((list(by_joint.values()), True) for by_joint in scanned.values())]
    made = []
    for parts, symbolic in groups:  # parts: hypotheses that differ in their settings alone, which may be arguments
        if not parts:
            continue
        longest, keys, settings = max(map(len, parts)), list[Key](), []
        for part in parts:
            first, values = part[0][1], [list(effect.chosen.values()) if symbolic else [] for _, effect in part]
            chosen: Any = first.chosen if symbolic else first.chosen.items()
            keys.append((type(first), first.joint, tuple(chosen)))
            settings.append(np.pad(np.array(values), ((0, longest - len(part)), (0, 0)), mode="edge"))
        members = tuple(tuple(number for number, _ in part) for part in parts)
        made.append(Bundle(_formulas(arm, remembers, tuple(keys)), members, np.hstack(settings)))
    return tuple(made)


@lru_cache(maxsize=8)
def _symbols(arm: Arm, remembers: bool) -> Symbols:
    return Symbols(arm, remembers)


@lru_cache
def _formulas(arm: Arm, remembers: bool, keys: tuple[Key, ...]) -> Formulas:
    """Symbolic slopes of these effects, built once for equal arms."""
    effects, symbols = [], list[ca.SX]()
    for cls, joint, settings in keys:
        chosen: dict[str, Any] = dict(s if isinstance(s, tuple) else (s, ca.SX.sym(s)) for s in settings)
        symbols += [value for value in chosen.values() if isinstance(value, ca.SX)]
        effects.append(cls(arm.chain, joint, chosen))
    return Formulas(_symbols(arm, remembers), tuple(effects), ca.SX(ca.vertcat(*symbols)))


@dataclass(frozen=True, eq=False)
class Where:
    """Postures (m, n) [rad] and conditions at which the columns of blocks are wanted, at a model's parameters (p,)."""

    model: Model
    values: Array
    postures: Array
    conditions: Conditions

    @cached_property
    def position(self) -> Array:
        """(m, d) computed [mm]."""
        return self.model.position(self.postures, self.values, self.conditions)

    @cached_property
    def levers(self) -> Array:
        """(m, d, n) of the joints [mm/rad]."""
        return self.model.joint_levers(self.postures, self.values, self.conditions)

    @cached_property
    def moments(self) -> Array:
        """(m, n) of gravity about the joints, their mean square 1."""
        torques = self.model.on_chain(lambda chain: chain.torques)(self.postures, self.conditions)
        return np.asarray(torques / max(float(np.sqrt(np.mean(np.square(torques)))), 1e-300))

    def turned(self, joint: int, functions: Array) -> Array:
        """(m, d, w) columns of functions (m, w) that are added to the angle of a joint (from 0)."""
        return self.levers[:, :, joint, None] * functions[:, None, :]

    def moved(self, functions: Array) -> Array:
        """(m, d, w') columns of functions (m, w) that move all points, or turn them in the plane."""
        m, d = self.position.shape
        moves = np.broadcast_to(np.eye(d), (m, d, d))
        if d == 2:
            turn = np.stack([-self.position[:, 1], self.position[:, 0]], axis=1) / self.model.reach
            moves = np.concatenate([moves, turn[:, :, None]], axis=2)
        return times(moves, functions)

    def varied(self, functions: Array) -> Array:
        """(m, d, p w) columns of functions (m, w) that are added to each of the p parameters of the geometry, in its
        scale."""
        of_effects = {p.name for effect in self.model.effects for p in effect.parameters}
        own = [k for k, name in enumerate(self.model.names) if name not in of_effects]
        jacobian = self.model.jacobian(self.postures, self.values, self.conditions) * self.model.scales
        return times(jacobian[:, :, own], functions)


def times(columns: Array, functions: Array) -> Array:
    """(m, d, k w) columns (m, d, k) times functions (m, w), each with each."""
    return np.asarray((columns[..., None] * functions[:, None, None, :]).reshape(*columns.shape[:2], -1))


@dataclass(frozen=True)
class Basis:
    """Cosine transform of a cubic spline basis of one joint (from 0) between two angles [rad], scaled to the prior of a
    random walk."""

    joint: int
    start: float
    stop: float

    def at(self, angles: Array) -> Array:
        """(m, K) values at angles (m,) [rad]."""
        count, k = WAVES + 1, np.arange(1, WAVES + 1)
        cosines = np.cos(np.pi / count * np.outer(np.arange(count) + 0.5, k))
        place, parts = local_splines(angles, self.start, self.stop, count)
        splines = np.zeros((len(place), count + 6))
        np.put_along_axis(splines, place + 3, parts, axis=1)
        return np.asarray(splines[:, 3:-3] @ (cosines / np.sin(0.5 * np.pi * k / count)))

    def table(self, values: Array) -> ErrorCurve:
        """The function with these values (K + 1,) at the nodes."""
        return ErrorCurve(self.start, self.stop, values)
