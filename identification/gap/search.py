"""Posterior over sets of blocks: a best-first search that adds, drops and exchanges blocks.

The number K of missing blocks has the prior p(0) = 1 / (1 + `SOME`) and p(K) ~ K^-`TAIL`: one effect is likelier than
two, but where many are seen further ones are expected (a beta mixture of binomials has such a tail). Which ones they
are has a probability in proportion to their weights. An outlying row does not count as a block: each is outlying with
the odds `WRONG`.

Every set that was expanded has all its neighbors weighed: with one block more (in closed form, with the sizes of the
others kept), with one less, and with one exchanged. The likeliest are weighed exactly and expanded in turn until those
that are not expanded have little probability left.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import lgamma

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, zeta

from identification.arrays import Array
from identification.gap.evidence import ROUNDING, SIZES, Products

# reasons: identification/README.md, "Constants"
SOME = 4.0  # prior odds of something missing to nothing
TAIL = 3.0  # p(K) ~ K^-TAIL
WRONG = 0.0005  # prior odds of a row to be outlying
WEIGHED = 3.0  # log odds below the best within which a neighbor is weighed exactly
EXPANDED = 3.0  # and within which a set is expanded
MOST, EXCHANGED = 20, 4  # effort: sets that are expanded, and those of them with exchanges
FEW = 3  # effort: blocks of a set up to which exchanges try wide blocks too
PAIRS = 10  # effort: blocks that are tried in pairs
NEGLIGIBLE = 9.0  # log odds below the best: not kept

Set = tuple[int, ...]


@dataclass(frozen=True)
class Weighed:
    """A set of blocks (ascending numbers) with the numbers of its sizes and its log posterior odds against nothing."""

    blocks: Set
    sizes: tuple[int, ...]
    log_odds: float


@dataclass(eq=False)
class Search:
    """The sets of blocks of one linearized problem.

    weights : (B,) prior weights;  rows : (B,) True for shifts of single rows
    apart : pairs of blocks of which one contains the other
    late : blocks that explain a part of many others: the search starts without and with them
    needy : blocks that show only through one of the `givers`, beside which alone they may be
    """

    products: Products
    weights: Array
    rows: NDArray[np.bool_]
    apart: frozenset[tuple[int, int]] = frozenset()
    needy: frozenset[int] = frozenset()
    givers: frozenset[int] = frozenset()
    late: frozenset[int] = frozenset()
    weighed: dict[Set, Weighed] = field(default_factory=dict)
    _fewer: dict[Set, Array] = field(default_factory=dict)
    _longer: dict[Set, tuple[Array, NDArray[np.int64]]] = field(default_factory=dict)
    _expanded: set[Set] = field(default_factory=set)

    @cached_property
    def _log_weights(self) -> Array:
        total = np.sum(self.weights[~self.rows])
        with np.errstate(divide="ignore"):
            return np.where(self.rows, np.log(WRONG), np.log(self.weights / total))

    def log_prior(self, blocks: Sequence[int]) -> float:
        """Log prior odds of a set against nothing missing."""
        return log_odds_of_count(self._count(blocks)) + float(np.sum(self._log_weights[list(blocks)]))

    def _count(self, blocks: Sequence[int]) -> int:
        return sum(not self.rows[b] for b in blocks)

    def posterior(self, starts: Sequence[Set] = ()) -> list[Weighed]:
        """All sets that matter, likeliest first;  starts : sets that may be good"""
        nothing = self._weigh((), ())
        for start in starts:
            self._weigh(start, (2,) * len(start))
        best = min(self.weighed.values(), key=_likeliest_first)
        self._climb(best, self.late)
        if self.late:
            self._climb(nothing)
        for single in self._neighbors(nothing, PAIRS)[:PAIRS]:  # two that hide each other are seen together
            for pair in self._neighbors(self._weigh(single.blocks, single.sizes), 1)[:1]:
                self._weigh(pair.blocks, pair.sizes)
        self._climb(min(self.weighed.values(), key=_likeliest_first))
        for number in range(MOST):
            least = self._best - EXPANDED
            open_ = [o for o in self.weighed.values() if o.log_odds > least and o.blocks not in self._expanded]
            if not open_:
                break
            self._expand(min(open_, key=_likeliest_first), number < EXCHANGED)
        least, every = self._best - NEGLIGIBLE, dict(self.weighed)
        for blocks, (odds, sizes) in self._longer.items():
            for b in np.flatnonzero(odds > least).tolist():
                new = self._with(self.weighed[blocks], b, odds, sizes)
                if new.blocks not in self.weighed:
                    known = every.get(new.blocks)
                    every[new.blocks] = new if known is None or known.log_odds < new.log_odds else known
        for blocks in self._fewer:
            for new in self._shorter(self.weighed[blocks]):
                if new.blocks not in every and new.log_odds > least:
                    every[new.blocks] = new
        return sorted((one for one in every.values() if one.log_odds > least), key=_likeliest_first)

    @property
    def _best(self) -> float:
        return max(one.log_odds for one in self.weighed.values())

    def _weigh(self, blocks: Set, sizes: tuple[int, ...]) -> Weighed:
        if blocks not in self.weighed:
            at, ratio, self._fewer[blocks] = self.products.likeliest(blocks, sizes)
            self.weighed[blocks] = Weighed(blocks, at, ratio + self.log_prior(blocks))
        return self.weighed[blocks]

    def _climb(self, current: Weighed, without: frozenset[int] = frozenset()) -> None:
        """Add or drop the best block as long as the set gets likelier;  without : blocks that are not added"""
        while True:
            longer = self._neighbors(current, 1 + len(without))
            options = [o for o in longer if without.isdisjoint(o.blocks)][:2]
            options += sorted(self._shorter(current), key=_likeliest_first)[:1]
            best = min((self._weigh(o.blocks, o.sizes) for o in options), key=_likeliest_first, default=current)
            if best.log_odds <= current.log_odds + ROUNDING:
                return
            current = best

    def _expand(self, one: Weighed, exchange: bool) -> None:
        """Weigh the likely sets with one block more or less, or another."""
        self._expanded.add(one.blocks)
        fewer = self._shorter(one)
        for other in [*self._neighbors(one), *(o for o in fewer if o.log_odds > self._best - WEIGHED)]:
            self._weigh(other.blocks, other.sizes)
        for start in fewer if exchange else []:
            for other in self._neighbors(self._weigh(start.blocks, start.sizes), wide=len(one.blocks) < FEW):
                self._weigh(other.blocks, other.sizes)

    def _shorter(self, one: Weighed) -> list[Weighed]:
        """The set without each of its blocks, where that may be."""
        found = []
        for k, change in enumerate(self._fewer[one.blocks].tolist()):
            blocks, sizes = one.blocks[:k] + one.blocks[k + 1 :], one.sizes[:k] + one.sizes[k + 1 :]
            if self.givers.isdisjoint(blocks) and not self.needy.isdisjoint(blocks):
                continue
            prior = self.log_prior(blocks) - self.log_prior(one.blocks)
            found.append(Weighed(blocks, sizes, one.log_odds + change + prior))
        return found

    def _neighbors(self, one: Weighed, least: int = 0, wide: bool = True) -> list[Weighed]:
        """The set with each further block, likeliest first: those that matter, and `least` in any case."""
        odds, sizes = self._with_each(one, wide)
        count = max(least, int(np.sum(odds > self._best - WEIGHED)))
        likely = np.argsort(-odds, kind="stable")[:count]
        return [self._with(one, b, odds, sizes) for b in likely.tolist() if np.isfinite(odds[b])]

    @staticmethod
    def _with(one: Weighed, b: int, odds: Array, sizes: NDArray[np.int64]) -> Weighed:
        at = bisect(one.blocks, b)
        blocks = (*one.blocks[:at], b, *one.blocks[at:])
        return Weighed(blocks, (*one.sizes[:at], int(sizes[b]), *one.sizes[at:]), float(odds[b]))

    def _with_each(self, one: Weighed, wide: bool) -> tuple[Array, NDArray[np.int64]]:
        """(B,) log posterior odds of the set with each further block, and the number of the block's likeliest size."""
        if one.blocks not in self._longer:
            added = self.products.added(self.products.given(one.blocks, SIZES[list(one.sizes)].tolist()), wide)
            count = self._count(one.blocks)
            step = np.where(self.rows, 0.0, log_odds_of_count(count + 1) - log_odds_of_count(count))
            odds = one.log_odds + added.averaged + step + self._log_weights
            odds[list(one.blocks)] = -np.inf
            for a, b in self.apart:
                if a in one.blocks or b in one.blocks:
                    odds[[a, b]] = -np.inf
            if self.givers.isdisjoint(one.blocks):
                odds[list(self.needy)] = -np.inf
            self._longer[one.blocks] = odds, np.argmax(added.ratios, axis=1)
        return self._longer[one.blocks]


def log_odds_of_count(count: int) -> float:
    """log p(K) / p(0), times the K! orders in which the same blocks can be drawn."""
    return float(np.log(SOME / zeta(TAIL)) - TAIL * np.log(count)) + lgamma(count + 1) if count else 0.0


def _likeliest_first(one: Weighed) -> tuple[float, Set]:
    return -round(one.log_odds, 9), one.blocks


def shares(sets: Sequence[Weighed]) -> Array:
    """Posterior probabilities of sets."""
    odds = np.array([one.log_odds for one in sets])
    return np.asarray(np.exp(odds - logsumexp(odds)))
