"""The dictionary: blocks that may be missing, foremost every effect that this arm and these data can show.

Effects with settings (the order k of a gear ripple, the time of a step) are scanned: each value is a block, and
together they have the weight of one unscanned effect. Gears cause waves with hundreds of periods per turn and of orders
that are not whole numbers. All of them have the weight of one order together; only those that explain most at each
joint are added to the dictionary, as the others have no probability to speak of.

The column of an effect is the lever of its place in the chain (derivative of the position with respect to what is added
there, the same for all effects) times the slope (derivative of what is added with respect to the effect's parameter).
One CasADi function with the settings as arguments gives the slopes of one effect at all joints for all values tried.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.conditions import BY_ORDER, FOLLOWING
from identification.effects import Effect, Scope, Setting, build, build_all, of_dimension
from identification.effects.chain import Chain, condition_slices, contributions, in_state, state_slices
from identification.effects.formulas import RARE
from identification.gap.fit import At, Rows
from identification.information import column_space
from identification.kinematics.parameters import PRISMATIC
from identification.model import Model
from identification.vectorize import Evaluate, vectorize

EFFECT, ORDER = "transmission_ripple", "k"
ORDERS = np.arange(3.0, 256.25, 0.25)  # periods per turn; derived: every wave between has a likeness of 0.97 with one
PLACES = {"base_drift": "time", "base_rotation_drift": "time", "base_step": "time", "axes_skew": "workspace"}


@dataclass(frozen=True)
class Block:
    """One thing that may be missing.

    label : unique, with scanned settings: `transmission_ripple:2[k=6]`
    place : `joint:j`, `time`, `temperature`, `workspace`, `row:i` (from 0), or the effect's name
    weight : prior weight: 1 for an effect of the whole arm, n^(-1/2) at each of n joints (between one for each joint
        and one for all joints together), divided by the number of scanned settings, times the effect's own `prior`
    effect, spec : of the library, None: outside;  through : kind of effects that alone it shows through
    span : of an error curve the joint (from 0) and its first and last angle [rad]
    parts : effects that the rest of the library has in it: many small ones, that cannot be told apart
    columns : outside the library, its (m, d, p) columns at other rows
    """

    label: str
    place: str
    weight: float
    effect: Effect | None = None
    spec: EffectSpec | None = None
    through: str = ""
    span: tuple[int, float, float] | None = None
    parts: tuple[Block, ...] = ()
    columns: Callable[[At], Array] | None = None

    @classmethod
    def of(cls, arm: Arm, spec: EffectSpec, weight: float, kinds: frozenset[str] = frozenset()) -> Block:
        """An effect of an arm.

        weight : of an effect that acts at all joints, less at one of them;  kinds : what the arm's effects need
        """
        effect = build(spec, arm.chain)
        place = PLACES.get(spec.name, spec.name) if spec.joint is None else f"joint:{spec.joint}"
        through = "" if effect.through in kinds else effect.through
        return cls(effect.label, place, weight / np.sqrt(arm.links if spec.joint else 1), effect, spec, through)

    @property
    def key(self) -> str:
        """`name` or `name:joint` of an effect, without the scanned setting; else its place."""
        return self.place if self.spec is None else self.spec.key

    @property
    def row(self) -> int | None:
        """Number from 0 of the single row that it shifts."""
        return int(self.place[4:]) if self.place.startswith("row:") else None

    @property
    def plain(self) -> bool:
        """Whether it is an effect without a scanned setting that can act on the base model."""
        return self.effect is not None and not self.effect.chosen and not self.through

    @cached_property
    def size(self) -> int:
        """Number of parameters of an effect."""
        return 0 if self.effect is None else len(self.effect.parameters)

    @cached_property
    def bounded(self) -> bool:
        """True for an effect whose parameters cannot be negative."""
        return self.effect is not None and all(p.lower == 0.0 for p in self.effect.parameters)

    @property
    def family(self) -> bool:
        """True for an effect with one similar parameter for each joint, which cannot be negative."""
        return self.size > 1 and self.bounded and self.effect is not None and not self.effect.chosen


@lru_cache
def _modelled(arm: Arm, classes: tuple[type[Effect], ...]) -> Model:
    """Model of an arm;  classes : of its effects, part of the key as users can redefine an effect"""
    return Model(arm)


@dataclass(frozen=True)
class Library:
    """All effects that an arm may lack, and the reasons why others are not among them.

    skipped : effect key -> reason
    aliases : effect name -> base parameters it cannot be distinguished from by any measurement of the tip
    """

    arm: Arm
    members: tuple[Block, ...]
    skipped: Mapping[str, str]
    aliases: Mapping[str, str]

    @cached_property
    def base(self) -> Model:
        """Model of the arm without further effects."""
        return self.model(())

    def model(self, chosen: Sequence[Block]) -> Model:
        """Model of the arm with these effects, in the order of the members."""
        places, classes = {b.label: k for k, b in enumerate(self.members)}, of_dimension(self.arm.dimension)
        ordered = sorted(chosen, key=lambda b: places.get(b.label, len(places)))
        arm = self.arm.with_effects(*self.arm.effects, *(b.spec for b in ordered if b.spec is not None))
        return _modelled(arm, tuple(classes[spec.name] for spec in arm.effects))

    def as_base(self, at: At) -> tuple[Array, Array, list[int]]:
        """Rows as the base model sees them at a fit: (m, d) measured less computed positions, where what the fit has
        beyond it is given back; and the fit's (m, d, p) columns, and which of them are the base's."""
        own = [p.name for effect in self.base.effects for p in effect.parameters]
        there = [p.name for effect in at.model.effects[: len(self.base.effects)] for p in effect.parameters]
        renamed = dict(zip(own, there, strict=True))  # similar effects change their names
        base = [at.model.parameters.index(renamed.get(name, name)) for name in self.base.names]
        jacobian, added = at.linearized[1], np.setdiff1d(np.arange(len(at.values)), base)
        return at.left + jacobian[:, :, added] @ at.values[added], jacobian, base

    def columns(self, at: At) -> list[Array]:
        """For each member the (m, d, size) derivative of the position with respect to its parameters, at their neutral
        values."""
        q, conditions, gravity = at.rows.postures, at.rows.conditions, self.arm.gravity
        levers, state = at.model.place_levers(q, at.values, conditions)
        effects = [block.effect for block in self.members if block.effect is not None]
        remembers, payload = any("past" in e.needs for e in effects), 0.0 if gravity is None else gravity.payload
        given = q[:, None], conditions.table(len(q), self.arm.links, payload, q if remembers else None)[:, None]
        groups: dict[type[Effect] | None, list[tuple[Key, int]]] = {}
        for number, e in enumerate(effects):  # the settings of a scan are arguments of one function
            symbolic = bool(e.chosen) and all(Setting.of(setting).symbolic for setting in e.settings.values())
            key = type(e), e.joint, tuple(e.chosen if symbolic else e.chosen.items())
            groups.setdefault(type(e) if symbolic else None, []).append((key, number))
        columns = [np.zeros((*levers.shape[:2], len(e.parameters))) for e in effects]
        for group, members in groups.items():
            tried = [tuple(effects[k].chosen.values()) if group else () for _, k in members]
            settings, keys = {values: k for k, values in enumerate(dict.fromkeys(tried))}, [key for key, _ in members]
            arm = Arm(self.arm.chain, gravity=gravity)  # all that the formulas have in them
            function, places = _slopes(arm, remembers, tuple(dict.fromkeys(keys)))
            slopes = function(*given, state[:, None], np.array([*settings])[None])[0][..., 0]  # (m, K, Z)
            for key, values, (_, number) in zip(keys, tried, members, strict=True):
                for column, place, nonzero in places[key]:
                    columns[number][:, :, column] += levers[:, :, place] * slopes[:, settings[values], nonzero, None]
        return columns


# an effect's class, joint, and names of its settings where they are scanned, else names and values
Key = tuple[type[Effect], int | None, tuple[Any, ...]]


@lru_cache(maxsize=8)
def _chains(arm: Arm, remembers: bool) -> tuple[tuple[ca.SX, ca.SX, ca.SX], Chain, Chain]:
    """CasADi symbols of posture (n), conditions and state, and the nominal chain, without and with loads."""
    extra = ("past",) * remembers
    ends = (max(p.stop for p in s.values()) for s in (condition_slices(arm.links, extra), state_slices(arm.chain)))
    q, c, state = ca.SX.sym("q", arm.links), *map(ca.SX.sym, ("c", "state"), ends)
    chain = Chain.of(arm, q, c, extra)
    return (q, c, state), chain, in_state(chain, state)


@lru_cache
def _slopes(arm: Arm, remembers: bool, keys: tuple[Key, ...]) -> tuple[Evaluate, dict[Key, list[tuple[int, int, int]]]]:
    """Function of arrays (q, c, state, settings) that gives the Z slopes of some effects that are not identically
    zero, (..., Z, 1); and of each effect (its parameter, place, number of the slope)."""
    symbols, chain, loaded = _chains(arm, remembers)
    scanned = {s: ca.SX.sym(s) for _, _, settings in keys for s in settings if isinstance(s, str)}
    slopes: list[ca.SX] = []
    places: dict[Key, list[tuple[int, int, int]]] = {}
    for key in keys:
        cls, joint, settings = key
        effect = cls(arm.chain, joint, dict((s, scanned[s]) if isinstance(s, str) else s for s in settings))
        v, neutral = ca.SX.sym("v", len(effect.parameters)), ca.DM([p.neutral for p in effect.parameters])
        added = contributions(effect, chain, loaded, v, symbols[2])
        slope, first = ca.sparsify(ca.substitute(ca.jacobian(added, v), v, neutral)), sum(s.numel() for s in slopes)
        nonzero = enumerate(zip(*slope.sparsity().get_triplet(), strict=True), start=first)
        places[key] = [(column, place, number) for number, (place, column) in nonzero]
        slopes.append(ca.SX(slope.nz[:]))
    inputs = [*symbols, ca.SX(ca.vertcat(*scanned.values()))]
    return vectorize(ca.Function("slopes", inputs, [ca.cse(ca.vertcat(*slopes))])), places


def hypotheses(arm: Arm, given: frozenset[str], rows: Rows | None = None) -> Library:
    """All effects that an arm and its data can show.

    given : conditions that the data have beyond `BY_ORDER`: `temperature`
    rows : the data, on which scanned settings may depend; None: settings that suit any data
    """
    available = set(BY_ORDER | (given & {"temperature"})) | arm.offers
    available -= FOLLOWING if rows is not None and not rows.conditions.follow else set()
    available |= set() if arm.gravity is None else {"gravity"}
    known, base = of_dimension(arm.dimension), Model(arm)
    kinds, own = frozenset(base.needs), {effect.label for effect in build_all(arm.effects, arm.chain)}
    unseen = frozenset[int]() if rows is None else untested_joints(At(base, base.values, rows))
    members: list[Block] = []
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
            each = [Block.of(arm, one, cls.prior / max(len(specs), 1), kinds) for one in specs]
            further = [block for block in each if block.label not in own]
            members += further
            if not further:
                skipped[spec.key] = "already in the arm's model"
    aliases = {name: cls.alias for name, cls in known.items() if cls.alias is not None}
    return Library(arm, tuple(members), skipped, aliases)


def untested_joints(at: At) -> frozenset[int]:
    """Joints (from 1) at which no joint effect is tested.

    These are prismatic joints, since joint effects describe rotary encoders and gears, and joints with an RMS lever
    below a thousandth of the reach: a reflector on the last axis does not move with that joint, and a fraction of a
    micrometre would correspond to degrees.
    """
    sizes = np.sqrt(np.mean(np.sum(at.levers**2, axis=1), axis=0))
    sliding = np.array([kind == PRISMATIC for kind in at.model.joint_types])
    return frozenset((np.flatnonzero(sliding | (sizes < 1e-3 * at.model.reach)) + 1).tolist())


def with_further_orders(library: Library, at: At, chosen: Sequence[Block]) -> Library:
    """The library with the ripple of further order that explains most at each joint, and its neighbors, if it is clear.

    at : fit of the chosen effects, with any noise model
    """
    arm, known, names, rows = library.arm, {b.label for b in library.members}, at.model.names, at.rows
    if not any(b.key.partition(":")[0] == EFFECT for b in library.members):
        return library
    unseen, added, labels = untested_joints(at), list[Block](), {b.label for b in chosen}
    jacobian = at.linearized[1]
    for j, q in enumerate(rows.postures.T):
        if np.ptp(q) == 0.0 or j + 1 in unseen:
            continue
        # what is named at this joint may be there instead of the wave
        effects = [e for e in at.model.effects if e.joint == j + 1 and e.label in labels]
        own = [names.index(p.name) for e in effects for p in e.parameters if p.name in names]
        rest = np.setdiff1d(np.arange(len(names)), own)
        y = rows.whiten(at.left + jacobian[:, :, own] @ at.values[own])
        basis = column_space(rows.whiten(jacobian[:, :, rest]), at.model.scales[rest])
        y = y - basis @ (basis.T @ y)
        gains = []  # share of y^T y that a wave of each order explains
        for orders in np.array_split(ORDERS, 8):
            angles = q[:, None] * orders
            waves = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
            x = rows.whiten(at.levers[:, :, j, None] * waves[:, None, :])
            inside, scores = (basis.T @ x).reshape(basis.shape[1], -1, 2), (y @ x).reshape(-1, 2)  # y is off the basis
            x = x.reshape(len(x), -1, 2)
            gram = np.einsum("nki,nkj->kij", x, x) - np.einsum("nki,nkj->kij", inside, inside)
            gram += (1e-9 * np.einsum("kii->k", gram)[:, None, None] + 1e-300) * np.eye(2)
            solved = np.linalg.solve(gram, scores[:, :, None])[:, :, 0]
            gains.append(np.einsum("ki,ki->k", scores, solved) / max(y @ y, 1e-300))
        shares, freedom = np.concatenate(gains), len(y) - basis.shape[1]
        best = int(np.argmax(np.round(shares, 12)))
        # convention: log likelihood ratio below which a wave of further order is not added
        if freedom < 3 or -0.5 * freedom * np.log1p(-min(shares[best], 1.0 - 1e-12)) < 8.0:
            continue
        for order in ORDERS[best] + np.array([-0.125, 0.0, 0.125]):  # likeness 0.99 with every one between
            one = Block.of(arm, EffectSpec(EFFECT, j + 1, {ORDER: float(order)}), RARE / len(ORDERS))
            added += [one] if one.label not in known else []
    return replace(library, members=(*library.members, *added)) if added else library
