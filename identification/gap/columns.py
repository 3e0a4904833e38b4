"""How the tip moves when a missing effect is added: the columns of all hypotheses, whatever their place and settings.

An effect adds something at places of the chain. Its column is the lever of the place (derivative of the position by
what is added there, the same for all effects) times the slope (derivative of what is added by the effect's parameter).
One CasADi function with the settings as arguments gives the slopes of one effect at all joints for all values tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.composition import Symbols
from identification.conditions import Conditions
from identification.effects import Effect, Setting
from identification.vectorize import vectorize


@dataclass(frozen=True)
class Template:
    """One effect at one joint.

    effect : with CasADi symbols for its settings where they are scanned
    members : (k,) numbers of the hypotheses that it stands for, one for each row of the settings
    """

    effect: Effect
    members: tuple[int, ...]


class SlopeSymbols(Symbols):
    """Symbols of posture, conditions and state, and slopes that are kept."""

    def __init__(self, arm: Arm, remembers: bool) -> None:
        super().__init__(arm, remembers)
        self._known: dict[Effect, ca.SX] = {}

    def slopes(self, effect: Effect) -> ca.SX:
        """(P, size) derivative of what an effect adds at all places by its parameters, nothing being known of these."""
        if effect not in self._known:
            added, v = self.added(effect)
            start = ca.DM([p.neutral for p in effect.parameters])
            self._known[effect] = ca.sparsify(ca.substitute(ca.jacobian(added, v), v, start))
        return self._known[effect]


@dataclass(frozen=True)
class Bundle:
    """Effects whose slopes one function gives.

    settings : (K, S) values of the symbols of all templates side by side; a template of fewer than K members repeats
        its last;  symbols : (S,) of them
    """

    at: SlopeSymbols
    templates: tuple[Template, ...]
    symbols: ca.SX
    settings: Array

    @cached_property
    def _slopes(self) -> list[ca.SX]:
        """Per template (P, size)."""
        return [self.at.slopes(template.effect) for template in self.templates]

    @cached_property
    def fixed(self) -> bool:
        """True if the slopes do not depend on the fitted model."""
        return not any(ca.depends_on(ca.vec(s), self.at.state) for s in self._slopes)

    @cached_property
    def places(self) -> list[list[list[tuple[int, int]]]]:
        """Per template and parameter: (place, number of the slope) of what it adds."""
        found, count = [], 0
        for slopes in self._slopes:
            listed: list[list[tuple[int, int]]] = [[] for _ in range(slopes.shape[1])]
            for row, column in zip(*slopes.sparsity().get_triplet(), strict=True):
                listed[column].append((row, count))
                count += 1
            found.append(listed)
        return found

    @cached_property
    def _function(self) -> Callable[..., tuple[np.ndarray, ...]]:
        values, at = ca.vertcat(*(ca.SX(s.nz[:]) for s in self._slopes)), self.at
        return vectorize(ca.Function("slopes", [at.q, at.c, at.state, self.symbols], [ca.cse(values)]))

    def slopes(self, postures: Array, conditions: Conditions, state: Array) -> Array:
        """(m, K, Z) numbers that are not always zero, for (m, n) postures, their conditions and (m, S) state."""
        payload = 0.0 if self.at.arm.gravity is None else self.at.arm.gravity.payload
        table = conditions.table(len(postures), self.at.arm.links, payload, postures if self.at.remembers else None)
        return self._function(postures[:, None], table[:, None], state[:, None], self.settings[None])[0][..., 0]

    def columns(self, levers: Array, slopes: Array) -> Iterator[tuple[int, Array]]:
        """Number of each hypothesis and its (m, d, size) columns, from levers (m, d, P) and slopes (m, K, Z)."""
        m, d, _ = levers.shape
        for template, places in zip(self.templates, self.places, strict=True):
            count = len(template.members)
            block = np.zeros((m, d, count, len(places)))
            for column, listed in enumerate(places):
                for place, number in listed:
                    block[..., column] += levers[:, :, place, None] * slopes[:, None, :count, number]
            yield from ((member, block[:, :, k]) for k, member in enumerate(template.members))


def bundles(arm: Arm, effects: Sequence[tuple[int, Effect]]) -> tuple[Bundle, ...]:
    """All effects, each with the number of its hypothesis: those with nothing to scan together (those that depend on
    the fitted model apart), and each scanned one with all its joints and settings."""
    at = SlopeSymbols(arm, any("past" in effect.needs for _, effect in effects))
    plain: dict[bool, list[tuple[int, Effect]]] = {}
    scanned: dict[str, dict[int | None, list[tuple[int, Effect]]]] = {}
    for number, effect in effects:
        if effect.chosen and all(Setting.of(setting).symbolic for setting in effect.settings.values()):
            scanned.setdefault(effect.name, {}).setdefault(effect.joint, []).append((number, effect))
        else:
            fixed = _plain_bundle(at, [(number, effect)]).fixed
            plain.setdefault(fixed, []).append((number, effect))
    return (*(_plain_bundle(at, e) for e in plain.values()), *(_scanned_bundle(at, s) for s in scanned.values()))


def _plain_bundle(at: SlopeSymbols, effects: Sequence[tuple[int, Effect]]) -> Bundle:
    templates = tuple(Template(effect, (number,)) for number, effect in effects)
    return Bundle(at, templates, ca.SX.zeros(0), np.zeros((1, 0)))


def _scanned_bundle(at: SlopeSymbols, by_joint: Mapping[int | None, Sequence[tuple[int, Effect]]]) -> Bundle:
    """One effect, its values side by side for all joints."""
    templates, settings, symbols = [], [], list[ca.SX]()
    longest = max(map(len, by_joint.values()))
    for joint, group in by_joint.items():
        one = group[0][1]
        chosen: dict[str, Any] = {name: ca.SX.sym(name) for name in one.chosen}
        members = tuple(number for number, _ in group)
        templates.append(Template(type(one)(one.lengths, joint, chosen, dimension=one.dimension), members))
        symbols += chosen.values()
        values = np.array([[effect.chosen[name] for name in chosen] for _, effect in group])
        settings.append(np.pad(values, ((0, longest - len(group)), (0, 0)), mode="edge"))
    return Bundle(at, tuple(templates), ca.SX(ca.vertcat(*symbols)), np.hstack(settings))
