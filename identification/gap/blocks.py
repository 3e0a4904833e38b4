"""The dictionary: every block that may be missing, linearized at a fitted model, with its columns scaled to unit size.

A block is an effect of the library at a joint with its scanned settings (a family with one similar parameter a joint
is one block); an error curve of a joint, a Gaussian process; a smooth function of time, or of the workspace; or the
shift of a single row. Blocks that are no effect of the library say where something is missing, not what.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise, product

import numpy as np
from scipy.linalg import block_diag

from identification.arrays import Array
from identification.effects.places import OF_FRAME, widths
from identification.error_curve import ErrorCurve, local_splines
from identification.gap.evidence import SIZES, Products
from identification.gap.fit import Fit, Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, untested_joints
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import SpatialChain
from identification.measurements import Conditions
from identification.model import Model

# reasons: identification/README.md, "Constants"
ALIKE = 0.3  # relative scatter of one family's parameters over the joints
RANK = 1e-6  # of a square: less left of columns beside the base model, or beside each other, cannot be seen
FAINT = 0.03  # expected square of a combination of columns at the block's largest size, below which it is left out
OUTSIDE = 0.02  # prior weight of everything outside the library at one place, beside an effect
WAVES = 30  # half periods of an error curve over the angles of its joint
TIMES = 12  # half periods in a session of the fastest smooth function of time
SLOW = 3  # half periods, of orders of functions of several variables
REST = "library"  # label of the rest of the library
REST_SIZES = 2  # of `SIZES` that it may have: what is larger shows one effect at a time


@dataclass(frozen=True, eq=False)
class Where:
    """Postures (m, n) [rad] and conditions at which the columns of blocks are wanted, at a model's parameters (p,)."""

    model: Model
    values: Array
    postures: Array
    conditions: Conditions
    position: Array
    levers: Array

    @classmethod
    def of(cls, model: Model, values: Array, postures: Array, conditions: Conditions) -> Where:
        """With (m, d) computed positions [mm] and (m, d, n) levers of the joints [mm/rad]."""
        at = (postures, values, conditions)
        return cls(model, values, postures, conditions, model.position(*at), model.joint_levers(*at))

    @cached_property
    def moments(self) -> Array:
        """(m, n) of gravity about the joints, their mean square 1."""
        found = self.model.on_chain(lambda chain: chain.torques)(self.postures, self.conditions)
        return np.asarray(found / max(float(np.sqrt(np.mean(np.square(found)))), 1e-300))

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
        return (moves[:, :, :, None] * functions[:, None, None, :]).reshape(m, d, -1)

    def varied(self, functions: Array) -> Array:
        """(m, d, p w) columns of functions (m, w) that are added to each of the p parameters of the geometry, in its
        scale."""
        of_effects = {p.name for effect in self.model.effects for p in effect.parameters}
        own = [k for k, name in enumerate(self.model.names) if name not in of_effects]
        jacobian = (self.model.jacobian(self.postures, self.values, self.conditions) * self.model.scales)[:, :, own]
        return (jacobian[:, :, :, None] * functions[:, None, None, :]).reshape(*self.position.shape, -1)


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

    @property
    def nodes(self) -> Array:
        """(K + 1,) angles of the nodes [rad]."""
        return np.linspace(self.start, self.stop, WAVES + 1)

    def table(self, values: Array) -> ErrorCurve:
        """The function with these values (K + 1,) at the nodes."""
        return ErrorCurve(self.start, self.stop, values)


@dataclass(frozen=True)
class Block:
    """One thing that may be missing.

    key : `name:joint` of an effect, without settings; else its place;  label : unique
    place : `joint:j`, `time`, `temperature`, `workspace`, `row:i` (from 0)
    member : of an effect its hypothesis;  basis : of an error curve
    parts : effects that the rest of the library has in it: many small ones, that cannot be told apart
    columns : outside the library, its (m, d, p) columns at other postures
    """

    key: str
    label: str
    place: str
    weight: float
    member: Hypothesis | None = None
    basis: Basis | None = None
    parts: tuple[Block, ...] = ()
    columns: Callable[[Where], Array] | None = None

    @property
    def named(self) -> bool:
        """Whether it is an effect of the library."""
        return self.member is not None

    @property
    def row(self) -> bool:
        """Whether it is the shift of a single row."""
        return self.place.startswith("row:")

    @property
    def written(self) -> bool:
        """Whether an arm file can have it."""
        return self.member is not None or self.basis is not None


@dataclass(frozen=True, eq=False)
class Linearized:
    """All blocks at a fitted model.

    blocks : B of them;  products : of their columns, projected off the base;  roots : of each block the (p, w) matrix
    from the coefficients of its columns in `products` to its own parameters [API units]
    response : (g, P) by which the base's parameters give way to each of these coefficients;  base : (g,) their values
    without
    normal : (g, g) inverse of J^T J;  columns : of each block (m, d, p), not whitened
    """

    blocks: tuple[Block, ...]
    products: Products
    roots: tuple[Array, ...]
    response: Array
    base: Array
    normal: Array
    columns: tuple[Array, ...]

    def columns_of(self, blocks: Sequence[int]) -> Array:
        """(m, d, p) columns of these blocks' own parameters, not whitened."""
        return np.concatenate([self.columns[b] for b in blocks], axis=2)

    def of(self, blocks: Sequence[int]) -> Linearized:
        """That of a few blocks alone."""
        kept = list(blocks)
        return Linearized(
            tuple(self.blocks[b] for b in kept),
            self.products.of_blocks(kept),
            tuple(self.roots[b] for b in kept),
            self.response[:, self.products.places(kept)],
            self.base,
            self.normal,
            tuple(self.columns[b] for b in kept),
        )

    @cached_property
    def numbers(self) -> dict[str, int]:
        """Label of each block -> its number."""
        return {block.label: k for k, block in enumerate(self.blocks)}

    @property
    def apart(self) -> frozenset[tuple[int, int]]:
        """Pairs of blocks of which one contains the other: a family, and the same effect at one joint."""
        families = {
            b.member.effect.name: k for k, b in enumerate(self.blocks) if b.member is not None and b.member.family
        }
        return frozenset(
            (families[b.member.effect.name], k)
            for k, b in enumerate(self.blocks)
            if b.member is not None and b.member.effect.name in families and families[b.member.effect.name] != k
        )

    def needy_and_givers(self, library: HypothesisSet) -> tuple[frozenset[int], frozenset[int]]:
        """Blocks that show only through others in the set (`Effect.through`), and these others."""
        needy = {k for k, b in enumerate(self.blocks) if b.member is not None and not library.acts(b.member)}
        kinds = {self.blocks[k].member.effect.through for k in needy}  # type: ignore[union-attr]
        gives = (
            k
            for k, b in enumerate(self.blocks)
            if b.member is not None and b.member.effect.needs & kinds and k not in needy
        )
        return frozenset(needy), frozenset(gives)


def outside_blocks(rows: Rows, at: Where) -> Iterator[Block]:
    """Blocks outside the library, with constants that suit these rows."""
    n, d = rows.postures.shape[1], rows.dimension
    unseen = untested_joints(at.model, rows)
    turning = [j for j in range(n) if np.ptp(rows.postures[:, j]) > 0.0]
    taken = {spec.joint for spec in at.model.arm.effects if spec.curve is not None}
    low, span = rows.postures.min(axis=0), np.maximum(np.ptp(rows.postures, axis=0), 1e-9)
    few = [(a, b) for a, b in product(range(SLOW), range(1, SLOW + 1)) if a + b <= SLOW]

    def waves(x: Array, count: int) -> Array:
        return np.cos(np.pi * x[:, None] * np.arange(1, count + 1)) / np.arange(1, count + 1)

    def with_other(w: Where, j: int, other: int) -> Array:
        x, y = ((w.postures[:, k] - low[k]) * (np.pi / span[k]) for k in (j, other))
        return np.stack([np.cos(a * x) * np.cos(b * y) / (a * a + b * b) for a, b in few], axis=1)

    for j in turning:
        if j + 1 in unseen:
            continue
        place, weight = f"joint:{j + 1}", OUTSIDE / np.sqrt(n)
        if j + 1 not in taken:
            basis = Basis(j, float(low[j]), float(low[j] + span[j]))
            columns = _at_joint(j, partial(_curve, basis=basis))
            yield Block(place, f"curve:{j + 1}", place, weight, basis=basis, columns=columns)
        for other in turning:
            if other != j:
                columns = _at_joint(j, partial(with_other, j=j, other=other))
                yield Block(place, f"shared:{j + 1},{other + 1}", place, 0.3 * weight / (n - 1), columns=columns)
        if rows.conditions.directions is not None:
            columns = _at_joint(j, partial(_one_sided, j=j))
            yield Block(place, f"history:{j + 1}", place, 0.3 * weight, columns=columns)
        if at.model.arm.gravity is not None:
            columns = _at_joint(j, partial(_loaded, j=j))
            yield Block(place, f"load:{j + 1}", place, 0.3 * weight, columns=columns)
        chain = at.model.arm.chain
        if chain is not None and chain.joints[j].type == REVOLUTE:
            columns = partial(_wobble, chain=chain, j=j)
            yield Block(place, f"wobble:{j + 1}", place, 0.3 * weight, columns=columns)
    if rows.conditions.time is not None and np.ptp(rows.conditions.time) > 0.0:
        yield Block("time", "time", "time", OUTSIDE, columns=lambda w: w.moved(waves(_time(w), TIMES)))
        yield Block(
            "time", "time[parameters]", "time", 0.3 * OUTSIDE, columns=lambda w: w.varied(waves(_time(w), SLOW))
        )
        if at.model.arm.gravity is not None:
            yield Block(
                "time", "time[load]", "time", 0.3 * OUTSIDE, columns=lambda w: _sagging(w, waves(_time(w), SLOW))
            )
    temperature = rows.conditions.temperature
    if temperature is not None and np.ptp(temperature) > 0.0:
        unit = float(np.std(temperature))

        def warm(w: Where) -> Array:
            assert w.conditions.temperature is not None
            return w.conditions.temperature[:, None] / unit

        yield Block("temperature", "temperature", "temperature", OUTSIDE, columns=lambda w: w.moved(warm(w)))
        yield Block(
            "temperature",
            "temperature[parameters]",
            "temperature",
            0.3 * OUTSIDE,
            columns=lambda w: w.varied(warm(w)),
        )
    if d > 1:
        corner, size = at.position.min(axis=0), np.maximum(np.ptp(at.position, axis=0), 1e-9)
        orders = [k for k in product(range(SLOW + 1), repeat=d) if 1 <= sum(k) <= SLOW]

        def smooth(w: Where) -> Array:
            unit = np.pi * (w.position - corner) / size
            return np.stack(
                [np.prod(np.cos(np.array(k) * unit), axis=1) / (1.0 + np.dot(k, k)) for k in orders], axis=1
            )

        def along_axes(w: Where) -> Array:
            unit, fast = np.pi * (w.position - corner) / size, np.arange(1, TIMES + 1)
            along = np.cos(unit[:, :, None] * fast) / np.sqrt(fast)  # (m, d, K) of each coordinate by itself
            return (np.eye(d)[None, :, :, None] * along.reshape(len(unit), 1, 1, -1)).reshape(*unit.shape, -1)

        def outward(w: Where) -> Array:
            radius, fast = np.linalg.norm(w.position, axis=1), np.arange(1, TIMES + 1)
            rings = np.cos(np.pi * radius[:, None] / w.model.reach * fast) / np.sqrt(fast)
            return (w.position / np.maximum(radius, 1e-9 * w.model.reach)[:, None])[:, :, None] * rings[:, None]

        for label, columns in (
            ("workspace", lambda w: w.moved(smooth(w))),
            ("workspace[squares]", _bent),
            ("workspace[axes]", along_axes),
            ("workspace[radius]", outward),
        ):
            yield Block("workspace", label, "workspace", OUTSIDE / 4.0, columns=columns)


def _at_joint(j: int, functions: Callable[[Where], Array]) -> Callable[[Where], Array]:
    """Columns of functions (m, w) that are added to the angle of a joint."""
    return lambda w: w.turned(j, functions(w))


def _curve(w: Where, basis: Basis) -> Array:
    return basis.at(w.postures[:, basis.joint])


def _time(w: Where) -> Array:
    """(m,) from 0 to 1 over the session."""
    assert w.conditions.time is not None
    return w.conditions.time + 0.5


def _one_sided(w: Where, j: int) -> Array:
    """(m, 4) functions of a joint's angle and of its last move that change sign with the direction of approach."""
    assert w.conditions.directions is not None
    q = w.postures[:, j]
    moved = np.zeros(len(q)) if w.conditions.past is None else np.abs(q - np.asarray(w.conditions.past)[:, j, -1])
    return w.conditions.directions[:, j, None] * np.stack(
        [np.ones(len(q)), np.cos(q), np.sin(q), np.exp(-moved)], axis=1
    )


def _loaded(w: Where, j: int) -> Array:
    """(m, 4) functions of the moment of gravity about a joint."""
    t = w.moments[:, j]
    return np.stack([t, np.abs(t), t * np.abs(t), np.sign(t)], axis=1)


def _sagging(w: Where, functions: Array) -> Array:
    """(m, d, n w) columns of joints that yield to gravity by their moment times functions (m, w)."""
    sag = w.levers * w.moments[:, None, :]
    return (sag[:, :, :, None] * functions[:, None, None, :]).reshape(*w.position.shape, -1)


def _bent(w: Where) -> Array:
    """(m, d, w) columns of squares and products of the coordinates, in each direction."""
    d = w.position.shape[1]
    x = w.position / w.model.reach
    squares = np.stack([x[:, a] * x[:, b] for a in range(d) for b in range(a, d)], axis=1)
    return (np.eye(d)[None, :, :, None] * squares[:, None, None, :]).reshape(len(x), d, -1)


def _wobble(w: Where, chain: SpatialChain, j: int) -> Array:
    """(m, d, 8 SLOW) columns of an axis that tilts and shifts as its joint turns."""
    levers = w.model.place_levers(w.postures, w.values, w.conditions)[0]
    turns = np.stack([f(k * w.postures[:, j]) for k in range(1, SLOW + 1) for f in (np.cos, np.sin)], axis=1)
    return (_across(chain, j, levers)[:, :, :, None] * turns[:, None, None, :]).reshape(*w.position.shape, -1)


def _across(chain: SpatialChain, j: int, levers: Array) -> Array:
    """(m, d, 4) derivatives by tilts and by shifts of what a revolute joint (from 0) moves, along two directions across
    its axis, in units in which both move the point alike;  levers : (m, d, P) by what is added at each place"""
    sizes, n = widths(len(chain), chain.dimension), len(chain)
    ends = dict(zip(sizes, np.cumsum([*sizes.values()]).tolist(), strict=True))
    plane = np.linalg.svd(np.atleast_2d(chain.joints[j].axis))[2][1:].T
    parts = []
    for kind in OF_FRAME:
        first = ends[kind] - 3 * n + 3 * j
        part = levers[:, :, first : first + 3] @ plane
        parts.append(part / max(float(np.sqrt(np.mean(np.square(part)))), 1e-300))
    return np.concatenate(parts, axis=2)


def linearized(
    library: HypothesisSet,
    at: Fit,
    rows: Rows,
    wrong: Sequence[int] = (),
    outside: frozenset[str] | None = None,
) -> Linearized:
    """All blocks at a fitted model `at`, which may have effects of the library in it, for rows with any noise model.

    wrong : rows that may be outlying
    outside : labels of blocks outside the library, None: all
    """
    model = at.model
    position, jacobian = model.linearize(rows.postures, at.values, rows.conditions)
    base = library.own_places(model)
    added = np.setdiff1d(np.arange(len(at.values)), base)
    # the data as the base model sees them: what the fit has beyond it is given back
    y = rows.positions - position + jacobian[:, :, added] @ at.values[added]
    # effects that are in the fit at its values, which matter to those that are not linear; the others at neutral ones
    fitted = {
        e.label: [model.names.index(p.name) for p in e.parameters if p.name in model.names] for e in model.effects
    }
    neutral = library.columns(rows, at.by_name, None, model)
    of_library = [
        jacobian[:, :, fitted[h.label]] if h.label in fitted else c
        for h, c in zip(library.members, neutral, strict=True)
    ]
    blocks = [Block(h.key, h.label, acting_at(h), h.weight, member=h) for h in library.members]
    where = Where.of(model, at.values, rows.postures, rows.conditions)
    further = [one for one in outside_blocks(rows, where) if outside is None or one.label in outside]
    columns = [*of_library, *(one.columns(where) for one in further if one.columns is not None)]
    blocks += further
    for k in wrong:
        shift = np.zeros((len(rows), rows.dimension, rows.dimension))
        shift[k] = np.eye(rows.dimension)
        columns.append(shift)
        blocks.append(Block(f"row:{k}", f"row:{k}", f"row:{k}", 0.0))
    starts = np.concatenate([[0], np.cumsum([c.shape[2] for c in columns])])
    white, target = rows.whiten(np.concatenate(columns, axis=2)), rows.whiten(y)
    scales = model.scales[base]
    u, s, vt = np.linalg.svd(rows.whiten(jacobian[:, :, base]) / scales, full_matrices=False)
    clear = s > 1e-9 * s.max(initial=0.0)
    u, back = u[:, clear], (vt[clear].T / s[clear]) / scales[:, None]  # (g, r): from u^T y to the parameters
    inside, before = u.T @ white, np.einsum("np,np->p", white, white)
    white -= u @ inside
    left = target - u @ (u.T @ target)
    gram, right = white.T @ white, left @ white
    parts = [slice(low, high) for low, high in pairwise(starts)]
    every = [_root(gram[p, p], float(np.sum(before[p])), b) for p, b in zip(parts, blocks, strict=True)]
    shown = [k for k, root in enumerate(every) if root.shape[1]]
    blocks, columns, roots = [blocks[k] for k in shown], [columns[k] for k in shown], [every[k] for k in shown]
    to_columns = np.zeros((len(gram), sum(root.shape[1] for root in roots)))
    end = 0
    for k, root in zip(shown, roots, strict=True):
        to_columns[parts[k], end : end + root.shape[1]] = root
        end += root.shape[1]
    many = [k for k, b in enumerate(blocks) if _common(b, library)]
    if len(many) > 1 and (outside is None or REST in outside):
        # the rest of the library as one block: each of its effects, and each error curve, with the same expected square
        root = np.asarray(block_diag(*(roots[k] for k in many))) / np.sqrt(len(many))
        raw = np.concatenate([np.arange(*starts[shown[k] : shown[k] + 2]) for k in many])
        values, vectors = np.linalg.eigh(root.T @ gram[np.ix_(raw, raw)] @ root)
        root = root @ vectors[:, values * SIZES[REST_SIZES - 1] ** 2 > FAINT]
        together = np.zeros((len(gram), root.shape[1]))
        together[raw] = root
        to_columns = np.concatenate([to_columns, together], axis=1)
        roots.append(root)
        columns.append(np.concatenate([columns[k] for k in many], axis=2))
        blocks.append(Block(REST, REST, REST, 1.0, parts=tuple(blocks[k] for k in many)))
    products = Products(
        to_columns.T @ gram @ to_columns,
        right @ to_columns,
        float(left @ left),
        len(target) - int(clear.sum()),
        np.concatenate([[0], np.cumsum([root.shape[1] for root in roots])]),
        np.array([b.member is not None and b.member.one_sided for b in blocks], dtype=bool),
        np.array([REST_SIZES if b.parts else len(SIZES) for b in blocks], dtype=np.int64),
    )
    response, place = -back @ (inside @ to_columns), at.values[base] + back @ (u.T @ target)
    return Linearized(tuple(blocks), products, tuple(roots), response, place, back @ back.T, tuple(columns))


def _common(block: Block, library: HypothesisSet) -> bool:
    """Whether it is among the many small errors that an arm may have: an unscanned effect, not rare, or a curve."""
    member = block.member
    if member is None:
        return block.basis is not None
    return not member.scanned and member.effect.prior == 1.0 and library.acts(member)


def _root(gram: Array, before: float, block: Block) -> Array:
    """The (p, w) matrix that makes columns of unit size of a block's own p; w = 0 where it cannot be seen.

    gram : (p, p) products of its columns, projected off the base model;  before : their squares before projection

    An effect's prior covariance is the inverse of its information, a family's one common value with a relative scatter
    of `ALIKE`; what is outside the library has its own columns scaled alone.
    """
    if not np.trace(gram) > RANK * before:
        return np.zeros((len(gram), 0))
    if block.member is None:
        values, vectors = np.linalg.eigh(gram / np.trace(gram))
        return np.asarray(vectors[:, values * SIZES[-1] ** 2 > FAINT] / np.sqrt(np.trace(gram)))
    if block.member.family:
        alike = 1.0 + ALIKE**2 * np.eye(len(gram))
        return np.asarray(np.linalg.cholesky(alike / np.sum(gram * alike)))
    lengths = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    seen = values > RANK * values[-1]
    root = vectors[:, seen] / np.sqrt(values[seen] * seen.sum()) / lengths[:, None]
    return np.asarray(np.abs(root) if len(gram) == 1 else root)


PLACES = {"base_drift": "time", "base_rotation_drift": "time", "base_step": "time", "axes_skew": "workspace"}


def acting_at(h: Hypothesis) -> str:
    """Place at which an effect acts."""
    return f"joint:{h.spec.joint}" if h.spec.joint is not None else PLACES.get(h.effect.name, h.effect.name)
