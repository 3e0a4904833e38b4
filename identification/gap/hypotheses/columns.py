"""Jacobian columns of all hypotheses: derivatives of the tip position with respect to their parameters.

An effect adds something at places of the chain. Its column is the lever of the place (derivative of the position with
respect to what is added there, the same for all effects) times the slope (derivative of what is added with respect to
the effect's parameter). One CasADi function with the settings as arguments gives the slopes of one effect at all
joints for all values tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.effects import Effect, Setting
from identification.model.compiled_parts import Symbols
from identification.vectorize import vectorize

# reason: identification/README.md, "Constants"
KEPT = 256  # effort: formulas set up, of some arms
# an effect's class, joint, and names of its settings where they are scanned, else names and values
Key = tuple[type[Effect], int | None, tuple[str, ...] | tuple[tuple[str, float], ...]]


class SlopeSymbols(Symbols):
    """Symbols of posture, conditions and state, with a cache of the slopes of each effect."""

    def __init__(self, arm: Arm, remembers: bool) -> None:
        super().__init__(arm, remembers)
        self._known: dict[Effect, ca.SX] = {}

    def slopes(self, effect: Effect) -> ca.SX:
        """(P, size) derivative of what an effect adds at all places with respect to its parameters, at their neutral
        values."""
        if effect not in self._known:
            added, v = self.added(effect)
            start = ca.DM([p.neutral for p in effect.parameters])
            self._known[effect] = ca.sparsify(ca.substitute(ca.jacobian(added, v), v, start))
        return self._known[effect]


@dataclass(frozen=True)
class Formulas:
    """Symbolic slopes of some effects.

    effects : with CasADi symbols in place of scanned settings;  symbols : (S,) these symbols
    """

    at: SlopeSymbols
    effects: tuple[Effect, ...]
    symbols: ca.SX

    @cached_property
    def _slopes(self) -> list[ca.SX]:
        """(P, size) for each effect."""
        return [self.at.slopes(effect) for effect in self.effects]

    @cached_property
    def fixed(self) -> bool:
        """True if the slopes do not depend on the state, so that one evaluation serves all fitted models."""
        return not any(ca.depends_on(ca.vec(s), self.at.state) for s in self._slopes)

    @cached_property
    def places(self) -> list[list[list[tuple[int, int]]]]:
        """For each effect and parameter the pairs (place, index of the slope) of its nonzero slopes."""
        found, count = [], 0
        for slopes in self._slopes:
            listed: list[list[tuple[int, int]]] = [[] for _ in range(slopes.shape[1])]
            for row, column in zip(*slopes.sparsity().get_triplet(), strict=True):
                listed[column].append((row, count))
                count += 1
            found.append(listed)
        return found

    @cached_property
    def function(self) -> Callable[..., tuple[np.ndarray, ...]]:
        """Function of arrays (q, c, state, settings) that returns the Z slopes not identically zero, (..., Z, 1)."""
        values, at = ca.vertcat(*(ca.SX(s.nz[:]) for s in self._slopes)), self.at
        return vectorize(ca.Function("slopes", [at.q, at.c, at.state, self.symbols], [ca.cse(values)]))


@dataclass(frozen=True)
class Bundle:
    """Effects whose slopes are evaluated by one function.

    members : for each effect the indices of its hypotheses, one for each row of `settings`
    settings : (K, S) values of the symbols of all effects side by side; the last value of a shorter scan is repeated
    """

    formulas: Formulas
    members: tuple[tuple[int, ...], ...]
    settings: Array

    @property
    def fixed(self) -> bool:
        """As `Formulas.fixed`."""
        return self.formulas.fixed

    def slopes(self, postures: Array, conditions: Conditions, state: Array) -> Array:
        """(m, K, Z) slopes at (m, n) postures [rad], their conditions and (m, S) state."""
        at = self.formulas.at
        payload = 0.0 if at.arm.gravity is None else at.arm.gravity.payload
        table = conditions.table(len(postures), at.arm.links, payload, postures if at.remembers else None)
        return self.formulas.function(postures[:, None], table[:, None], state[:, None], self.settings[None])[0][..., 0]

    def columns(self, levers: Array, slopes: Array) -> Iterator[tuple[int, Array]]:
        """Index of each hypothesis with its (m, d, size) columns, from levers (m, d, P) and slopes (m, K, Z)."""
        m, d, _ = levers.shape
        for members, places in zip(self.members, self.formulas.places, strict=True):
            count = len(members)
            block = np.zeros((m, d, count, len(places)))
            for column, listed in enumerate(places):
                for place, number in listed:
                    block[..., column] += levers[:, :, place, None] * slopes[:, None, :count, number]
            yield from ((member, block[:, :, k]) for k, member in enumerate(members))


def bundles(arm: Arm, effects: Sequence[tuple[int, Effect]]) -> tuple[Bundle, ...]:
    """Group effects so that each group is evaluated by one function.

    effects : pairs (index of the hypothesis, effect)

    Effects without scanned settings form two groups, with and without dependence on the state; each scanned effect
    forms one group with all its joints and settings.
    """
    arm = Arm(arm.lengths, gravity=arm.gravity, chain=arm.chain)  # all that the formulas have in them
    remembers = any("past" in effect.needs for _, effect in effects)
    plain: dict[bool, list[tuple[int, Effect]]] = {}
    scanned: dict[str, dict[int | None, list[tuple[int, Effect]]]] = {}
    for number, effect in effects:
        if effect.chosen and all(Setting.of(setting).symbolic for setting in effect.settings.values()):
            scanned.setdefault(effect.name, {}).setdefault(effect.joint, []).append((number, effect))
        else:
            plain.setdefault(_formulas(arm, remembers, _plain([effect])).fixed, []).append((number, effect))
    return (
        *(
            Bundle(
                _formulas(arm, remembers, _plain([e for _, e in some])), tuple((n,) for n, _ in some), np.zeros((1, 0))
            )
            for some in plain.values()
        ),
        *(_scanned_bundle(arm, remembers, by_joint) for by_joint in scanned.values()),
    )


def _plain(effects: Sequence[Effect]) -> tuple[Key, ...]:
    return tuple((type(effect), effect.joint, tuple(effect.chosen.items())) for effect in effects)


def _scanned_bundle(arm: Arm, remembers: bool, by_joint: Mapping[int | None, Sequence[tuple[int, Effect]]]) -> Bundle:
    """The group of one scanned effect, its settings side by side for all joints."""
    longest, settings = max(map(len, by_joint.values())), []
    for group in by_joint.values():
        values = np.array([list(effect.chosen.values()) for _, effect in group])
        settings.append(np.pad(values, ((0, longest - len(group)), (0, 0)), mode="edge"))
    keys = tuple((type(group[0][1]), joint, tuple(group[0][1].chosen)) for joint, group in by_joint.items())
    members = tuple(tuple(number for number, _ in group) for group in by_joint.values())
    return Bundle(_formulas(arm, remembers, keys), members, np.hstack(settings))


@lru_cache(maxsize=8)
def _symbols(arm: Arm, remembers: bool) -> SlopeSymbols:
    return SlopeSymbols(arm, remembers)


@lru_cache(maxsize=KEPT)
def _formulas(arm: Arm, remembers: bool, keys: tuple[Key, ...]) -> Formulas:
    """Symbolic slopes of these effects, built once for equal arms."""
    effects, symbols = [], list[ca.SX]()
    for cls, joint, settings in keys:
        chosen: dict[str, Any] = dict(s if isinstance(s, tuple) else (s, ca.SX.sym(s)) for s in settings)
        symbols += [value for value in chosen.values() if isinstance(value, ca.SX)]
        effects.append(cls(arm.lengths, joint, chosen, dimension=arm.dimension))
    return Formulas(_symbols(arm, remembers), tuple(effects), ca.SX(ca.vertcat(*symbols)))
