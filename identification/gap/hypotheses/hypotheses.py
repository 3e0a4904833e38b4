"""The hypotheses of a diagnosis: every effect of the library that this arm and these data can show.

A hypothesis is one effect at one joint, or of the whole arm. Effects with settings (the order k of a gear ripple, the
time of a step) are scanned: each value is a hypothesis, and together they have the weight of one unscanned effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.conditions import BY_ORDER, FOLLOWING
from identification.effects import Effect, Scope, Setting, build, build_all, of_dimension
from identification.effects.places import state_size
from identification.gap.fit import Rows
from identification.gap.hypotheses.columns import Bundle, bundles
from identification.kinematics.parameters import PRISMATIC
from identification.model import Model

# reasons: identification/README.md, "Constants"
UNSEEN = 1e-3  # share of the reach
KEPT = 128  # effort: models compiled, of some arms
Slopes = list[Array | None]  # per bundle (m, K, Z), None where they depend on the fitted model


@dataclass(frozen=True)
class Hypothesis:
    """One effect that might be missing.

    weight : prior weight: 1 for an effect of the whole arm, n^(-1/2) at each of n joints (between one for each joint
        and one for all joints together), divided by the number of scanned settings, times the effect's own `prior`
    """

    effect: Effect
    spec: EffectSpec
    weight: float = 1.0

    @property
    def scanned(self) -> bool:
        """True if the effect has a scanned setting."""
        return bool(self.effect.chosen)

    @cached_property
    def key(self) -> str:
        """`name` or `name:joint`, without the scanned setting."""
        return self.spec.key

    @cached_property
    def label(self) -> str:
        """The key with the scanned setting: `transmission_ripple:2[k=6]`."""
        return self.effect.label

    @cached_property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.effect.parameters)

    @cached_property
    def one_sign(self) -> bool:
        """True if no parameter can be negative."""
        return all(p.lower == 0.0 for p in self.effect.parameters)

    @property
    def family(self) -> bool:
        """True for an effect with one similar parameter for each joint."""
        return not self.scanned and self.one_sign and self.size > 1

    @cached_property
    def one_sided(self) -> bool:
        """True for a single parameter that cannot be negative."""
        return self.size == 1 and self.effect.parameters[0].lower == 0.0


def modelled(arm: Arm) -> Model:
    """Model of an arm, cached: searches with other noise models or data use the same models again."""
    known = of_dimension(arm.dimension)
    return _modelled(arm, tuple(known[spec.name] for spec in arm.effects))


@lru_cache(maxsize=KEPT)
def _modelled(arm: Arm, classes: tuple[type[Effect], ...]) -> Model:
    """classes : of the arm's effects, part of the key as users can redefine an effect"""
    return Model(arm)


@dataclass(frozen=True)
class HypothesisSet:
    """All hypotheses for an arm, and the reasons why other effects of the library are not among them.

    skipped : effect key -> reason
    aliases : effect name -> base parameters it cannot be distinguished from by any measurement of the tip
    """

    arm: Arm
    members: tuple[Hypothesis, ...]
    skipped: Mapping[str, str]
    aliases: Mapping[str, str]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {h.label: k for k, h in enumerate(self.members)}

    def place(self, hypothesis: Hypothesis) -> int:
        """Index of a hypothesis among the members, which is the order of effects in models, results and files."""
        return self._places.get(hypothesis.label, len(self.members))

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """(H,) parameters of each member."""
        return np.array([h.size for h in self.members], dtype=np.int64)

    @cached_property
    def base(self) -> Model:
        """Model of the arm without further effects."""
        return self.model(())

    def model(self, chosen: Sequence[Hypothesis]) -> Model:
        """Model of the arm with the effects of these hypotheses, in the order of the members."""
        ordered = sorted(chosen, key=self.place)
        return modelled(self.arm.with_effects(*self.arm.effects, *(h.spec for h in ordered)))

    @cached_property
    def unscanned(self) -> tuple[Hypothesis, ...]:
        """Hypotheses without a scanned setting that can act on the base model."""
        return tuple(h for h in self.members if not h.scanned and self.acts(h))

    def own_places(self, model: Model) -> list[int]:
        """Indices of the base model's parameters in a model with further effects; similar ones change their names."""
        own = [p.name for effect in self.base.effects for p in effect.parameters]
        there = [p.name for effect in model.effects[: len(self.base.effects)] for p in effect.parameters]
        renamed = dict(zip(own, there, strict=True))
        return [model.parameters.index(renamed.get(name, name)) for name in self.base.names]

    def acts(self, hypothesis: Hypothesis) -> bool:
        """False if the effect only changes others (`Effect.through`) and the base model has none of those."""
        through = hypothesis.effect.through
        return not through or any(through in effect.needs for effect in self.base.effects)

    @cached_property
    def _bundles(self) -> tuple[Bundle, ...]:
        return bundles(self.arm, [(number, h.effect) for number, h in enumerate(self.members)])

    def slopes(self, rows: Rows) -> Slopes:
        """The part of the columns that does not depend on the fit, shared by all fits to the same rows."""
        state = np.zeros((len(rows), state_size(self.arm.links, self.arm.dimension)))
        return [b.slopes(rows.postures, rows.conditions, state) if b.fixed else None for b in self._bundles]

    def columns(
        self, rows: Rows, values: Mapping[str, float], slopes: Slopes | None = None, model: Model | None = None
    ) -> list[Array]:
        """For each member the (m, d, size) derivative of the position with respect to its parameters.

        values : parameters of `model` (None: the base model); the effect's own are at their neutral values
        slopes : of these rows, from the method of that name
        """
        model = model or self.base
        at = (rows.postures, model.parameters.vector(values), rows.conditions)
        levers, state = model.place_levers(*at)
        known = slopes or self.slopes(rows)
        found: dict[int, Array] = {}
        for bundle, given in zip(self._bundles, known, strict=True):
            given = bundle.slopes(rows.postures, rows.conditions, state) if given is None else given
            found |= bundle.columns(levers, given)
        return [found[k] for k in range(len(self.members))]


def hypotheses(arm: Arm, given: frozenset[str], rows: Rows | None = None) -> HypothesisSet:
    """All effects that an arm and its data can show.

    given : conditions that the data have beyond `BY_ORDER`: `temperature`
    rows : the data, on which scanned settings may depend; None: settings that suit any data
    """
    available = set(BY_ORDER | (given & {"temperature"}))
    available -= FOLLOWING if rows is not None and not rows.conditions.follow else set()
    available |= set() if arm.gravity is None else {"gravity"}
    available |= {"distance"} if arm.measures_distances else set()
    known = of_dimension(arm.dimension)
    shown = {name: cls for name, cls in known.items() if _testable(cls)}
    own = {effect.label for effect in build_all(arm.effects, arm.links, arm.lengths, arm.dimension)}
    unseen = frozenset[int]() if rows is None else untested_joints(Model(arm), rows)
    members: list[Hypothesis] = []
    skipped: dict[str, str] = {}
    for name, cls in shown.items():
        if "distance" in cls.needs - available:
            continue  # of another instrument: nothing that these data lack
        if missing := sorted(cls.needs - available):
            skipped[name] = f"needs {', '.join(missing)}"
            continue
        for joint in _joints(cls, arm.links):
            spec = EffectSpec(name, joint)
            if joint in unseen and cls.joint_angles is not Effect.joint_angles:
                skipped[spec.key] = "the joint slides, or hardly moves the measured point"
                continue
            scope = Scope(arm, joint) if rows is None else Scope(arm, joint, rows.postures, rows.conditions)
            found = [h for h in _with_settings(cls, spec, scope) if h.effect.label not in own]
            members += found
            if not found:
                skipped[spec.key] = "already in the arm's model"
    aliases = {name: cls.alias for name, cls in known.items() if cls.alias is not None}
    return HypothesisSet(arm, tuple(members), skipped, aliases)


def untested_joints(model: Model, rows: Rows) -> frozenset[int]:
    """Joints (from 1) of a spatial arm at which no joint effect is tested.

    These are prismatic joints, since joint effects describe rotary encoders and gears, and joints with an RMS lever
    below `UNSEEN` times the reach: a reflector on the last axis does not move with that joint, and a fraction of a
    micrometre would correspond to degrees.
    """
    if rows.dimension == 2:
        return frozenset()
    levers = model.joint_levers(rows.postures, None, rows.conditions)
    sizes = np.sqrt(np.mean(np.sum(levers**2, axis=1), axis=0))
    sliding = np.array([kind == PRISMATIC for kind in model.joint_types])
    return frozenset((np.flatnonzero(sliding | (sizes < UNSEEN * model.reach)) + 1).tolist())


def _testable(cls: type[Effect]) -> bool:
    """Whether an effect acts on the mean, is a fault of the arm, and can be distinguished from the base parameters."""
    return not (cls.alias or cls.scatter or cls.nuisance or cls.of_commands or cls.tabulated)


def _joints(cls: type[Effect], links: int) -> list[int | None]:
    each: list[int | None] = list(range(cls.first_joint, links + 1))
    by_kind: dict[str, list[int | None]] = {"none": [None], "required": each, "optional": [None, *each]}
    return by_kind[cls.per_joint]


def _with_settings(cls: type[Effect], spec: EffectSpec, scope: Scope) -> list[Hypothesis]:
    """The hypotheses of one effect at one joint: one for each setting."""
    arm, scans = scope.arm, [Setting.of(setting).scan(scope) for setting in cls.settings.values()]
    specs = [replace(spec, values=dict(zip(cls.settings, chosen, strict=True))) for chosen in product(*scans)]
    weight = cls.prior * (1.0 if spec.joint is None else 1.0 / np.sqrt(arm.links)) / max(len(specs), 1)
    return [Hypothesis(build(s, arm.links, arm.lengths, dimension=arm.dimension), s, weight) for s in specs]
