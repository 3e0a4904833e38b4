"""The dictionary: everything that may be missing, foremost every effect that this arm and these data can show.

A hypothesis is one effect at one joint, or of the whole arm. Effects with settings (the order k of a gear ripple, the
time of a step) are scanned: each value is a hypothesis, and together they have the weight of one unscanned effect.

Gears cause waves with hundreds of periods per turn and of orders that are not whole numbers. All of them are
hypotheses, with the weight of one order among all; only those that explain most at each joint are added to the
dictionary, as the others have no probability to speak of.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.conditions import BY_ORDER, FOLLOWING
from identification.effects import Effect, Scope, Setting, build, build_all, of_dimension
from identification.effects.formulas import RARE
from identification.gap.columns import Basis, Bundle, Where, bundles
from identification.gap.fit import Fit, Rows
from identification.information import column_space
from identification.kinematics.parameters import PRISMATIC
from identification.model import Model

EFFECT, ORDER = "transmission_ripple", "k"
ORDERS = np.arange(3.0, 256.25, 0.25)  # periods per turn; derived: every wave between has a likeness of 0.97 with one
PLACES = {"base_drift": "time", "base_rotation_drift": "time", "base_step": "time", "axes_skew": "workspace"}


@dataclass(frozen=True)
class Block:
    """One thing that may be missing.

    label : unique;  place : `joint:j`, `time`, `temperature`, `workspace`, `row:i` (from 0), or the effect's name
    weight : prior weight: 1 for an effect of the whole arm, n^(-1/2) at each of n joints (between one for each joint
        and one for all joints together), divided by the number of scanned settings, times the effect's own `prior`
    basis : of an error curve
    parts : effects that the rest of the library has in it: many small ones, that cannot be told apart
    columns : outside the library, its (m, d, p) columns at other postures
    """

    label: str
    place: str
    weight: float
    basis: Basis | None = None
    parts: tuple[Block, ...] = ()
    columns: Callable[[Where], Array] | None = None

    @property
    def key(self) -> str:
        """`name:joint` of an effect, without settings; else its place."""
        return self.place

    @property
    def member(self) -> Hypothesis | None:
        """Itself if it is an effect of the library."""
        return None

    @property
    def row(self) -> bool:
        """Whether it is the shift of a single row."""
        return self.place.startswith("row:")

    @property
    def named(self) -> bool:
        """Whether it is an effect of the library."""
        return self.member is not None

    @property
    def written(self) -> bool:
        """Whether an arm file can have it."""
        return self.named or self.basis is not None


@dataclass(frozen=True, kw_only=True)
class Hypothesis(Block):
    """An effect of the library; its label has the scanned setting: `transmission_ripple:2[k=6]`."""

    effect: Effect
    spec: EffectSpec

    @classmethod
    def of(cls, arm: Arm, spec: EffectSpec, weight: float) -> Hypothesis:
        """An effect of an arm;  weight : of an effect that acts at all joints, less at one of them"""
        effect = build(spec, arm.chain)
        if spec.joint is None:
            return cls(effect.label, PLACES.get(spec.name, spec.name), weight, effect=effect, spec=spec)
        return cls(effect.label, f"joint:{spec.joint}", weight / np.sqrt(arm.links), effect=effect, spec=spec)

    @property
    def key(self) -> str:
        """`name` or `name:joint`, without the scanned setting."""
        return self.spec.key

    @property
    def member(self) -> Hypothesis:
        """Itself."""
        return self

    @property
    def scanned(self) -> bool:
        """True if the effect has a scanned setting."""
        return bool(self.effect.chosen)

    @cached_property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.effect.parameters)

    @property
    def family(self) -> bool:
        """True for an effect with one similar parameter for each joint, which cannot be negative."""
        return not self.scanned and self.size > 1 and all(p.lower == 0.0 for p in self.effect.parameters)

    @cached_property
    def one_sided(self) -> bool:
        """True for a single parameter that cannot be negative."""
        return self.size == 1 and self.effect.parameters[0].lower == 0.0


@lru_cache
def _modelled(arm: Arm, classes: tuple[type[Effect], ...]) -> Model:
    """Model of an arm;  classes : of its effects, part of the key as users can redefine an effect"""
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
    def base(self) -> Model:
        """Model of the arm without further effects."""
        return self.model(())

    def model(self, chosen: Sequence[Hypothesis]) -> Model:
        """Model of the arm with the effects of these hypotheses, in the order of the members."""
        places, classes = {h.label: k for k, h in enumerate(self.members)}, of_dimension(self.arm.dimension)
        ordered = sorted(chosen, key=lambda h: places.get(h.label, len(places)))
        arm = self.arm.with_effects(*self.arm.effects, *(h.spec for h in ordered))
        return _modelled(arm, tuple(classes[spec.name] for spec in arm.effects))

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

    def as_base(self, at: Fit, rows: Rows) -> tuple[Array, Array, list[int]]:
        """These rows as the base model sees them at a fit: (m, d) measured less computed positions, where what the fit
        has beyond it is given back; and the fit's (m, d, p) columns, and which of them are the base's."""
        base = self.own_places(at.model)
        position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
        added = np.setdiff1d(np.arange(len(at.values)), base)
        return rows.positions - position + jacobian[:, :, added] @ at.values[added], jacobian, base

    def acts(self, hypothesis: Hypothesis) -> bool:
        """False if the effect only changes others (`Effect.through`) and the base model has none of those."""
        through = hypothesis.effect.through
        return not through or any(through in effect.needs for effect in self.base.effects)

    @cached_property
    def _bundles(self) -> tuple[Bundle, ...]:
        return bundles(self.arm, [(number, h.effect) for number, h in enumerate(self.members)])

    def columns(self, rows: Rows, values: Mapping[str, float], model: Model | None = None) -> list[Array]:
        """For each member the (m, d, size) derivative of the position with respect to its parameters.

        values : parameters of `model` (None: the base model); the effect's own are at their neutral values
        """
        model = model or self.base
        levers, state = model.place_levers(rows.postures, model.parameters.vector(values), rows.conditions)
        columns: dict[int, Array] = {}
        for bundle in self._bundles:
            columns |= bundle.columns(rows.postures, rows.conditions, state, levers)
        return [columns[k] for k in range(len(self.members))]


def hypotheses(arm: Arm, given: frozenset[str], rows: Rows | None = None) -> HypothesisSet:
    """All effects that an arm and its data can show.

    given : conditions that the data have beyond `BY_ORDER`: `temperature`
    rows : the data, on which scanned settings may depend; None: settings that suit any data
    """
    available = set(BY_ORDER | (given & {"temperature"}))
    available -= FOLLOWING if rows is not None and not rows.conditions.follow else set()
    available |= set() if arm.gravity is None else {"gravity"}
    available |= arm.offers
    known = of_dimension(arm.dimension)
    own = {effect.label for effect in build_all(arm.effects, arm.chain)}
    unseen = frozenset[int]() if rows is None else untested_joints(Model(arm), rows)
    members: list[Hypothesis] = []
    skipped: dict[str, str] = {}
    for name, cls in known.items():
        if cls.alias or cls.scatter or cls.nuisance or cls.of_commands or cls.tabulated:
            continue  # does not act on the mean, is no fault of the arm, or cannot be told from the base parameters
        if "distance" in cls.needs - available or (cls.of_positions and not arm.chain.instrument.reads_positions):
            continue  # of another instrument: nothing that these data lack
        if missing := sorted(cls.needs - available):
            skipped[name] = f"needs {', '.join(missing)}"
            continue
        joints: list[int | None] = [*range(cls.first_joint, arm.links + 1)]
        whole: list[int | None] = [] if cls.per_joint == "required" else [None]
        for joint in whole + (joints if cls.per_joint != "none" else []):
            spec = EffectSpec(name, joint)
            if joint in unseen and hasattr(cls, "joint_angles"):
                skipped[spec.key] = "the joint slides, or hardly moves the measured point"
                continue
            scope = Scope(arm, joint) if rows is None else Scope(arm, joint, rows.postures, rows.conditions)
            scans = [Setting.of(setting).scan(scope) for setting in cls.settings.values()]
            specs = [replace(spec, values=dict(zip(cls.settings, chosen, strict=True))) for chosen in product(*scans)]
            each = [Hypothesis.of(arm, one, cls.prior / max(len(specs), 1)) for one in specs]
            further = [h for h in each if h.effect.label not in own]
            members += further
            if not further:
                skipped[spec.key] = "already in the arm's model"
    aliases = {name: cls.alias for name, cls in known.items() if cls.alias is not None}
    return HypothesisSet(arm, tuple(members), skipped, aliases)


def untested_joints(model: Model, rows: Rows) -> frozenset[int]:
    """Joints (from 1) at which no joint effect is tested.

    These are prismatic joints, since joint effects describe rotary encoders and gears, and joints with an RMS lever
    below a thousandth of the reach: a reflector on the last axis does not move with that joint, and a fraction of a
    micrometre would correspond to degrees.
    """
    levers = model.joint_levers(rows.postures, None, rows.conditions)
    sizes = np.sqrt(np.mean(np.sum(levers**2, axis=1), axis=0))
    sliding = np.array([kind == PRISMATIC for kind in model.joint_types])
    return frozenset((np.flatnonzero(sliding | (sizes < 1e-3 * model.reach)) + 1).tolist())


def with_further_orders(library: HypothesisSet, rows: Rows, at: Fit, chosen: Sequence[Hypothesis]) -> HypothesisSet:
    """The library with the ripple of further order that explains most at each joint, and its neighbors, if it is clear.

    at : fit of the chosen effects;  rows : with any noise model
    """
    arm, known = library.arm, {h.label for h in library.members}
    if not any(h.effect.name == EFFECT for h in library.members):
        return library
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    levers = at.model.joint_levers(rows.postures, at.values, rows.conditions)
    unseen, added = untested_joints(at.model, rows), []
    labels, names = {h.label for h in chosen}, at.model.names
    for j in range(arm.links):
        q = rows.postures[:, j]
        if np.ptp(q) == 0.0 or j + 1 in unseen:
            continue
        # what is named at this joint may be there instead of the wave
        own = [
            names.index(p.name)
            for e in at.model.effects
            for p in e.parameters
            if e.joint == j + 1 and e.label in labels and p.name in names
        ]
        rest = np.setdiff1d(np.arange(len(at.values)), own)
        y = rows.whiten(rows.positions - position + jacobian[:, :, own] @ at.values[own])
        basis = column_space(rows.whiten(jacobian[:, :, rest]), at.model.scales[rest])
        y = y - basis @ (basis.T @ y)
        gains = np.concatenate([_gains(rows, basis, y, levers[:, :, j], q, some) for some in np.array_split(ORDERS, 8)])
        best = int(np.argmax(np.round(gains, 12)))
        freedom = len(y) - basis.shape[1]
        # convention: log likelihood ratio below which a wave of further order is not added
        if freedom < 3 or -0.5 * freedom * np.log1p(-min(gains[best], 1.0 - 1e-12)) < 8.0:
            continue
        for order in ORDERS[best] + np.array([-0.125, 0.0, 0.125]):  # likeness 0.99 with every one between
            spec = EffectSpec(EFFECT, j + 1, {ORDER: float(order)})
            one = Hypothesis.of(arm, spec, RARE / len(ORDERS))
            if one.label not in known:
                added.append(one)
    return replace(library, members=(*library.members, *added)) if added else library


def _gains(rows: Rows, basis: Array, y: Array, lever: Array, q: Array, orders: Array) -> Array:
    """(K,) share of y^T y that a wave of each order explains, projected off a basis."""
    angles = q[:, None] * orders
    waves = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
    x = rows.whiten(lever[:, :, None] * waves[:, None, :])
    inside, scores = (basis.T @ x).reshape(basis.shape[1], -1, 2), (y @ x).reshape(-1, 2)  # y is off the basis
    x = x.reshape(len(x), -1, 2)
    gram = np.einsum("nki,nkj->kij", x, x) - np.einsum("nki,nkj->kij", inside, inside)
    gram += 1e-9 * np.einsum("kii->k", gram)[:, None, None] * np.eye(2) + 1e-300 * np.eye(2)
    return np.asarray(
        np.einsum("ki,ki->k", scores, np.linalg.solve(gram, scores[:, :, None])[:, :, 0]) / max(y @ y, 1e-300)
    )
