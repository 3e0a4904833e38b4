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
from scipy import sparse
from scipy.linalg import block_diag

from identification.arrays import Array
from identification.effects.chain import widths
from identification.gap.columns import Basis, Where, times
from identification.gap.evidence import SIZES, Products
from identification.gap.fit import Fit, Rows
from identification.gap.hypotheses import Block, HypothesisSet, untested_joints
from identification.information import VISIBLE, column_space_of, significant
from identification.kinematics.parameters import REVOLUTE

# numerical: expected square of a combination of columns at the block's largest size, below which it is left out
FAINT = 0.03
OUTSIDE = 0.02  # prior weight of everything outside the library at one place, beside an effect of the whole arm
TIMES = 12  # convention: half periods in a session of the fastest smooth function of time
SLOW = 3  # convention: half periods, of orders of functions of several variables
REST = "library"  # label of the rest of the library
REST_SIZES = 2  # of `SIZES` that it may have; prior: what is larger shows one effect at a time


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
        named = [(k, b.member) for k, b in enumerate(self.blocks) if b.member is not None]
        families = {h.spec.name: k for k, h in named if h.family}
        return frozenset(
            (families[h.spec.name], k) for k, h in named if h.spec.name in families and families[h.spec.name] != k
        )

    def needy_and_givers(self, library: HypothesisSet) -> tuple[frozenset[int], frozenset[int]]:
        """Blocks that show only through others in the set (`Effect.through`), and these others."""
        named = {k: b.member for k, b in enumerate(self.blocks) if b.member is not None}
        needy = frozenset(k for k, h in named.items() if not library.acts(h))
        kinds = {named[k].effect.through for k in needy}
        return needy, frozenset(k for k, h in named.items() if h.effect.needs & kinds) - needy


def outside_blocks(rows: Rows, at: Where) -> Iterator[Block]:
    """Blocks outside the library, with constants that suit these rows."""
    n, d, arm, conditions = rows.postures.shape[1], rows.dimension, at.model.arm, rows.conditions
    low, span = rows.postures.min(axis=0), np.maximum(np.ptp(rows.postures, axis=0), 1e-9)
    corner, size = at.position.min(axis=0), np.maximum(np.ptp(at.position, axis=0), 1e-9)
    unseen = untested_joints(at.model, rows)
    seen = d > 1 and not arm.chain.instrument.contact  # readings say where in the workspace the point is
    turning = [j for j in range(n) if np.ptp(rows.postures[:, j]) > 0.0]
    curved = {spec.joint for spec in arm.effects if spec.curve is not None}
    bases = {f"curve:{j + 1}": Basis(j, float(low[j]), float(low[j] + span[j])) for j in turning}
    timed, warmed = (v is not None and bool(np.ptp(v) > 0.0) for v in (conditions.time, conditions.temperature))
    unit = float(np.std(conditions.temperature)) if conditions.temperature is not None else 1.0

    def warm(w: Where) -> Array:
        assert w.conditions.temperature is not None
        return w.conditions.temperature[:, None] / unit

    # whether these rows can show it, label, prior weight, columns
    table: list[tuple[bool, str, float, Callable[[Where], Array]]] = []
    for j in turning:
        if j + 1 in unseen:
            continue
        weight, revolute = OUTSIDE / np.sqrt(n), not arm.chain.planar and arm.chain.joints[j].type == REVOLUTE
        table.append((j + 1 not in curved, f"curve:{j + 1}", weight, partial(_curve, basis=bases[f"curve:{j + 1}"])))
        for other in turning:
            functions = partial(_shared, joints=[j, other], low=low, span=span)
            table.append((other != j, f"shared:{j + 1},{other + 1}", 0.3 * weight / max(n - 1, 1), functions))
        table += [
            (conditions.directions is not None, f"history:{j + 1}", 0.3 * weight, partial(_one_sided, j=j)),
            (arm.gravity is not None, f"load:{j + 1}", 0.3 * weight, partial(_loaded, j=j)),
            (revolute, f"wobble:{j + 1}", 0.3 * weight, partial(_wobble, j=j)),
        ]
    table += [
        (timed, "time", OUTSIDE, lambda w: w.moved(_in_time(w, TIMES))),
        (timed, "time[parameters]", 0.3 * OUTSIDE, lambda w: w.varied(_in_time(w, SLOW))),
        (
            timed and arm.gravity is not None,
            "time[load]",
            0.3 * OUTSIDE,
            lambda w: times(w.levers * w.moments[:, None, :], _in_time(w, SLOW)),
        ),
        (warmed, "temperature", OUTSIDE, lambda w: w.moved(warm(w))),
        (warmed, "temperature[parameters]", 0.3 * OUTSIDE, lambda w: w.varied(warm(w))),
        (seen, "workspace", OUTSIDE / 4.0, partial(_smooth, corner=corner, size=size)),
        (seen, "workspace[squares]", OUTSIDE / 4.0, _bent),
        (seen, "workspace[axes]", OUTSIDE / 4.0, partial(_along_axes, corner=corner, size=size)),
        (seen, "workspace[radius]", OUTSIDE / 4.0, _outward),
    ]
    for possible, label, weight, columns in table:
        if possible:
            kind, _, joints = label.partition(":")
            place = f"joint:{joints.partition(',')[0]}" if joints else kind.partition("[")[0]
            yield Block(label, place, weight, basis=bases.get(label), columns=columns)


def _curve(w: Where, basis: Basis) -> Array:
    return w.turned(basis.joint, basis.at(w.postures[:, basis.joint]))


def _shared(w: Where, joints: Sequence[int], low: Array, span: Array) -> Array:
    """Columns of smooth functions of two joints' angles that are added to the angle of the first."""
    x, y = ((w.postures[:, k] - low[k]) * (np.pi / span[k]) for k in joints)
    few = [(a, b) for a, b in product(range(SLOW), range(1, SLOW + 1)) if a + b <= SLOW]
    functions = [np.cos(a * x) * np.cos(b * y) / (a * a + b * b) for a, b in few]
    return w.turned(joints[0], np.stack(functions, axis=1))


def _one_sided(w: Where, j: int) -> Array:
    """Columns of functions of a joint's angle and of its last move that change sign with the direction of approach."""
    assert w.conditions.directions is not None
    q = w.postures[:, j]
    moved = np.zeros(len(q)) if w.conditions.past is None else np.abs(q - np.asarray(w.conditions.past)[:, j, -1])
    functions = np.stack([np.ones(len(q)), np.cos(q), np.sin(q), np.exp(-moved)], axis=1)
    return w.turned(j, w.conditions.directions[:, j, None] * functions)


def _loaded(w: Where, j: int) -> Array:
    """Columns of functions of the moment of gravity about a joint."""
    t = w.moments[:, j]
    return w.turned(j, np.stack([t, np.abs(t), t * np.abs(t), np.sign(t)], axis=1))


def _wobble(w: Where, j: int) -> Array:
    """(m, d, 8 SLOW) columns of a revolute joint's axis (from 0) that tilts and shifts as the joint turns: along two
    directions across it, in units in which tilts and shifts move the point alike."""
    chain, levers = w.model.arm.chain, w.model.place_levers(w.postures, w.values, w.conditions)[0]
    n, sizes = len(chain), widths(chain)
    ends = dict(zip(sizes, np.cumsum([*sizes.values()]).tolist(), strict=True))
    plane = np.linalg.svd(np.atleast_2d(chain.joints[j].axis))[2][1:].T
    turns = np.stack([f(k * w.postures[:, j]) for k in range(1, SLOW + 1) for f in (np.cos, np.sin)], axis=1)
    parts = []
    for kind in chain.bends:
        first = ends[kind] - 3 * n + 3 * j
        part = levers[:, :, first : first + 3] @ plane
        parts.append(part / max(float(np.sqrt(np.mean(np.square(part)))), 1e-300))
    return times(np.concatenate(parts, axis=2), turns)


def _in_time(w: Where, count: int) -> Array:
    """(m, count) waves over the session, the slow ones larger."""
    assert w.conditions.time is not None
    orders = np.arange(1, count + 1)
    return np.cos(np.pi * (w.conditions.time + 0.5)[:, None] * orders) / orders


def _smooth(w: Where, corner: Array, size: Array) -> Array:
    """Columns of smooth functions of all coordinates together that move the point."""
    x, few = np.pi * (w.position - corner) / size, product(range(SLOW + 1), repeat=w.position.shape[1])
    orders = [np.array(k) for k in few if 1 <= sum(k) <= SLOW]
    return w.moved(np.stack([np.prod(np.cos(k * x), axis=1) / (1.0 + k @ k) for k in orders], axis=1))


def _bent(w: Where) -> Array:
    """(m, d, w) columns of squares and products of the coordinates, in each direction."""
    m, d = w.position.shape
    x = w.position / w.model.reach
    squares = np.stack([x[:, a] * x[:, b] for a in range(d) for b in range(a, d)], axis=1)
    return times(np.broadcast_to(np.eye(d), (m, d, d)), squares)


def _along_axes(w: Where, corner: Array, size: Array) -> Array:
    """(m, d, w) columns of waves of each coordinate by itself, in each direction."""
    (m, d), fast = w.position.shape, np.arange(1, TIMES + 1)
    along = np.cos((np.pi * (w.position - corner) / size)[:, :, None] * fast) / np.sqrt(fast)
    return times(np.broadcast_to(np.eye(d), (m, d, d)), along.reshape(m, -1))


def _outward(w: Where) -> Array:
    """(m, d, TIMES) columns of waves of the distance from the base, along it."""
    radius, fast = np.linalg.norm(w.position, axis=1), np.arange(1, TIMES + 1)
    rings = np.cos(np.pi * radius[:, None] / w.model.reach * fast) / np.sqrt(fast)
    return (w.position / np.maximum(radius, 1e-9 * w.model.reach)[:, None])[:, :, None] * rings[:, None]


def linearized(
    library: HypothesisSet,
    at: Fit,
    rows: Rows,
    wrong: Sequence[int] = (),
    outside: bool = True,
) -> Linearized:
    """All blocks at a fitted model `at`, which may have effects of the library in it, for rows with any noise model.

    wrong : rows that may be outlying
    outside : whether blocks outside the library are among them
    """
    model, (y, jacobian, base) = at.model, library.as_base(at, rows)
    # effects that are in the fit at its values, which matter to those that are not linear; the others at neutral ones
    fitted = {
        e.label: [model.names.index(p.name) for p in e.parameters if p.name in model.names] for e in model.effects
    }
    neutral = library.columns(rows, at.by_name, model)
    of_library = [
        jacobian[:, :, fitted[h.label]] if h.label in fitted else c
        for h, c in zip(library.members, neutral, strict=True)
    ]
    where = Where(model, at.values, rows.postures, rows.conditions)
    further = list(outside_blocks(rows, where)) if outside else []
    columns = [*of_library, *(one.columns(where) for one in further if one.columns is not None)]
    blocks: list[Block] = [*library.members, *further]
    for k in wrong:
        shift = np.zeros((len(rows), rows.dimension, rows.dimension))
        shift[k] = np.eye(rows.dimension)
        columns.append(shift)
        blocks.append(Block(f"row:{k}", f"row:{k}", 0.0))
    starts = np.concatenate([[0], np.cumsum([c.shape[2] for c in columns])])
    parts = [slice(low, high) for low, high in pairwise(starts)]
    white, target = rows.whiten(np.concatenate(columns, axis=2)), rows.whiten(y)
    u, back = column_space_of(rows.whiten(jacobian[:, :, base]), model.scales[base])  # (g, r): to the parameters
    inside, gram = u.T @ white, white.T @ white
    squares = np.diag(gram).copy()
    gram -= inside.T @ inside
    left = target - u @ (u.T @ target)
    right = left @ white
    every = [_root(gram[p, p], float(np.sum(squares[p])), b) for p, b in zip(parts, blocks, strict=True)]
    shown = [k for k, root in enumerate(every) if root.shape[1]]
    blocks, columns, roots = [blocks[k] for k in shown], [columns[k] for k in shown], [every[k] for k in shown]
    turn = sparse.block_diag([root.T for root in every], format="csr")  # (P, p)
    gram = turn @ np.ascontiguousarray((turn @ gram).T)
    right, inside = turn @ right, np.ascontiguousarray((turn @ np.ascontiguousarray(inside.T)).T)
    ends = np.concatenate([[0], np.cumsum([root.shape[1] for root in roots])])
    many = [k for k, b in enumerate(blocks) if _common(b, library)]
    if len(many) > 1 and outside:
        # the rest of the library as one block: each of its effects, and each error curve, with the same expected square
        own = np.concatenate([np.arange(*ends[k : k + 2]) for k in many])
        values, vectors = np.linalg.eigh(gram[np.ix_(own, own)] / len(many))
        vectors = vectors[:, values * SIZES[REST_SIZES - 1] ** 2 > FAINT] / np.sqrt(len(many))
        across = gram[:, own] @ vectors
        gram = np.block([[gram, across], [across.T, vectors.T @ across[own]]])
        right, inside = np.append(right, right[own] @ vectors), np.hstack([inside, inside[:, own] @ vectors])
        ends = np.append(ends, len(right))
        roots.append(np.asarray(block_diag(*(roots[k] for k in many))) @ vectors)
        columns.append(np.concatenate([columns[k] for k in many], axis=2))
        blocks.append(Block(REST, REST, 1.0, parts=tuple(blocks[k] for k in many)))
    products = Products(
        gram,
        right,
        float(left @ left),
        len(target) - u.shape[1],
        ends,
        np.array([b.member is not None and b.member.one_sided for b in blocks], dtype=bool),
        np.array([REST_SIZES if b.parts else len(SIZES) for b in blocks], dtype=np.int64),
    )
    place = at.values[base] + back @ (u.T @ target)
    return Linearized(tuple(blocks), products, tuple(roots), -back @ inside, place, back @ back.T, tuple(columns))


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
    of 0.3, as the joints are of one make; what is outside the library has its own columns scaled alone.
    """
    if not np.trace(gram) > VISIBLE * before:
        return np.zeros((len(gram), 0))
    if block.member is None:
        values, vectors = np.linalg.eigh(gram / np.trace(gram))
        return np.asarray(vectors[:, values * SIZES[-1] ** 2 > FAINT] / np.sqrt(np.trace(gram)))
    if block.member.family:
        alike = 1.0 + 0.3**2 * np.eye(len(gram))
        return np.asarray(np.linalg.cholesky(alike / np.sum(gram * alike)))
    lengths = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    seen = significant(values, VISIBLE)
    root = vectors[:, seen] / np.sqrt(values[seen] * seen.sum()) / lengths[:, None]
    return np.asarray(np.abs(root) if len(gram) == 1 else root)
