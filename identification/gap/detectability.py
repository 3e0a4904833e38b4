"""How visible each effect is beside the base model, from which size on it is detected, and which effects look like it.

All of this follows from the columns of `gap.blocks`, projected off the base model. Two effects of likeness 1 cannot be
told apart by these rows, whatever their sizes (identification/README.md, "Gap workflow").
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import betaincinv, ncfdtr, nctdtr, stdtrit

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.document import Documented
from identification.documents.diagnosis import detectability_document
from identification.errors import require
from identification.estimation.doubts import SPARE
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.blocks import Library, Linearized, hypotheses, linearized
from identification.gap.fit import Rows, fit
from identification.gap.likelihood import Index, orthonormal
from identification.information import VISIBLE
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.running import single_thread

POWER = 0.9  # convention: what is "excluded" a test finds in nine cases of ten, the posterior less often
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

    def __str__(self) -> str:
        return "invisible" if self.value is None else f"{self.value:.3g} {self.unit}".removesuffix(" 1")


@dataclass(frozen=True)
class Detectability(Documented):
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
        """Pairs (effect, effect like it, likeness) with a likeness of at least `NEAR`, strongest first."""
        return pairs_of(self.names, self.likeness)

    def to_json(self) -> dict[str, object]:
        """Plain data for `--json`."""
        sizes = [self.detectable[name] for name in self.names]
        listed = zip(self.names, self.norm_fractions.tolist(), sizes, strict=True)
        return {
            "effects": [{"effect": e, "share": f, "detectable": s.value, "unit": s.unit} for e, f, s in listed],
            "alias_pairs": [{"effect": a, "like": b, "likeness": c} for a, b, c in self.pairs()],
            "degrees_of_freedom": self.freedom,
            "skipped": dict(self.skipped),
            "never_visible": dict(self.aliases),
        }

    document = detectability_document


@single_thread()  # the same bits, whatever the number of threads
def detectability(
    arm: Arm, postures: Array, conditions: Conditions | None = None, runs: Array | None = None
) -> Detectability:
    """Which effects measurements at (m, n) postures [rad] could detect, and at which size: with the noise of the arm's
    data sheet, else per millimetre of noise.

    conditions : of the rows; thermal effects are included only if it has temperatures
    runs : (m,) > 0, how many each row stands for, None: one

    Raises `InputError` with fewer than 4 residual degrees of freedom.
    """
    model, sigma = Model(arm), arm.sigma or 1.0
    postures, deviations = np.atleast_2d(postures), None if runs is None else sigma / np.sqrt(runs)
    rows = Rows.of(Measurements(postures, np.zeros((len(postures), model.dimension)), sigma=deviations))
    stated = {} if conditions is None else {k: v for k, v in vars(conditions).items() if v is not None}
    filled = replace(rows.conditions, **stated)
    rows = replace(rows, positions=model.position(rows.postures, None, filled), conditions=filled)
    library = hypotheses(arm, frozenset({"temperature"} & {*stated}), rows)
    exact = fit(library.base, rows, {})
    require_spare(exact.freedom, len(rows))
    return assess(library, linearized(library, exact, outside=False), rows, rows.sigma or sigma)


def require_spare(freedom: int, rows: int) -> None:
    """Raise `InputError` with fewer than `SPARE` residual degrees of freedom."""
    left, allowed = f"{freedom} residual degrees of freedom for tests", f"at least {SPARE}; measure more postures"
    require(freedom >= SPARE, f"measurements: {rows} rows leave {left}, allowed: {allowed}")


def assess(library: Library, problem: Linearized, rows: Rows, sigma: float) -> Detectability:
    """Detectability of the library's effects in the rows of a problem;  sigma : of one whitened coordinate [mm]"""
    products = problem.products
    sizes, widths = np.array([column.shape[2] for column in problem.columns]), products.widths
    # of each effect that can be seen in all combinations of its parameters: the least length of a unit of them [mm],
    # projected off the base model, as a fraction and beside the longest before, and how far a unit moves the tip
    least, fraction, longest, far = np.zeros((4, len(problem.blocks)))
    listed = np.array([block.listed for block in problem.blocks], dtype=bool)
    for width in np.unique(sizes):
        alike = np.flatnonzero(listed & (sizes == width) & (widths == width)).tolist()
        if alike:
            back = np.linalg.inv(np.array([problem.roots[k] for k in alike]))  # to the coefficients of the columns
            numbers = products.starts[alike][:, None] + np.arange(width)
            grams = back.transpose(0, 2, 1) @ products.gram[numbers[:, :, None], numbers[:, None, :]] @ back
            moving = np.concatenate([problem.columns[k] for k in alike], axis=2)
            lengths = np.maximum(np.linalg.norm(rows.whiten(moving), axis=0), 1e-150).reshape(-1, width)
            units = grams / (lengths[:, :, None] * lengths[:, None, :])
            squares = [np.maximum(np.linalg.eigvalsh(each)[:, 0], 0.0) for each in (grams, units)]
            least[alike], fraction[alike] = np.sqrt(squares)
            longest[alike] = lengths.max(axis=1)
            far[alike] = np.linalg.norm(moving, axis=(0, 1)).reshape(-1, width).max(axis=1) / np.sqrt(len(rows))

    detectable, plain = dict[str, Size](), dict[str, int | None]()
    level = LEVEL / sum(member.weight for member in library.members)
    for block in library.members:
        if block.effect is None or block.through:
            continue
        parameter, k = block.effect.parameters[0], problem.numbers.get(block.label)
        size, spare = Size(None, parameter.file_unit), products.freedom - block.size
        if k is not None and spare > 0 and least[k] > VISIBLE * longest[k]:
            one_sided = bool(products.signs[k])
            needed = detectable_lambda(block.size, spare, level * block.weight, one_sided) * sigma / least[k]
            # an effect that moves the tip farther is seen without a test, and is not linear
            if needed * far[k] <= 0.1 * library.base.reach:
                size = Size(float(needed * parameter.to_file), parameter.file_unit, float(needed * far[k]))
        # of several settings the one that is hardest to see, and of those equally hard the one that moves the tip most
        settings = detectable.get(block.key, size), size
        detectable[block.key] = max(settings, key=lambda one: (float(f"{one.value or np.inf:.9g}"), one.tip_mm or 0.0))
        if not block.effect.chosen:
            plain[block.key] = k
    fractions = readonly([0.0 if k is None else fraction[k] for k in plain.values()])
    columns = [products.columns_of([] if k is None else [k]) for k in plain.values()]
    likeness = readonly(likenesses(products.gram, columns))
    about = library.skipped, library.aliases
    return Detectability(tuple(plain), fractions, likeness, detectable, products.freedom, *about)


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


# -- look-alikes -------------------------------------------------------------------------------------------------------
def likenesses(gram: Array, parts: Sequence[Index]) -> Array:
    """(H, H) root mean square fraction of the one's columns (row) that another's explain.

    gram : (P, P) products of projected columns;  parts : of each one the indices of its columns
    """
    bases = [orthonormal(gram[np.ix_(part, part)]) for part in parts]
    widths = np.array([basis.shape[1] for basis in bases], dtype=np.int64)
    every = np.concatenate([np.zeros(0, dtype=np.int64), *parts])
    owner, turn = np.repeat(np.eye(len(parts)), widths, axis=0), block_diag(*bases) if bases else np.zeros((0, 0))
    squares = owner.T @ np.square(turn.T @ gram[np.ix_(every, every)] @ turn) @ owner
    return np.asarray(np.minimum(np.sqrt(squares / np.maximum(widths, 1)[:, None]), 1.0))


def pairs_of(names: Sequence[str], likeness: Array) -> list[tuple[str, str, float]]:
    """As `Detectability.pairs`."""
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
        (k, b.label)
        for k, b in enumerate(problem.blocks)
        if b.effect is not None and b.place in places and (b.effect.chosen or b.label in labels)
    ]
    likeness = likenesses(problem.products.gram, [problem.products.columns_of([k]) for k, _ in near])
    waves = pairs_of([label for _, label in near], likeness)
    scanned = [pair for pair in waves if pair[0] in labels and "[" in pair[1]]
    never = [(name, like, 1.0) for name, like in sees.aliases.items()]
    return (*scanned, *(pair for pair in sees.pairs() if pair[0] in labels), *never)
