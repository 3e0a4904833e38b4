"""The dictionary: every block that may be missing, linearized at a fitted model, with its columns scaled to unit size.

A block is an effect of the library at a joint with its scanned settings (a family with one similar parameter a joint
is one block); an error curve of a joint, a Gaussian process; a smooth function of time, or of the workspace; or the
shift of a single row. Blocks that are no effect of the library say where something is missing, not what.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from identification.arrays import Array
from identification.effects.places import OF_FRAME, widths
from identification.error_curve import ErrorCurve, local_splines
from identification.gap.evidence import Products
from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, untested_joints
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import SpatialChain

# reasons: identification/README.md, "Constants"
ALIKE = 0.3  # relative scatter of one family's parameters over the joints
RANK = 1e-6  # of the largest eigenvalue of unit columns: combinations that the data do not determine
VISIBLE = 1e-6  # share of a block's square that the base model must leave
OUTSIDE = 0.02  # prior weight of everything outside the library at one place, beside an effect
LENGTHS = (0.15, 0.5, 1.5)  # correlation lengths of error curves [rad]
MOST_NODES = 60  # effort: of one curve
TIMES = 12  # half periods in a session of the fastest smooth function of time
WOBBLES = (1, 2, 3, 4)  # periods per turn of an axis that wobbles
WARPS = {2: 4, 3: 3}  # half periods along the axes of the workspace, in sum
REST = "library"  # label of the rest of the library
CHUNK = 2**20  # numbers worked on at once: eight megabytes


@dataclass(frozen=True)
class Basis:
    """Cosine transform of a cubic spline basis of one joint (from 0) between the smallest and largest angle [rad].

    count : K, number of nodes and of cosines;  length : correlation length of the prior [rad], a Matern process of
    smoothness 3/2 (C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, section 4.2)
    """

    joint: int
    start: float
    stop: float
    count: int
    length: float

    @classmethod
    def of(cls, angles: Array, joint: int, length: float) -> Basis:
        """Basis for measured angles (m,), not all equal, with two nodes in a correlation length."""
        low, high = float(angles.min()), float(angles.max())
        return cls(joint, low, high, min(max(8, int(np.ceil(2.0 * (high - low) / length)) + 1), MOST_NODES), length)

    @property
    def _cosines(self) -> Array:
        """(K, K) coefficients of the splines of each cosine, times the standard deviation of its own coefficient."""
        k = np.arange(self.count)
        table = np.cos(np.pi / self.count * np.outer(k + 0.5, k)) * np.sqrt(2.0 / self.count)
        table[:, 0] /= np.sqrt(2.0)
        t = 2.0 - 2.0 * np.cos(np.pi * k / self.count)
        spacing = (self.stop - self.start) / (self.count - 1)
        return np.asarray(table / (t + 3.0 * (spacing / self.length) ** 2))

    def at(self, angles: Array) -> Array:
        """(m, K) values at angles (m,) [rad]."""
        place, parts = local_splines(angles, self.start, self.stop, self.count)
        splines = np.zeros((len(place), self.count + 6))
        np.put_along_axis(splines, place + 3, parts, axis=1)
        return np.asarray(splines[:, 3:-3] @ self._cosines)

    def table(self, values: Array) -> ErrorCurve:
        """The function with these values (K,) at the nodes."""
        return ErrorCurve(self.start, self.stop, values)


@dataclass(frozen=True)
class Block:
    """One thing that may be missing.

    key : `name:joint` of an effect, without settings; else its place;  label : unique
    place : `joint:j`, `time`, `workspace`, `row:i` (from 0)
    member : of an effect its hypothesis;  basis : of an error curve
    parts : labels of the effects that the rest of the library has in it: many small ones, that cannot be told apart
    """

    key: str
    label: str
    place: str
    weight: float
    member: Hypothesis | None = None
    basis: Basis | None = None
    parts: tuple[str, ...] = ()

    @property
    def named(self) -> bool:
        """Whether it is an effect of the library."""
        return self.member is not None

    @property
    def row(self) -> bool:
        """Whether it is the shift of a single row."""
        return self.place.startswith("row:")


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


def outside_blocks(rows: Rows, at: Fit) -> Iterator[tuple[Block, Array]]:
    """Blocks outside the library, each with its (m, d, w) columns."""
    m, d = len(rows), rows.dimension
    n = rows.postures.shape[1]
    where = (rows.postures, at.values, rows.conditions)
    position, levers = at.model.position(*where), at.model.joint_levers(*where)
    unseen = untested_joints(at.model, rows)
    taken = {spec.joint for spec in at.model.arm.effects if spec.curve is not None}
    for j in range(n):
        q = rows.postures[:, j]
        if np.ptp(q) == 0.0 or j + 1 in unseen:
            continue
        place, lever = f"joint:{j + 1}", levers[:, :, j, None]
        weight = OUTSIDE / np.sqrt(n)
        if j + 1 not in taken:
            for length in LENGTHS:
                basis = Basis.of(q, j, length)
                block = Block(place, f"curve:{j + 1}[{length:g}]", place, weight / len(LENGTHS), basis=basis)
                yield block, lever * basis.at(q)[:, None, :]
        others = [rows.postures[:, k] for k in range(n) if k != j and np.ptp(rows.postures[:, k]) > 0.0]
        if others:
            shared = [f for other in others for f in (np.cos(other), np.sin(other), q * other)]
            yield Block(place, f"shared:{j + 1}", place, 0.3 * weight), lever * np.column_stack(shared)[:, None, :]
        if rows.conditions.directions is not None:
            way = rows.conditions.directions[:, j]
            history = np.column_stack([way * np.cos(q), way * np.sin(q)])
            yield Block(place, f"history:{j + 1}", place, 0.3 * weight), lever * history[:, None, :]
        if at.model.arm.chain is not None and at.model.arm.chain.joints[j].type == REVOLUTE:
            tilts = _across(at.model.arm.chain, j, at.model.place_levers(*where)[0])
            turns = np.stack([f(k * q) for k in WOBBLES for f in (np.cos, np.sin)], axis=1)
            columns = (tilts[:, :, :, None] * turns[:, None, None, :]).reshape(m, d, -1)
            yield Block(place, f"wobble:{j + 1}", place, 0.3 * weight), columns
    time = rows.conditions.time
    if time is not None and np.ptp(time) > 0.0:
        moves = np.broadcast_to(np.eye(d), (m, d, d))
        if d == 2:
            scale = np.sqrt(np.mean(np.sum(position**2, axis=1)))
            turn = np.stack([-position[:, 1], position[:, 0]], axis=1)
            moves = np.concatenate([moves, turn[:, :, None] / scale], axis=2)
        waves = np.stack([np.cos(np.pi * k * (time + 0.5)) / k for k in range(1, TIMES + 1)], axis=1)
        columns = (moves[:, :, :, None] * waves[:, None, None, :]).reshape(m, d, -1)
        yield Block("time", "time", "time", OUTSIDE), columns
    if d > 1:
        low, span = position.min(axis=0), np.maximum(np.ptp(position, axis=0), 1e-9)
        orders = [k for k in product(range(WARPS.get(d, 3) + 1), repeat=d) if 1 <= sum(k) <= WARPS.get(d, 3)]
        unit = np.pi * (position - low) / span
        waves = np.stack(
            [np.prod(np.cos(np.array(k) * unit), axis=1) / (1.0 + np.sum(np.square(k))) for k in orders], axis=1
        )
        columns = (np.eye(d)[None, :, :, None] * waves[:, None, None, :]).reshape(m, d, -1)
        yield Block("workspace", "workspace", "workspace", OUTSIDE / 3.0), columns
        fast = np.arange(1, TIMES + 1)
        along = np.cos(unit[:, :, None] * fast) / np.sqrt(fast)  # (m, d, K) of each coordinate by itself
        columns = (np.eye(d)[None, :, :, None] * along.reshape(m, 1, 1, -1)).reshape(m, d, -1)
        yield Block("workspace", "workspace[axes]", "workspace", OUTSIDE / 3.0), columns
        radius = np.linalg.norm(position, axis=1)
        outward = position / np.maximum(radius, 1e-9 * radius.max())[:, None]
        turns = np.pi * (radius - radius.min())[:, None] / max(float(np.ptp(radius)), 1e-9) * fast
        rings = np.cos(turns) / np.sqrt(fast)
        yield Block("workspace", "workspace[radius]", "workspace", OUTSIDE / 3.0), outward[:, :, None] * rings[:, None]


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
    found = library.columns(rows, at.by_name, None, model)
    listed: list[tuple[Block, Array]] = []
    for h, columns in zip(library.members, found, strict=True):
        listed.append((Block(h.key, h.label, place_of(h), h.weight, member=h), columns))
    listed += [one for one in outside_blocks(rows, at) if outside is None or one[0].label in outside]
    for k in wrong:
        shift = np.zeros((len(rows), rows.dimension, rows.dimension))
        shift[k] = np.eye(rows.dimension)
        listed.append((Block(f"row:{k}", f"row:{k}", f"row:{k}", 0.0), shift))
    counts = np.array([c.shape[2] for _, c in listed], dtype=np.int64)
    white = rows.whiten(np.concatenate([c for _, c in listed], axis=2))
    own, target = rows.whiten(jacobian[:, :, base]), rows.whiten(y)
    scales = model.scales[base]
    u, s, vt = np.linalg.svd(own / scales, full_matrices=False)
    kept = s > 1e-9 * s.max(initial=0.0)
    u, s, vt = u[:, kept], s[kept], vt[kept]
    inside = u.T @ white
    before = np.einsum("np,np->p", white, white)
    white = white - u @ inside
    target_left = target - u @ (u.T @ target)
    back = (vt.T / s) / scales[:, None]  # (g, r): from u^T y to the parameters
    starts = np.concatenate([[0], np.cumsum(counts)])
    roots = _roots(white, before, starts, [block for block, _ in listed])
    shown = [k for k, root in enumerate(roots) if root.shape[1]]
    z = np.concatenate([white[:, starts[k] : starts[k + 1]] @ roots[k] for k in shown], axis=1)
    turned = np.concatenate([inside[:, starts[k] : starts[k + 1]] @ roots[k] for k in shown], axis=1)
    blocks = tuple(listed[k][0] for k in shown)
    shown_columns = [listed[k][1] for k in shown]
    kept_roots = [roots[k] for k in shown]
    common = [k for k, b in enumerate(blocks) if b.member is not None and _common(b.member, library)]
    if (len(common) > 1 and outside is None) or (outside is not None and REST in outside):
        # the rest of the library as one block: each of its effects with the same expected square
        ends = np.concatenate([[0], np.cumsum([root.shape[1] for root in kept_roots])])
        index = np.concatenate([np.arange(ends[k], ends[k + 1]) for k in common])
        share = 1.0 / np.sqrt(len(common))
        z, turned = np.hstack([z, share * z[:, index]]), np.hstack([turned, share * turned[:, index]])
        parts = tuple(blocks[k].label for k in common)
        blocks = (*blocks, Block(REST, REST, REST, 1.0, parts=parts))
        kept_roots.append(share * np.asarray(block_diag(*(kept_roots[k] for k in common))))
        shown_columns.append(np.concatenate([shown_columns[k] for k in common], axis=2))
    products = Products(
        z.T @ z,
        z.T @ target_left,
        float(target_left @ target_left),
        len(target) - int(kept.sum()),
        np.concatenate([[0], np.cumsum([root.shape[1] for root in kept_roots])]),
        np.array([b.member is not None and b.member.one_sided for b in blocks], dtype=bool),
    )
    return Linearized(
        blocks,
        products,
        tuple(kept_roots),
        -back @ turned,
        at.values[base] + back @ (u.T @ target),
        back @ back.T,
        tuple(shown_columns),
    )


def _common(member: Hypothesis, library: HypothesisSet) -> bool:
    """Whether an effect is among the many small ones that an arm may have."""
    return not member.scanned and member.effect.prior == 1.0 and library.acts(member)


def _roots(white: Array, before: Array, starts: Array, blocks: Sequence[Block]) -> list[Array]:
    """Of each block the (p, w) matrix that makes columns of unit size of its own p; w = 0 where it cannot be seen.

    white : (N, P) whitened columns, projected off the base model;  before : (P,) their squares before projection

    An effect's prior covariance is the inverse of its information, a family's one common value with a relative scatter
    of
    `ALIKE`; what is outside the library has its own columns scaled alone.
    """
    roots: list[Array] = [np.zeros((0, 0))] * len(blocks)
    widths = np.diff(starts)
    plain = np.array([b.member is not None and not b.member.family for b in blocks], dtype=bool)
    for width in np.unique(widths[plain]).tolist():
        own = np.flatnonzero(plain & (widths == width))
        index = starts[own][:, None] + np.arange(width)
        x = white[:, index]  # (N, b, w)
        gram = (
            np.einsum("nbi,nbj->bij", x, x, optimize=True)
            if width > 1
            else np.einsum("nbi,nbi->b", x, x)[:, None, None]
        )
        lengths = np.sqrt(np.maximum(np.einsum("bii->bi", gram), 1e-300))
        values, vectors = np.linalg.eigh(gram / (lengths[:, :, None] * lengths[:, None, :]))
        clear = np.einsum("bii->b", gram) > VISIBLE * before[index].sum(axis=1)
        for k, value, vector, length, shows in zip(own.tolist(), values, vectors, lengths, clear.tolist(), strict=True):
            seen = value > RANK * value[-1]
            root = vector[:, seen] / np.sqrt(value[seen] * seen.sum()) / length[:, None]
            roots[k] = (np.abs(root) if width == 1 else root) if shows else np.zeros((width, 0))
    for k in np.flatnonzero(~plain).tolist():
        x, member = white[:, starts[k] : starts[k + 1]], blocks[k].member
        gram = x.T @ x
        if not np.trace(gram) > VISIBLE * before[starts[k] : starts[k + 1]].sum():
            roots[k] = np.zeros((len(gram), 0))
        elif member is None:
            roots[k] = np.eye(len(gram)) / np.sqrt(np.trace(gram))
        else:
            alike = 1.0 + ALIKE**2 * np.eye(len(gram))
            roots[k] = np.asarray(np.linalg.cholesky(alike / np.sum(gram * alike)))
    return roots


PLACES = {"base_drift": "time", "base_rotation_drift": "time", "base_step": "time", "axes_skew": "workspace"}


def place_of(h: Hypothesis) -> str:
    """Place at which an effect acts."""
    return f"joint:{h.spec.joint}" if h.spec.joint is not None else PLACES.get(h.effect.name, h.effect.name)
