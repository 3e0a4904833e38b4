"""The hypotheses of a diagnosis: every effect of the library that this arm and these data can show.

A hypothesis is one effect at one joint, or of the whole arm. Effects with settings (the order k of a gear ripple, the
time of a step) are scanned: each value is a hypothesis, and together they have the weight of one unscanned effect.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.columns import Bundle, bundles
from identification.gap.hypotheses.f_tests import CHUNK, Columns, Dictionary, dictionary
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
    tied : the parameters of a family are equal. Compliance of all joints together is detected long before that of each
        joint, so it is tested with a single parameter too; once named, each joint has its own parameter.
    """

    effect: Effect
    spec: EffectSpec
    weight: float = 1.0
    tied: bool = False

    @property
    def free(self) -> Hypothesis:
        """The same hypothesis without the tie: the one that is named when this one is found."""
        return replace(self, tied=False) if self.tied else self

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
        return f"{self.key}[equal]" if self.tied else self.effect.label

    @cached_property
    def size(self) -> int:
        """Number of parameters."""
        return 1 if self.tied else len(self.effect.parameters)

    @cached_property
    def one_sign(self) -> bool:
        """True if no parameter can be negative."""
        return all(p.lower == 0.0 for p in self.effect.parameters)

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


def projected(model_basis: Array, members: Sequence[Hypothesis], columns: Columns) -> Dictionary:
    """Hypotheses with their whitened columns, projected off a fitted model: see `f_tests.dictionary`."""
    one_sided = np.array([h.one_sided for h in members], dtype=bool)
    return dictionary(model_basis, columns, one_sided, np.array([h.weight for h in members]))


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
    def _signs_and_weights(self) -> tuple[NDArray[np.bool_], Array]:
        return np.array([h.one_sided for h in self.members], dtype=bool), np.array([h.weight for h in self.members])

    @cached_property
    def _with_label(self) -> dict[str, list[int]]:
        """Label of an effect -> indices of its hypotheses: one, or free and tied."""
        found: dict[str, list[int]] = {}
        for k, h in enumerate(self.members):
            found.setdefault(h.effect.label, []).append(k)
        return found

    def places_of(self, chosen: Sequence[Hypothesis]) -> list[int]:
        """Indices of all members with the effects of these hypotheses, tied ones included."""
        return [k for h in chosen for k in self._with_label.get(h.effect.label, ())]

    def projected(self, model_basis: Array, columns: Columns, inside: Array | None = None) -> Dictionary:
        """All members with their whitened columns, projected off a fitted model: see `f_tests.dictionary`."""
        return dictionary(model_basis, columns, *self._signs_and_weights, inside)

    @cached_property
    def total_weight(self) -> float:
        """Sum of the prior weights of all effects."""
        return float(sum(h.weight for h in self.members if not h.tied))

    @cached_property
    def families(self) -> frozenset[str]:
        """Keys of effects with one parameter for each joint, of similar size."""
        return frozenset(h.key for h in self.members if h.tied)

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
        return tuple(h for h in self.members if not h.scanned and not h.tied and self.acts(h))

    def acts(self, hypothesis: Hypothesis) -> bool:
        """False if the effect only changes others (`Effect.through`) and the base model has none of those."""
        through = hypothesis.effect.through
        return not through or any(through in effect.needs for effect in self.base.effects)

    def shows_more(self, chosen: Sequence[Hypothesis]) -> bool:
        """True if some member shows through one of these (`Effect.through`) and through nothing that the arm has."""
        return any(h.effect.needs & self._not_shown for h in chosen)

    @cached_property
    def _not_shown(self) -> frozenset[str]:
        return frozenset(h.effect.through for h in self.members if not self.acts(h))

    @cached_property
    def changing(self) -> NDArray[np.int64]:
        """(k,) indices of the members whose columns depend on such effects in the fitted model."""
        return np.array([k for k, h in enumerate(self.members) if h.effect.needs & self._not_shown], dtype=np.int64)

    def changed_columns(self, rows: Rows, found: Fit) -> Array:
        """(N, r) whitened columns of the members `changing`, side by side, at a fit to these rows."""
        levers, state = found.model.place_levers(rows.postures, found.values, rows.conditions)
        columns: dict[int, Array] = {}
        for bundle in self._changing_bundles:
            columns |= bundle.columns(levers, bundle.slopes(rows.postures, rows.conditions, state))
        return rows.whiten(np.concatenate(self._listed(self.changing.tolist(), columns), axis=2))

    @cached_property
    def _changing_bundles(self) -> tuple[Bundle, ...]:
        some = ((int(k), self.members[k]) for k in self.changing)
        return bundles(self.arm, [(number, h.effect) for number, h in some if not h.tied])

    @cached_property
    def _bundles(self) -> tuple[Bundle, ...]:
        return bundles(self.arm, [(number, h.effect) for number, h in enumerate(self.members) if not h.tied])

    def slopes(self, rows: Rows) -> Slopes:
        """The part of the columns that does not depend on the fit, shared by all fits to the same rows."""
        state = np.zeros((len(rows), state_size(self.arm.links, self.arm.dimension)))
        return [b.slopes(rows.postures, rows.conditions, state) if b.fixed else None for b in self._bundles]

    def matrix(
        self, rows: Rows, values: Mapping[str, float], slopes: Slopes | None = None, model: Model | None = None
    ) -> Columns:
        """`columns` of all members side by side, whitened; built in parts of about `CHUNK` numbers."""
        stacked = np.empty((len(rows), rows.dimension, int(self.sizes.sum())))
        step = max(CHUNK // max(stacked[0].size, 1), 1)
        for part in (slice(k, k + step) for k in range(0, len(rows), step)):
            known = None if slopes is None else [None if s is None else s[part] for s in slopes]
            stacked[part] = np.concatenate(self.columns(rows.pick(part), values, known, model), axis=2)
        return Columns(rows.whiten(stacked), self.sizes)

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
        return self._listed(range(len(self.members)), found)

    def _listed(self, numbers: Iterable[int], columns: Mapping[int, Array]) -> list[Array]:
        """Columns (m, d, size) of these members, from those of the members that are not tied, by their numbers."""
        free = {self.members[k].label: found for k, found in columns.items()}
        some = (self.members[k] for k in numbers)
        return [free[h.free.label].sum(axis=2, keepdims=True) if h.tied else free[h.label] for h in some]


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
    """The hypotheses of one effect at one joint: one for each setting, or free and tied."""
    arm, scans = scope.arm, [Setting.of(setting).scan(scope) for setting in cls.settings.values()]
    specs = [replace(spec, values=dict(zip(cls.settings, chosen, strict=True))) for chosen in product(*scans)]
    weight = cls.prior * (1.0 if spec.joint is None else 1.0 / np.sqrt(arm.links)) / max(len(specs), 1)
    found = [Hypothesis(build(s, arm.links, arm.lengths, dimension=arm.dimension), s, weight) for s in specs]
    if not cls.settings and len(found[0].effect.parameters) > 1 and found[0].one_sign:
        found.append(replace(found[0], tied=True))
    return found
