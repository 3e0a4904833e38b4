"""Pre-flight analysis of a plan: which effects it could detect, and at which size, before any data are taken.

See identification/README.md, "Gap workflow", step 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from scipy.special import betaincinv, ncfdtr, nctdtr, stdtrit

from identification.arm import Arm
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.gap.fit import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet, hypotheses
from identification.information import column_space
from identification.measurements import Conditions, directions_from_order, past_from_order, session_time
from identification.model import Model
from identification.threads import single_thread

# reasons: identification/README.md, "Constants"
SPARE = 4  # residual degrees of freedom; with fewer an effect of two parameters is found at no size
POWER, LEVEL = 0.9, 0.05  # convention
EXACT, NEAR = 0.9999, 0.9  # likeness: odds of two effects stay below 20 up to lambda = 173 and 5.6
VISIBLE = 1e-4  # share of a column's length that must survive projection; less is an alias of what is in the model
LARGEST = 0.1  # of the reach: an effect that moves the tip farther is seen without a test


@dataclass(frozen=True)
class Size:
    """Size of a parameter in the unit of files and tables; None if no size can be detected.

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

    def pairs(self, level: float = NEAR) -> list[tuple[str, str, float]]:
        """Pairs (effect, effect like it, likeness) with a likeness of at least `level`, strongest first."""
        rows, columns = np.nonzero((self.likeness >= level) & ~np.eye(len(self.names), dtype=bool))
        found = [(self.names[i], self.names[j], float(self.likeness[i, j])) for i, j in zip(rows, columns, strict=True)]
        return sorted(found, key=lambda pair: -pair[2])

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

    def __str__(self) -> str:
        lines = [
            f"{self.freedom} residual degrees of freedom",
            f"{'effect':32} fraction  smallest detectable size (90 % power)",
        ]
        for name, fraction in zip(self.names, self.norm_fractions, strict=True):
            lines.append(f"{name:32} {fraction:8.2f}  {self.detectable[name]}")
        return "\n".join(lines)


@single_thread()  # the same bits, whatever the number of threads
def detectability(arm: Arm, postures: Array, conditions: Conditions | None = None) -> Detectability:
    """Which effects measurements at (m, n) postures [rad] could detect, and at which size: with the noise of the arm's
    data sheet, else per millimetre of noise.

    conditions : of the rows; thermal effects are included only if it has temperatures

    Raises `InputError` with fewer than 4 residual degrees of freedom.
    """
    given = frozenset() if conditions is None or conditions.temperature is None else frozenset({"temperature"})
    rows = _planned(postures, conditions, Model(arm).dimension)
    library = hypotheses(arm, given, rows)
    return assess(library, rows, library.base.jacobian(rows.postures, None, rows.conditions), {}, arm.sigma or 1.0)


def _planned(postures: Array, conditions: Conditions | None, dimension: int) -> Rows:
    q = np.atleast_2d(np.asarray(postures, dtype=float))
    order = np.arange(len(q), dtype=float)
    given = {} if conditions is None else {k: v for k, v in vars(conditions).items() if v is not None}
    by_order = {"time": session_time(order), "directions": directions_from_order(q), "past": past_from_order(q)}
    filled = Conditions(**(by_order | given))
    return Rows(q, np.zeros((len(q), dimension)), filled, order)


def require_spare(freedom: int, rows: int) -> None:
    """Raise `InputError` with fewer than `SPARE` residual degrees of freedom."""
    if freedom < SPARE:
        raise InputError(
            f"measurements: {rows} rows leave {freedom} residual degrees of freedom for tests, "
            f"allowed: at least {SPARE}; measure more postures"
        )


def assess(
    library: HypothesisSet,
    rows: Rows,
    jacobian: Array,
    values: Mapping[str, float],
    sigma: float,
) -> Detectability:
    """Detectability at given base parameters.

    jacobian : (m, d, p) of the base model at `values`;  sigma : noise of one coordinate [mm]
    """
    white = rows.whiten(jacobian)
    basis = column_space(white, library.base.scales)
    freedom = len(white) - basis.shape[1]
    require_spare(freedom, len(rows))
    matrix, members = library.matrix(rows, values), library.members
    ends = np.concatenate([[0], np.cumsum(library.sizes)])
    squares = np.einsum("nc,nc->c", matrix, matrix)
    matrix -= basis @ (basis.T @ matrix)
    threshold = LEVEL / sum(h.weight for h in members)
    limit = LARGEST * library.base.reach, len(rows)
    sizes: dict[str, list[Size]] = {}
    fractions: dict[int, float] = {}
    for k, hypothesis in enumerate(members):
        if not library.acts(hypothesis):
            continue
        part = slice(ends[k], ends[k + 1])
        own, whole = matrix[:, part], float(np.sqrt(squares[part].max()))
        lengths = np.sqrt(np.maximum(squares[part], 1e-300))
        gram = own.T @ own
        least = float(np.sqrt(max(np.linalg.eigvalsh(gram)[0], 0.0)))
        fractions[k] = float(np.sqrt(max(np.linalg.eigvalsh(gram / np.outer(lengths, lengths))[0], 0.0)))
        size = _detectable(hypothesis, whole, least, freedom, sigma, threshold * hypothesis.weight, *limit)
        sizes.setdefault(hypothesis.key, []).append(size)
    plain = [k for k in fractions if not members[k].scanned]
    return Detectability(
        tuple(members[k].key for k in plain),
        readonly(np.array([fractions[k] for k in plain])),
        readonly(likenesses([matrix[:, ends[k] : ends[k + 1]] for k in plain])),
        # of several settings the one that is hardest to see
        MappingProxyType({key: max(found, key=Size.order) for key, found in sizes.items()}),
        freedom,
        library.skipped,
        library.aliases,
    )


def likenesses(columns: Sequence[Array]) -> Array:
    """(H, H) root mean square share of one member's columns (row), projected off the base, in another's span."""
    bases, owner = [], []
    for k, own in enumerate(columns):
        u, s, _ = np.linalg.svd(own, full_matrices=False)
        kept = u[:, s > VISIBLE * s.max(initial=0.0)] if s.max(initial=0.0) > 0.0 else u[:, :0]
        bases.append(kept)
        owner += [k] * kept.shape[1]
    if not owner:
        return np.zeros((len(columns), len(columns)))
    stacked, belongs = np.hstack(bases), np.eye(len(columns))[owner]
    squares = belongs.T @ np.square(stacked.T @ stacked) @ belongs
    return np.minimum(np.sqrt(squares / np.maximum(belongs.sum(axis=0), 1.0)[:, None]), 1.0)


def _detectable(
    hypothesis: Hypothesis, whole: float, least: float, freedom: int, sigma: float, level: float, limit: float, m: int
) -> Size:
    """The smallest size seen in m rows;  whole, least : as in `shown_lengths`;  limit : of what moves the tip [mm]"""
    parameter = hypothesis.effect.parameters[0]
    if whole == 0.0 or least <= 1e-6 * whole or freedom <= hypothesis.size:
        return Size(None, parameter.file_unit)
    needed = detectable_lambda(hypothesis.size, freedom - hypothesis.size, level, hypothesis.one_sided)
    size = needed * sigma / least
    moved = size * whole / np.sqrt(m)
    if moved > limit:
        return Size(None, parameter.file_unit)
    return Size(float(size * parameter.to_file), parameter.file_unit, float(moved))


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
