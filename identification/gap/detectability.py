"""What the columns of effects show beside the base model: how visible an effect is, at which size, and what it is like.

All of it follows from the columns of `gap.blocks`, projected off the base model. Two effects of likeness 1 cannot be
told apart by these rows, whatever their sizes (identification/README.md, "Gap workflow").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import betaincinv, fdtrc, ncfdtr, nctdtr, stdtrit

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.document import Document
from identification.documents.diagnosis import detectability_document
from identification.errors import InputError
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.blocks import Linearized, linearized
from identification.gap.evidence import SIZES, Index
from identification.gap.fit import Fit, Rows, fit
from identification.gap.hypotheses import HypothesisSet, hypotheses
from identification.gap.noise import SPARE
from identification.information import VISIBLE, product_inverse, significant
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.threads import single_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POWER = 0.9  # convention: what is "excluded" would have been found in nine cases of ten
# derived: two effects of likeness c differ by lambda^2 (1 - c^2) in chi-square, below 6 up to lambda = 5.6
NEAR = 0.9


class Size(NamedTuple):
    """Size of a parameter in the unit of files and tables, an entry of `excluded` (identification/files/README.md,
    "JSON keys"); None if no size can be detected.

    tip_mm : by how much an effect of this size moves the tip, RMS over the rows [mm]
    """

    value: float | None
    unit: str
    tip_mm: float | None = None

    def order(self) -> float:
        """Sort key: the value, infinite where no size can be detected."""
        return np.inf if self.value is None else self.value

    def __str__(self) -> str:
        if self.value is None:
            return "invisible"
        return f"{self.value:.3g}" if self.unit == "1" else f"{self.value:.3g} {self.unit}"


@dataclass(frozen=True)
class Detectability:
    """Detectability of each effect in a plan.

    names : H effects without scanned settings
    norm_fractions : (H,) fraction of the columns' norm left after projection off the base model (worst direction)
    likeness : (H, H) root mean square fraction of effect h (row) that effect g (column) explains after projection
    detectable : effect -> smallest size, of its least visible combination of parameters, found with 90 % power
    freedom : residual degrees of freedom of the base model
    skipped : effect -> why it cannot be tested;  aliases : effect -> base parameters it cannot be distinguished from
    """

    names: tuple[str, ...]
    norm_fractions: Array
    likeness: Array
    detectable: Mapping[str, Size]
    freedom: int
    skipped: Mapping[str, str]
    aliases: Mapping[str, str]

    def pairs(self) -> list[tuple[str, str, float]]:
        """As `pairs_of`."""
        return pairs_of(self.names, self.likeness)

    def to_json(self) -> dict[str, object]:
        """Plain data for `--json`."""
        return {
            "effects": [
                {
                    "effect": name,
                    "share": float(fraction),
                    "detectable": self.detectable[name].value,
                    "unit": self.detectable[name].unit,
                }
                for name, fraction in zip(self.names, self.norm_fractions, strict=True)
            ],
            "alias_pairs": [{"effect": a, "like": b, "likeness": c} for a, b, c in self.pairs()],
            "degrees_of_freedom": self.freedom,
            "skipped": dict(self.skipped),
            "never_visible": dict(self.aliases),
        }

    def document(self) -> Document:
        """Visible fraction, smallest size and look-alikes of every effect, and what cannot be tested."""
        return detectability_document(self)

    def figure(self) -> Figure:
        """Heat map of the likeness of effects."""
        from identification.documents.pictures import alias_figure  # deferred: matplotlib takes long to load

        return alias_figure(self)

    def __str__(self) -> str:
        return str(self.document())

    def _repr_html_(self) -> str:
        return self.document()._repr_html_()


@single_thread()  # the same bits, whatever the number of threads
def detectability(arm: Arm, postures: Array, conditions: Conditions | None = None) -> Detectability:
    """Which effects measurements at (m, n) postures [rad] could detect, and at which size: with the noise of the arm's
    data sheet, else per millimetre of noise.

    conditions : of the rows; thermal effects are included only if it has temperatures

    Raises `InputError` with fewer than 4 residual degrees of freedom.
    """
    model = Model(arm)
    rows = Rows.of(Measurements(np.atleast_2d(postures), np.zeros((len(np.atleast_2d(postures)), model.dimension))))
    given = {} if conditions is None else {k: v for k, v in vars(conditions).items() if v is not None}
    filled = replace(rows.conditions, **given)
    rows = replace(rows, positions=model.position(rows.postures, None, filled), conditions=filled)
    library = hypotheses(arm, frozenset({"temperature"} & {*given}), rows)
    exact = fit(library.base, rows, {})
    require_spare(exact.freedom, len(rows))
    return assess(library, Beside(linearized(library, exact, rows, outside=False)), rows, arm.sigma or 1.0)


def require_spare(freedom: int, rows: int) -> None:
    """Raise `InputError` with fewer than `SPARE` residual degrees of freedom."""
    if freedom < SPARE:
        raise InputError(
            f"measurements: {rows} rows leave {freedom} residual degrees of freedom for tests, "
            f"allowed: at least {SPARE}; measure more postures"
        )


class Beside:
    """The columns of a problem beside the base model, and beside shifts of the rows that are left out, too large for
    anything else to explain them.

    wrong : blocks of these rows;  left, scores : these, and what they leave of the products
    freedom : residual degrees of freedom
    """

    def __init__(self, problem: Linearized, wrong: Sequence[int] = ()) -> None:
        self.problem, self.products = problem, problem.products
        self.left = self.products.state([(block, len(SIZES) - 1) for block in wrong])
        self.scores = self.left.without().scores
        self.freedom = self.products.freedom - len(self.products.places(wrong))

    def gram(self, places: Index) -> Array:
        """(k, k) products of these columns."""
        across = self.left.rows[:, places]
        return np.asarray(self.products.gram[np.ix_(places, places)] - across.T @ self.left.covariance @ across)

    def f_test(self, blocks: Sequence[int]) -> tuple[float, float]:
        """F statistic of a few blocks against the base model, and its p-value."""
        places = self.products.places(blocks)
        count, spare = max(len(places), 1), max(self.freedom - len(places), 1)
        scores = self.scores[places]
        # of unit size; a row that is left out may have a column alone
        gain = float(scores @ np.linalg.solve(self.gram(places) + 1e-12 * np.eye(len(places)), scores))
        f = gain / count / (max(self.left.squares - gain, 1e-300) / spare)
        return f, float(fdtrc(count, spare, f))


def assess(library: HypothesisSet, beside: Beside, rows: Rows, sigma: float) -> Detectability:
    """Detectability of the library's effects in the rows of a problem;  sigma : of one whitened coordinate [mm]"""
    problem, products, freedom = beside.problem, beside.products, beside.freedom
    plain: list[tuple[str, float, Index]] = []
    level = LEVEL / sum(member.weight for member in library.members)
    detectable: dict[str, Size] = {}
    for member in filter(library.acts, library.members):
        parameter, count, number = member.effect.parameters[0], member.size, problem.numbers.get(member.label)
        size, fraction = Size(None, parameter.file_unit), 0.0
        places = products.places([] if number is None else [number])
        if number is not None and len(places) == count:  # else a combination of its parameters cannot be seen
            back = np.linalg.inv(problem.roots[number])  # from the parameters to the coefficients of the columns
            gram, moving = back.T @ beside.gram(places) @ back, problem.columns[number]
            lengths = np.maximum(np.linalg.norm(rows.whiten(moving), axis=0), 1e-150)
            least, fraction = np.sqrt([_least(gram), _least(gram / np.outer(lengths, lengths))]).tolist()
            if count < freedom and least > VISIBLE * lengths.max():
                needed = detectable_lambda(count, freedom - count, level * member.weight, member.one_sided)
                moved = needed * sigma / least * float(np.linalg.norm(moving, axis=(0, 1)).max()) / np.sqrt(len(rows))
                # an effect that moves the tip farther is seen without a test, and is not linear
                if moved <= 0.1 * library.base.reach:
                    value = needed * sigma / least * parameter.to_file
                    size = Size(float(value), parameter.file_unit, float(moved))
        # of several settings the one that is hardest to see
        detectable[member.key] = max(detectable.get(member.key, size), size, key=Size.order)
        if not member.scanned:
            plain.append((member.key, fraction, places))
    return Detectability(
        tuple(key for key, _, _ in plain),
        readonly(np.array([fraction for _, fraction, _ in plain])),
        readonly(likenesses(products.gram, [places for _, _, places in plain])),
        detectable,
        freedom,
        library.skipped,
        library.aliases,
    )


def _least(gram: Array) -> float:
    """The smallest eigenvalue, not negative."""
    return max(float(gram[0, 0] if len(gram) == 1 else np.linalg.eigvalsh(gram)[0]), 0.0)


@lru_cache(4096)  # hundreds of hypotheses share a few cases
def detectable_lambda(size: int, freedom: int, level: float, one_sided: bool = False) -> float:
    """Length lambda, in standard deviations, of a projected effect that a test at `level` detects with 90 % power.

    size : parameters of the effect;  freedom : residual degrees of freedom with it in the model

    The power of an F test is the tail of the noncentral F distribution with noncentrality lambda^2, that of a
    one-sided t test the tail of the noncentral t with lambda; both increase with lambda, so bisection finds it. (The
    inverses in `scipy.special` are accurate to 1e-5 only; importing `brentq` takes longer than the whole computation.)
    """
    # quantiles of the upper tail, as the level may be far below the rounding of 1; F by the incomplete beta function
    tail = betaincinv(0.5 * freedom, 0.5 * size, level)
    limit = -stdtrit(freedom, level) if one_sided else freedom / size * (1.0 - tail) / tail

    def missed(length: float) -> bool:
        missing = nctdtr(freedom, length, limit) if one_sided else ncfdtr(size, freedom, length**2, limit)
        return bool(missing > 1.0 - POWER)

    low, high = 0.0, 16.0
    while missed(high):  # one or two degrees of freedom take hundreds of standard deviations
        low, high = high, 2.0 * high
    while (middle := 0.5 * (low + high)) not in (low, high):
        low, high = (middle, high) if missed(middle) else (low, middle)
    return high


def likenesses(gram: Array, parts: Sequence[Index]) -> Array:
    """(H, H) root mean square fraction of the one's columns (row) that another's explain.

    gram : (P, P) products of projected columns;  parts : of each one the indices of its columns
    """
    bases, ends = [], np.cumsum([0, *map(len, parts)])
    for part in parts:
        within = gram[np.ix_(part, part)]
        lengths = np.sqrt(np.maximum(np.diag(within), 1e-300))
        values, vectors = np.linalg.eigh(within / np.outer(lengths, lengths))
        seen = significant(values, VISIBLE)
        bases.append(vectors[:, seen] / np.sqrt(values[seen]) / lengths[:, None])
    widths, every = np.array([basis.shape[1] for basis in bases], dtype=np.int64), np.concatenate([ends[:0], *parts])
    owner, turn = np.repeat(np.eye(len(parts)), widths, axis=0), block_diag(*bases) if bases else np.zeros((0, 0))
    squares = owner.T @ np.square(turn.T @ gram[np.ix_(every, every)] @ turn) @ owner
    return np.asarray(np.minimum(np.sqrt(squares / np.maximum(widths, 1)[:, None]), 1.0))


def pairs_of(names: Sequence[str], likeness: Array) -> list[tuple[str, str, float]]:
    """Pairs (effect, effect like it, likeness) with a likeness of at least `NEAR`, strongest first."""
    rows, columns = np.nonzero((likeness >= NEAR) & ~np.eye(len(names), dtype=bool))
    pairs = [(names[i], names[j], float(likeness[i, j])) for i, j in zip(rows.tolist(), columns.tolist(), strict=True)]
    return sorted(pairs, key=lambda pair: -round(pair[2], 9))


def look_alikes(problem: Linearized, sees: Detectability, labels: Set[str]) -> tuple[tuple[str, str, float], ...]:
    """Pairs (effect, what it is like, likeness) of the effects with these labels: scanned ones of the same joint, then
    others, then those that no data can tell from base parameters.

    On a grid of angles a ripple of 15 periods per turn can have the same column as an eccentric encoder.
    """
    places = {b.place for b in problem.blocks if b.label in labels and b.place.startswith("joint:")}
    near = [
        (k, block.label)
        for k, block in enumerate(problem.blocks)
        if block.member is not None and block.place in places and (block.member.scanned or block.label in labels)
    ]
    products, names = problem.products, [label for _, label in near]
    waves = pairs_of(names, likenesses(products.gram, [products.places([k]) for k, _ in near]))
    scanned = [pair for pair in waves if pair[0] in labels and "[" in pair[1]]
    never = [(name, like, 1.0) for name, like in sees.aliases.items()]
    return (*scanned, *(pair for pair in sees.pairs() if pair[0] in labels), *never)


class OrderRange(NamedTuple):
    """A named wave whose order the range of its joint does not determine: a shape, not a cause. An entry of `shapes`
    (identification/files/README.md, "JSON keys").

    joint : from 1;  range_deg : of its angle;  orders : lowest and highest of the whole orders that fit [per turn]
    """

    effect: str
    joint: int
    range_deg: tuple[float, float]
    orders: tuple[int, int]


def order_ranges(fitted: Fit, labels: Sequence[str]) -> tuple[OrderRange, ...]:
    """The named waves of a fit whose next whole order has a likeness of at least `NEAR`, beside the rest of the model.

    labels : of the named effects

    Over a range of W rad two waves whose orders differ by less than 2 pi / W drift apart by less than one period, and
    beside other waves they cannot be separated: the named order is one of many that fit.
    """
    model, rows, ranges = fitted.model, fitted.rows, list[OrderRange]()
    levers = model.joint_levers(rows.postures, fitted.values, rows.conditions)
    harmonics = {"encoder_eccentricity": 1.0, "encoder_second_harmonic": 2.0}
    orders = {e: e.chosen.get("k", harmonics.get(e.name)) for e in model.effects if e.label in labels and e.joint}
    waves = [(e, k) for e, order in orders.items() if order is not None for k in (order, order - 1.0, order + 1.0)]
    moved = []
    for effect, order in waves:
        turns = rows.postures[:, effect.joint_index] * order
        moved.append(levers[:, :, effect.joint_index, None] * np.stack([np.cos(turns), np.sin(turns)], axis=1)[:, None])
    columns = np.concatenate([fitted.jacobian / model.scales, *(rows.whiten(each) for each in moved)], axis=1)
    gram, p = columns.T @ columns, len(model.names)
    for number, (effect, order) in enumerate(waves):
        if order != orders[effect]:
            continue
        names = {parameter.name for parameter in effect.parameters}
        rest = np.array([k for k, name in enumerate(model.names) if name not in names], dtype=np.int64)
        block = p + 2 * number + np.arange(6)  # of the wave, and of those beside it
        block = block if order > 1.0 else np.delete(block, [2, 3])
        across = gram[np.ix_(block, rest)]
        inner = product_inverse(gram[np.ix_(rest, rest)])
        left = gram[np.ix_(block, block)] - across @ inner @ across.T
        parts = list(np.arange(len(block)).reshape(-1, 2))
        if likenesses(left, parts)[0, 1:].max() >= NEAR:
            q = rows.postures[:, effect.joint_index]
            apart = 2.0 * np.pi / (np.sqrt(12.0) * np.std(q))  # the range of even angles with this standard deviation
            span = float(np.degrees(q.min())), float(np.degrees(q.max()))
            whole = max(1, int(np.ceil(order - apart))), int(np.floor(order + apart))
            ranges.append(OrderRange(effect.label, effect.joint_index + 1, span, whole))
    return tuple(ranges)
