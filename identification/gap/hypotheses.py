"""What could be missing: every effect of the library that this arm and these data can show, with its columns.

A hypothesis is one effect at one joint (or of the whole arm). Effects with a whole-number setting (the order k of a
gear ripple) are scanned: each value is a hypothesis, and together they weigh as much as one unscanned effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.effects import Chain, Effect, build, build_all, library
from identification.gap.f_tests import Dictionary, dictionary
from identification.gap.whitening import Rows
from identification.measurements import Conditions
from identification.model import Model


@dataclass(frozen=True)
class Hypothesis:
    """One effect that might be missing.

    weight : prior weight; 1 for an effect of the whole arm, n^(-1/2) at each of n joints (between one for each joint
        and one for all joints together), and of that 1/K for each of K settings that are scanned
    tied : all parameters of a family are taken as equal. Compliance in every joint is seen long before each joint's own
        compliance is, so it is tried with one parameter too; when it is named, each joint gets its own.
    """

    effect: Effect
    spec: EffectSpec
    weight: float = 1.0
    tied: bool = False

    @property
    def free(self) -> Hypothesis:
        """The hypothesis that is named when this one is found."""
        return replace(self, tied=False) if self.tied else self

    @property
    def key(self) -> str:
        """`name` or `name:joint`: what and where, whatever is scanned."""
        return self.spec.key

    @property
    def label(self) -> str:
        """The key with the scanned setting: `transmission_ripple:2[k=6]`."""
        return f"{self.key}[equal]" if self.tied else self.effect.label

    @property
    def family(self) -> str:
        """The class in which it is merged with those that look alike."""
        return self.effect.family or self.effect.name

    @property
    def size(self) -> int:
        """Number of parameters."""
        return 1 if self.tied else len(self.effect.parameters)

    @property
    def one_sided(self) -> bool:
        """True for one parameter that physics keeps from being negative."""
        return self.size == 1 and self.effect.parameters[0].lower == 0.0


def projected(model_basis: Array, members: Sequence[Hypothesis], columns: list[Array]) -> Dictionary:
    """Hypotheses with their whitened columns (N, size), projected off a fitted model: see `f_tests.dictionary`."""
    one_sided = np.array([h.one_sided for h in members], dtype=bool)
    return dictionary(model_basis, columns, one_sided, np.array([h.weight for h in members]))


@dataclass(frozen=True)
class HypothesisSet:
    """All hypotheses for an arm, and why the other effects of the library are left out.

    skipped : effect key -> reason
    aliases : effect name -> what it cannot be told from, for effects that no measurement of the tip can show
    """

    arm: Arm
    members: tuple[Hypothesis, ...]
    skipped: Mapping[str, str]
    aliases: Mapping[str, str]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {h.label: k for k, h in enumerate(self.members)}

    def place(self, hypothesis: Hypothesis) -> int:
        """Place of a hypothesis among the members, the order in which effects stand in models, results and files."""
        return self._places.get(hypothesis.label, len(self.members))

    @cached_property
    def wide(self) -> Model:
        """The arm with its own effects and all unscanned hypotheses at once."""
        return Model(self.arm.with_effects(*self.arm.effects, *(h.spec for h in self.unscanned)))

    @cached_property
    def base(self) -> Model:
        """The arm as it is modelled now."""
        return Model(self.arm)

    @cached_property
    def unscanned(self) -> tuple[Hypothesis, ...]:
        """Hypotheses without a scanned setting."""
        return tuple(h for h in self.members if not h.spec.values and not h.tied)

    @cached_property
    def scanned(self) -> tuple[Hypothesis, ...]:
        """Hypotheses with a setting; they act on joint angles."""
        return tuple(h for h in self.members if h.spec.values)

    @cached_property
    def _scan(self) -> Callable[[ArrayLike, Conditions | None], Array]:
        return self.base.on_chain(lambda chain: _angle_slopes(chain, tuple(h.effect for h in self.scanned)))

    def slopes(self, rows: Rows) -> Array:
        """(m, S) derivative of the joint angles by the parameters of the scanned hypotheses, which need no fit."""
        if not self.scanned:
            return np.zeros((len(rows), 0))
        return self._scan(rows.postures, rows.conditions)

    def columns(self, rows: Rows, values: Mapping[str, float], slopes: Array) -> list[Array]:
        """Per member, (m, d, size) derivative of the position by its parameters, at these values (others 0)."""
        parameters = self.wide.parameters.vector(values)
        jacobian = self.wide.jacobian(rows.postures, parameters, rows.conditions)
        scanned = self._scanned_columns(self.wide.joint_levers(rows.postures, parameters, rows.conditions), slopes)
        return [next(scanned) if h.spec.values else self._plain_columns(h, jacobian) for h in self.members]

    def _plain_columns(self, hypothesis: Hypothesis, jacobian: Array) -> Array:
        columns = jacobian[:, :, [self.wide.parameters.index(p.name) for p in hypothesis.effect.parameters]]
        return columns.sum(axis=2, keepdims=True) if hypothesis.tied else columns

    def _scanned_columns(self, levers: Array, slopes: Array) -> Iterator[Array]:
        start = 0
        for hypothesis in self.scanned:
            joint = hypothesis.effect.joint_index
            part = slopes[:, start : start + hypothesis.size]  # (m, size)
            yield levers[:, :, joint, None] * part[:, None, :]
            start += hypothesis.size


def _angle_slopes(chain: Chain, effects: tuple[Effect, ...]) -> ca.SX:
    """Per effect and parameter, the derivative of its own joint's angle."""
    v = ca.SX.sym("v", sum(len(effect.parameters) for effect in effects))
    total, start = ca.SX(0), 0
    for effect in effects:
        own = v[start : start + len(effect.parameters)]
        total += ca.SX(effect.joint_angles(chain, own))[effect.joint_index]
        start += len(effect.parameters)
    # every parameter turns one joint only, so the gradient of the sum holds each one's own slope
    return ca.substitute(ca.gradient(total, v), v, ca.SX.zeros(v.numel()))


def hypotheses(arm: Arm, given: frozenset[str]) -> HypothesisSet:
    """Every effect that arm and data can show.

    given : what the data have beyond time and directions (which follow from the order): `temperature`
    """
    available = {"time", "directions"} | ({"gravity"} if arm.gravity is not None else set()) | (given & {"temperature"})
    shown = {name: cls for name, cls in library().items() if cls.alias is None and not cls.scatter}
    own = {effect.label for effect in build_all(arm.effects, arm.links, arm.lengths)}
    members: list[Hypothesis] = []
    skipped: dict[str, str] = {}
    for name, cls in shown.items():
        if missing := sorted(cls.needs - available):
            skipped[name] = f"needs {', '.join(missing)}"
            continue
        for joint in _joints(cls, arm.links):
            spec = EffectSpec(name, joint)
            found = [h for h in _with_settings(cls, spec, arm) if h.effect.label not in own]
            members += found
            if not found:
                skipped[spec.key] = "already in the arm's model"
    aliases = {name: cls.alias for name, cls in library().items() if cls.alias is not None}
    return HypothesisSet(arm, tuple(members), skipped, aliases)


def _joints(cls: type[Effect], links: int) -> list[int | None]:
    each: list[int | None] = list(range(cls.first_joint, links + 1))
    by_kind: dict[str, list[int | None]] = {"none": [None], "required": each, "optional": [None, *each]}
    return by_kind[cls.per_joint]


def _with_settings(cls: type[Effect], spec: EffectSpec, arm: Arm) -> list[Hypothesis]:
    """The hypotheses of one effect at one joint: one for each setting, or free and tied."""
    ranges = [range(low, high + 1) for low, high in cls.settings.values()]
    settings = [dict(zip(cls.settings, map(float, chosen), strict=True)) for chosen in product(*ranges)]
    specs = [replace(spec, values=chosen) for chosen in settings]
    weight = (1.0 if spec.joint is None else 1.0 / np.sqrt(arm.links)) * (1.0 / len(specs))
    found = [Hypothesis(build(s, arm.links, arm.lengths), s, weight) for s in specs]
    parameters = found[0].effect.parameters
    if not cls.settings and len(parameters) > 1 and all(p.lower == 0.0 for p in parameters):
        found.append(replace(found[0], tied=True))
    return found
