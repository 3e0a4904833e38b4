"""The dictionary: all blocks that may be missing, linearized at a fitted model, with columns scaled to unit size.

Blocks that are not effects of the library say where something is missing, but not what. An effect with settings has one
block for each value of the settings; together these have the weight of one effect without settings.

An effect adds something at one place of the chain, such as a joint angle. Its column is the lever of that place (the
derivative of the position with respect to the addition, the same for all effects) times the slope (the derivative of
the addition with respect to the effect's parameter). One CasADi function gives the slopes at all joints and settings.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

from identification.arm import Arm, EffectSpec, splines
from identification.arrays import Array, slices
from identification.effects import Effect, Scope, build, of_dimension
from identification.effects.base import OF_LOAD, ArmState, contribution, widths
from identification.effects.formulas import RARE
from identification.gap.fit import Fitted, Rows
from identification.gap.likelihood import SIZES, Products
from identification.information import RANK_TOLERANCE, VISIBLE, significant, spectrum
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.measurements import BY_ORDER, FOLLOWING, condition_columns
from identification.model import Model
from identification.vectorized import Evaluate, vectorize

RIPPLE, RIPPLE_ORDER = "transmission_ripple", "k"
ORDERS = np.arange(3.0, 256.25, 0.25)  # periods per turn; derived: every wave between has a likeness of 0.97 with one
# numerical: expected square of a combination of columns at the block's largest size, below which it is left out
FAINT = 0.03
OUTSIDE = 0.02  # prior weight of everything outside the library at one place, beside an effect of the whole arm
WAVES = 30  # half periods of an error curve over the angles of its joint; convention: what a person would call smooth
HOLE = 0.5 * np.pi  # convention: angles without a row that are no part of what was measured


# -- effects of the library --------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Block:
    """One thing that may be missing.

    label : unique, with scanned settings: `transmission_ripple:2[k=6]`
    place : `joint:j`; else the first word of its name: `time`, `temperature`, `workspace`, `row`
    weight : in the prior of sets (identification/README.md, "One posterior")
    effect : None where an arm file has no such effect;  through : kind of effects that alone it shows through
    span : of an error curve the joint (from 0) and its first and last angle [rad]
    rows : numbers from 0 of the row that it shifts, or of those of a posture of which joints were misread
    """

    label: str
    place: str
    weight: float
    effect: Effect | None = None
    through: str = ""
    span: tuple[int, float, float] | None = None
    rows: tuple[int, ...] = ()

    @classmethod
    def of(cls, arm: Arm, spec: EffectSpec, weight: float, kinds: frozenset[str] = frozenset()) -> Block:
        """An effect of an arm.

        weight : of an effect that acts at all joints, less at one of them;  kinds : what the arm's effects need
        """
        effect = build(spec, arm.chain)
        place = spec.name.partition("_")[0] if spec.joint is None else f"joint:{spec.joint}"
        weight *= OUTSIDE if effect.unlisted else 1.0
        through = "" if effect.through in kinds else effect.through
        return cls(effect.label, place, weight / np.sqrt(arm.links if spec.joint else 1), effect, through)

    @cached_property
    def key(self) -> str:
        """`name` or `name:joint` of an effect, without the scanned setting; else its place."""
        return self.place if self.effect is None else self.effect.spec.key

    @cached_property
    def listed(self) -> bool:
        """Whether it is an effect of the library that can be named."""
        return self.effect is not None and not self.effect.unlisted

    @cached_property
    def outside(self) -> bool:
        """Whether it is something outside the library, at a place."""
        return not self.listed and not self.rows

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


@dataclass(frozen=True)
class Library:
    """All effects that an arm may lack, and the reasons why others are not among them.

    unlisted : errors of any form that an arm file can have
    skipped : effect key -> reason
    aliases : effect name -> base parameters it cannot be distinguished from by any measurement of the tip
    """

    arm: Arm
    members: tuple[Block, ...]
    unlisted: tuple[Block, ...]
    skipped: Mapping[str, str]
    aliases: Mapping[str, str]

    @cached_property
    def base(self) -> Model:
        """Model of the arm without further effects."""
        return self.model(())

    def model(self, chosen: Sequence[Block]) -> Model:
        """Model of the arm with these effects."""
        return Model(self.arm.with_effects(*self.arm.effects, *(b.effect.spec for b in chosen if b.effect)))

    def renamed(self, model: Model) -> dict[str, str]:
        """Name of each parameter of the arm's effects -> its name in a model with further effects: similar ones change
        their names."""
        models = self.base, model
        of_effects = ([p.name for e in each.effects[: len(self.base.effects)] for p in e.parameters] for each in models)
        return dict(zip(*of_effects, strict=True))

    def with_further_orders(self, at: Fitted, chosen: Sequence[Block]) -> Library:
        """The library with the ripple of further order that explains most at each joint, and its neighbors, if it is
        clear.

        at : fit of the chosen effects, with any noise model
        """
        arm, rows, unseen, added = self.arm, at.rows, untested_joints(at), list[Block]()
        listed, labels = {b.label for b in self.members}, {b.label for b in chosen}
        if not any(b.key.partition(":")[0] == RIPPLE for b in self.members):
            return self
        for j, q in enumerate(rows.postures.T):
            if np.ptp(q) == 0.0 or j + 1 in unseen or arm.joint_types[j] == PRISMATIC:
                continue
            # what is named at this joint may be there instead of the wave
            named = at.columns_of(*(e for e in at.model.effects if e.joint == j + 1 and e.label in labels))
            rest = np.setdiff1d(np.arange(len(at.values)), named)
            y = rows.whiten(at.errors + at.linearized[1][:, :, named] @ at.values[named])
            columns = at.jacobian[:, rest]
            basis = columns @ spectrum(columns, at.model.scales[rest]).root
            y = y - basis @ (basis.T @ y)
            gains = []  # share of y^T y that a wave of each order explains
            for orders in np.array_split(ORDERS, 8):
                angles = q[:, None] * orders
                waves = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(len(q), -1)
                x = np.ascontiguousarray(rows.whiten(at.levers[:, :, j, None] * waves[:, None, :]).T)
                inside, scores = (x @ basis).reshape(len(orders), 2, -1), (x @ y).reshape(-1, 2)  # y is off the basis
                x = x.reshape(len(orders), 2, -1)
                gram = x @ x.transpose(0, 2, 1) - inside @ inside.transpose(0, 2, 1)
                gram += (1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(2)
                solved = np.linalg.solve(gram, scores[:, :, None])[:, :, 0]
                gains.append(np.sum(scores * solved, axis=1) / max(y @ y, 1e-300))
            shares, freedom = np.concatenate(gains), len(y) - basis.shape[1]
            best = int(np.argmax(np.round(shares, 12)))
            # convention: log likelihood ratio below which a wave of further order is not added
            if freedom < 3 or -0.5 * freedom * np.log1p(-min(shares[best], 1.0 - 1e-12)) < 8.0:
                continue
            for order in ORDERS[best] + np.array([-0.125, 0.0, 0.125]):  # likeness 0.99 with every one between
                one = Block.of(arm, EffectSpec(RIPPLE, j + 1, {RIPPLE_ORDER: float(order)}), RARE / len(ORDERS))
                added += [one] if one.label not in listed else []
        return replace(self, members=(*self.members, *added)) if added else self

    def as_base(self, at: Fitted) -> tuple[Array, list[int]]:
        """Rows as the base model sees them at a fit: (m, d) measured less computed positions, where what the fit has
        beyond it is given back; and which of the fit's parameters are the base's."""
        renamed = self.renamed(at.model)
        base = [at.model.parameters.index(renamed.get(name, name)) for name in self.base.names]
        added = np.setdiff1d(np.arange(len(at.values)), base)
        return at.errors + at.linearized[1][:, :, added] @ at.values[added], base

    def columns(self, at: Fitted, blocks: Sequence[Block]) -> list[Array]:
        """Of blocks that are effects the (m, d, size) derivatives of the position with respect to their parameters, at
        their neutral values."""
        q, conditions = at.rows.postures, at.rows.conditions
        levers, state = at.model.place_levers(q, at.values, conditions)
        effects = [block.effect for block in blocks if block.effect is not None]
        remembers = any("past" in e.needs for e in effects)
        table = conditions.table(condition_columns(self.arm.links, ("past",) * remembers), q, self.arm.payload)
        groups = defaultdict[type[Effect] | None, list[tuple[Key, tuple[float, ...], int]]](list)
        for number, e in enumerate(effects):  # the settings of a scan are arguments of one function
            symbolic = bool(e.chosen) and all(setting.symbolic for setting in e.settings.values())
            key = type(e), e.joint, tuple(e.chosen if symbolic else e.chosen.items())
            values = tuple(e.chosen.values()) if symbolic else ()
            groups[type(e) if symbolic else None].append((key, values, number))
        columns = [np.zeros((*levers.shape[:2], len(e.parameters))) for e in effects]
        arm = Arm(self.arm.chain, gravity=self.arm.gravity)  # all that the formulas have in them
        for members in groups.values():
            function, places = _slopes(arm, remembers, tuple(dict.fromkeys(key for key, _, _ in members)))
            tried = [*dict.fromkeys(values for _, values, _ in members)]
            slopes = function(q[:, None], table[:, None], state[:, None], np.array([tried]))[0][..., 0]  # (m, K, Z)
            for key, values, number in members:
                for column, place, nonzero in places[key]:
                    slope = slopes[:, tried.index(values), nonzero, None]
                    columns[number][:, :, column] += levers[:, :, place] * slope
        return columns


# an effect's class, joint, and names of its settings where they are scanned, else names and values
Key = tuple[type[Effect], int | None, tuple[Any, ...]]


@lru_cache
def _slopes(arm: Arm, remembers: bool, keys: tuple[Key, ...]) -> tuple[Evaluate, dict[Key, list[tuple[int, int, int]]]]:
    """Function of arrays (q, c, state, settings) that gives the Z slopes of some effects that are not identically
    zero, (..., Z, 1); and of each effect (its parameter, place, number of the slope)."""
    columns, sizes = condition_columns(arm.links, ("past",) * remembers), widths(arm.chain)
    where = slices({place: sizes[place] for place in OF_LOAD} | {"lengths": arm.links, "tip": arm.dimension})
    ends = (max(place.stop for place in each.values()) for each in (columns, where))
    q, c, state = ca.SX.sym("q", arm.links), *map(ca.SX.sym, ("c", "state"), ends)
    chain = ArmState.of(arm, q, c, columns)
    symbols: dict[str, Any] = {name: state[place] for name, place in where.items()}
    loaded = replace(chain, **{place: symbols[place] for place in OF_LOAD})
    scanned = {s: ca.SX.sym(s) for _, _, settings in keys for s in settings if isinstance(s, str)}
    slopes, places, count = list[ca.SX](), dict[Key, list[tuple[int, int, int]]](), 0
    for key in keys:
        cls, joint, settings = key
        effect = cls(arm.chain, joint, dict((s, scanned[s]) if isinstance(s, str) else s for s in settings))
        v, neutral = ca.SX.sym("v", len(effect.parameters)), ca.DM([p.neutral for p in effect.parameters])
        added = [
            contribution(effect, place, chain if place in OF_LOAD else loaded, v, symbols["lengths"], symbols["tip"])
            if hasattr(effect, place)
            else ca.SX.zeros(size)
            for place, size in sizes.items()
        ]
        slope = ca.sparsify(ca.substitute(ca.jacobian(ca.vertcat(*added), v), v, neutral))
        nonzero = enumerate(zip(*slope.sparsity().get_triplet(), strict=True), start=count)
        places[key] = [(column, place, number) for number, (place, column) in nonzero]
        slopes.append(ca.SX(slope.nz[:]))
        count += len(places[key])
    inputs = [q, c, state, ca.SX(ca.vertcat(*scanned.values()))]
    return vectorize(ca.Function("slopes", inputs, [ca.cse(ca.vertcat(*slopes))])), places


def hypotheses(arm: Arm, given: frozenset[str], rows: Rows | None = None) -> Library:
    """All effects that an arm and its data can show.

    given : conditions that the data have beyond `BY_ORDER`: `temperature`
    rows : the data, on which scanned settings may depend; None: settings that suit any data
    """
    available = set(BY_ORDER | (given & {"temperature"})) | arm.chain.instrument.offers
    available -= FOLLOWING if rows is not None and not rows.conditions.follow else set()
    available |= set() if arm.gravity is None else {"gravity"}
    classes, base = of_dimension(arm.dimension), Model(arm)
    kinds, modeled = frozenset(base.needs), {effect.label for effect in base.effects}
    unseen = frozenset[int]() if rows is None else untested_joints(Fitted(base, base.values, rows))
    members, unlisted, skipped = list[Block](), list[Block](), dict[str, str]()
    of_no_size = arm.chain.instrument.contact and arm.chain.size_is_open[0] != ""
    # a slide shows what the instrument calls a millimetre
    aliases = {name: cls.alias for name, cls in classes.items() if cls.alias and PRISMATIC not in arm.joint_types}
    for name, cls in classes.items():
        if name in aliases or cls.scatter or cls.nuisance or cls.of_commands or cls.tabulated:
            continue  # does not act on the mean, is no fault of the arm, or cannot be told from the base parameters
        if "distance" in cls.needs - available or (cls.of_positions and not arm.chain.instrument.reads_positions):
            continue  # of another instrument: nothing that these data lack
        if of_no_size and cls.unlisted and hasattr(cls, "joint_shifts"):
            continue  # its shifts may take back a step from joint to joint, and contacts fit a smaller arm better
        reasons = dict[str, str]() if cls.unlisted else skipped
        if missing := sorted(cls.needs - available):
            reasons[name] = f"needs {', '.join(missing)}"
            continue
        whole = cls.per_joint == "none" or any(each.startswith(f"{name}.") for each in base.names)
        joints = () if whole else range(cls.first_joint, arm.links + 1)
        for joint in (*([] if cls.per_joint == "required" else [None]), *joints):
            spec = EffectSpec(name, joint)
            of_angle = joint is not None and arm.joint_types[joint - 1] == PRISMATIC and (cls.of_angle or cls.unlisted)
            if of_angle or (joint in unseen and (cls.unlisted or hasattr(cls, "joint_angles"))):
                reasons[spec.key] = "the joint slides, or hardly moves the measured point"
                continue
            scope = Scope(arm, joint) if rows is None else Scope(arm, joint, rows.postures, rows.conditions)
            tried, blocks = [*product(*(setting.scan(scope) for setting in cls.settings.values()))], list[Block]()
            for chosen in tried:
                entry = replace(spec, values=dict(zip(cls.settings, chosen, strict=True)))
                block = Block.of(arm, entry, cls.prior / len(tried), kinds)
                blocks += [] if block.label in modeled else [block]
            (unlisted if cls.unlisted else members).extend(blocks)
            if not blocks:
                reasons[spec.key] = "already in the arm's model"
    return Library(arm, tuple(members), tuple(unlisted), skipped, aliases)


def untested_joints(at: Fitted) -> frozenset[int]:
    """Joints (from 1) at which no joint effect is tested.

    Their RMS lever is below 0.005 of the reach, or of the way that they slide: a reflector on the last axis does not
    move with that joint, where an error of usual size moves it by micrometres, and one that can be seen would be of
    degrees, and not linear. Levers are those of the arm as best known: a fit that is nonsense may shrink the arm.
    """
    levers = at.model.joint_levers(at.rows.postures, None, at.rows.conditions)
    sizes = np.sqrt(np.mean(np.sum(levers**2, axis=1), axis=0))
    full = [1.0 if kind == PRISMATIC else at.model.reach for kind in at.model.joint_types]
    return frozenset((np.flatnonzero(sizes < 5e-3 * np.array(full)) + 1).tolist())


def slope_by_angle(effect: Effect, joint: int, model: Model) -> Callable[[Array], Array] | None:
    """Of an effect that adds to the angle of a joint (from 0) what depends on that angle alone, and is linear in its p
    parameters, their factors (m, p) at angles (m,) [rad]; None of any other effect."""
    if effect.joint != joint + 1 or not hasattr(effect, "joint_angles"):
        return None
    q, c, _, _ = model.expressions.symbols
    values = ca.SX.sym("v", len(effect.parameters))
    slope = ca.jacobian(contribution(effect, "joint_angles", model.chain_at(q, c), values)[joint], values)
    others = ca.vertcat(*(q[k] for k in range(model.joints) if k != joint), c, values)
    if ca.depends_on(slope, others) or not ca.depends_on(slope, q[joint]):
        return None
    function = ca.Function("slope", [q[joint]], [slope])
    return lambda angles: np.asarray(function(angles[None])).reshape(len(angles), -1)


# -- outside the library ----------------------------------------------------------------------------------------------
def measured_range(angles: Array) -> tuple[float, float]:
    """First and last angle [rad] of those measured (m,); where a joint turns no more than once around, they begin
    after a gap on the circle of more than `HOLE`, and than the one between the last and the first."""
    low, high = float(angles.min()), float(angles.max())
    if high - low > 2.0 * np.pi:
        return low, high
    on_circle = np.mod(angles, 2.0 * np.pi)
    order = np.argsort(on_circle)  # of those alike but for rounding, which is last there, in any order
    gaps = np.diff(on_circle[order], append=on_circle[order[0]] + 2.0 * np.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= max(HOLE, 2.0 * np.pi - (high - low)):
        return low, high
    start = float(np.roll(angles[order], -1)[widest])
    return start, start + 2.0 * np.pi - float(gaps[widest])


def around(angles: Array, start: float, stop: float) -> Array:
    """(m,) angles [rad], those outside a range whole turns away: in it, where it has one turn or they were measured."""
    rounding = 1e-9  # of an angle that is the first or the last
    outside = (angles < start - rounding) | (angles > stop + rounding)
    return np.where(outside, start - rounding + np.mod(angles - start + rounding, 2.0 * np.pi), angles)


def curve_waves(angles: Array, start: float, stop: float) -> Array:
    """(m, K) cosine transform of a cubic spline basis between two angles [rad], scaled to the prior of a random walk,
    at angles (m,) that may be whole turns away; at a node the sum of its functions is the value there."""
    count, k = WAVES + 1, np.arange(1, WAVES + 1)
    cosines = np.cos(np.pi / count * np.outer(np.arange(count) + 0.5, k))
    table = splines(around(angles, start, stop), start, stop, count)
    return np.asarray(table @ (cosines / np.sin(0.5 * np.pi * k / count)))


# -- all of them, in the space of their columns ------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Linearized:
    """All blocks at a fitted model.

    blocks : B of them;  products : of their columns, projected off the base;  roots : of each block the (p, w) matrix
    from the coefficients of its columns in `products` to its own parameters [API units]
    response : (g, P) by which the base's parameters give way to each of these coefficients;  base : (g,) their values
    without;  normal : (g, g) inverse of J^T J;  columns : of each block (m, d, p), not whitened
    """

    blocks: tuple[Block, ...]
    products: Products
    roots: tuple[Array, ...]
    response: Array
    base: Array
    normal: Array
    columns: tuple[Array, ...]

    def of(self, kept: Sequence[int]) -> Linearized:
        """That of a few blocks alone."""
        blocks, roots = tuple(self.blocks[b] for b in kept), tuple(self.roots[b] for b in kept)
        columns = tuple(self.columns[b] for b in kept)
        response = self.response[:, self.products.columns_of(kept)]
        return Linearized(blocks, self.products.of_blocks(kept), roots, response, self.base, self.normal, columns)

    def beside(self, blocks: Sequence[int]) -> Linearized:
        """All beside blocks too large for anything else to explain them: as if they were of the base model."""
        every, large = self.products, self.products.state([(block, len(SIZES) - 1) for block in blocks])
        rows, freedom = every.gram[large.columns], every.freedom - len(large.columns)
        gram = every.gram - rows.T @ large.solve(rows) if blocks else every.gram
        left = replace(every, gram=gram, right=large.remaining[0], squares=large.squares, freedom=freedom)
        return replace(self, products=left)

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Label of each block -> its number."""
        return {block.label: k for k, block in enumerate(self.blocks)}


def linearized(library: Library, at: Fitted, wrong: Sequence[tuple[int, ...]] = (), outside: bool = True) -> Linearized:
    """All blocks at a fitted model, which may have effects of the library in it, for rows with any noise model.

    wrong : rows that may be outlying, each alone or all of a posture;  outside : whether blocks outside the library are
    """
    model, rows, (y, base) = at.model, at.rows, library.as_base(at)
    blocks = [*library.members, *(library.unlisted if outside else ())]
    columns = library.columns(at, blocks)
    # effects that are in the fit at its values, which matter to those that are not linear; the others at neutral ones
    numbers = {block.label: k for k, block in enumerate(blocks)}
    for effect in (effect for effect in model.effects if effect.label in numbers):
        columns[numbers[effect.label]] = at.linearized[1][:, :, at.columns_of(effect)]
    joints, unseen = model.arm.chain.joints, untested_joints(at)
    unseen |= {j for spec in model.arm.effects if spec.curve is not None and (j := spec.joint)}
    for j, angles in enumerate(rows.postures.T) if outside else ():
        if j + 1 not in unseen and joints[j].type == REVOLUTE and np.ptp(angles) > 1e-9:
            span = measured_range(angles)
            columns.append(at.levers[:, :, j, None] * curve_waves(angles, *span)[:, None, :])
            blocks.append(Block(f"curve:{j + 1}", f"joint:{j + 1}", OUTSIDE / np.sqrt(len(joints)), span=(j, *span)))
    for some in wrong:
        shifts = np.eye(rows.dimension) if len(some) == 1 else at.levers
        columns.append(shifts * np.isin(np.arange(len(rows)), some)[:, None, None])
        blocks.append(Block(f"row:{some}", "row", 0.0, rows=some))
    target = rows.whiten(y)
    back = spectrum(at.jacobian[:, base], model.scales[base]).root  # (g, r): to the parameters
    u = at.jacobian[:, base] @ back
    left = target - u @ (u.T @ target)
    sizes, roots = np.array([column.shape[2] for column in columns]), [np.zeros((0, 0))] * len(blocks)
    tables, taken = [np.zeros((0, len(u)))] * len(blocks), [np.zeros((0, u.shape[1]))] * len(blocks)
    for width in np.unique(sizes):
        alike = np.flatnonzero(sizes == width)
        parts = np.array_split(alike, max(len(alike) * width // 256, 1))  # as many as can be held at once
        for part in map(np.ndarray.tolist, parts):
            white = np.ascontiguousarray(rows.whiten(np.concatenate([columns[k] for k in part], axis=2)).T)
            inside = white @ u
            rest = (white - inside @ u.T).reshape(len(part), width, -1)
            before = np.einsum("pn,pn->p", white, white).reshape(len(part), width)
            turns = _roots(rest @ rest.transpose(0, 2, 1), before, len(rows), [blocks[k] for k in part])
            unseen = np.count_nonzero(np.all(turns == 0.0, axis=1), axis=1)  # of each block the first
            rest, inside = turns.mT @ rest, turns.mT @ inside.reshape(len(part), width, -1)
            for k, first, turn, *rows_of in zip(part, unseen.tolist(), turns, rest, inside, strict=True):
                roots[k], (tables[k], taken[k]) = turn[:, first:], (each[first:] for each in rows_of)
    shown = [k for k, root in enumerate(roots) if root.size]
    blocks, columns, roots = [blocks[k] for k in shown], [columns[k] for k in shown], [roots[k] for k in shown]
    table, across = np.concatenate(tables), np.concatenate(taken).T  # (P, N) whitened, off the base; (r, P)
    gram, right = table @ table.T, table @ left
    ends = np.cumsum([0, *(root.shape[1] for root in roots)])
    signs = np.array([b.size == 1 and b.bounded for b in blocks], dtype=bool)
    products = Products(gram, right, float(left @ left), len(target) - u.shape[1], ends, signs)
    values = at.values[base] + back @ (u.T @ target)
    return Linearized(tuple(blocks), products, tuple(roots), -back @ across, values, back @ back.T, tuple(columns))


def _roots(grams: Array, before: Array, rows: int, blocks: Sequence[Block]) -> Array:
    """(K, p, p) matrices that make columns of unit size of the own p of K blocks; zero columns for what cannot be seen.

    grams : (K, p, p) products of their columns, projected off the base model;  before : (K, p) their squares before
        projection, at so many rows

    An effect's prior covariance is the inverse of its information, a family's one common value, in typical ones, with a
    relative scatter of 0.3, as the joints are of one make; what is outside the library has its columns scaled alone.
    """
    traces, squares = np.trace(grams, axis1=1, axis2=2), np.sum(before, axis=1)
    # a torque about an axis that the load cannot turn is rounding, and no reason for a column
    parameters = [b.effect.parameters if b.effect else () for b in blocks]
    scales = [max((p.scale for p in each), default=0.0) for each in parameters]
    visible = (traces > VISIBLE * squares) & (squares > (RANK_TOLERANCE * np.array(scales)) ** 2 * rows)
    inside = np.array([b.listed for b in blocks])
    # a column of which nothing is left beside others has no length to be scaled by
    lengths = np.sqrt(np.maximum(np.diagonal(grams, axis1=1, axis2=2), np.maximum(VISIBLE * before, 1e-300)))
    lengths = np.where(inside[:, None], lengths, np.sqrt(np.maximum(traces, 1e-300))[:, None])
    values, vectors = np.linalg.eigh(grams / (lengths[:, :, None] * lengths[:, None, :]))
    seen = np.where(inside[:, None], significant(values, VISIBLE), values * SIZES[-1] ** 2 > FAINT)
    seen &= visible[:, None]
    counts = np.maximum(np.sum(seen, axis=1, keepdims=True), 1)
    factors = np.where(inside[:, None], np.sqrt(np.maximum(values, 1e-300) * counts), 1.0)
    roots = np.where(seen[:, None, :], vectors / factors[:, None, :] / lengths[:, :, None], 0.0)
    for k in (k for k in np.flatnonzero(visible).tolist() if blocks[k].family):
        typical = np.array([p.typical or 1.0 for p in parameters[k]])
        alike = np.outer(typical, typical) * (1.0 + 0.3**2 * np.eye(len(typical)))
        roots[k] = np.linalg.cholesky(alike / np.sum(grams[k] * alike))
    return np.abs(roots) if grams.shape[1] == 1 else roots
