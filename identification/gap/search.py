"""Posterior over sets of blocks: a climb to a likely set, and a Gibbs walk from there.

The number K of missing blocks has the prior p(0) = 1 / (1 + `SOME`) and p(K) ~ K^-`TAIL`: one effect is likelier than
two, but where many are seen further ones are expected (a beta mixture of binomials has such a tail). Which ones they
are has a probability in proportion to their weights. An outlying row does not count as a block: each is outlying with
the odds `WRONG`; nor does the rest of the library, which is there with the odds `REST_ODDS`.

A step of the walk takes a block x, or nothing, out of a set A of k blocks, each with probability 1 / (k + 1), and draws
x again, size included, with odds in proportion to p(A' + x) / (|A' + x| + 1), A' = A - x. This is a Gibbs step of
the joint distribution of A and x, so that A is drawn from its posterior; what is counted is not the draw but the
probabilities it was drawn with (A. E. Gelfand, A. F. M. Smith, 1990, "Rao-Blackwellization").
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import lgamma
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, zeta

from identification.arrays import Array
from identification.gap.evidence import ROUNDING, SIZES, Products

# reasons: identification/README.md, "Constants"
SOME = 1.0  # prior odds of something missing to nothing
TAIL = 3.0  # p(K) ~ K^-TAIL
WRONG = 0.0005  # prior odds of a row to be outlying
REST_ODDS = 0.1  # prior odds of the rest of the library
NEGLIGIBLE = 0.01  # share of the probability in blocks that the walk leaves out
MOVES = 1000  # effort: of the walk
PAIRS, TRIED = 10, 3  # effort: of the climb, blocks that are tried in pairs, and exchanges at each step
LEAST = 1e-5  # probability of a set that is kept

Set = tuple[int, ...]


class Weighed(NamedTuple):
    """A set of blocks (ascending numbers) with the numbers of its sizes and its log posterior odds against nothing."""

    blocks: Set
    sizes: tuple[int, ...]
    log_odds: float


@dataclass(eq=False)
class Search:
    """The sets of blocks of one linearized problem.

    weights : (B,) prior weights;  rows : (B,) True for shifts of single rows
    rest : numbers of blocks that explain a part of many others: the climb starts without them
    apart : pairs of blocks of which one contains the other
    needy : blocks that show only through one of the `givers`, beside which alone they may be
    """

    products: Products
    weights: Array
    rows: NDArray[np.bool_]
    rest: frozenset[int] = frozenset()
    apart: frozenset[tuple[int, int]] = frozenset()
    needy: frozenset[int] = frozenset()
    givers: frozenset[int] = frozenset()
    total: float | None = None  # weight of all blocks, where these are some of them
    weighed: dict[Set, Weighed] = field(default_factory=dict)
    _fewer: dict[Set, Array] = field(default_factory=dict)
    _each: dict[tuple[Set, tuple[int, ...]], Array] = field(default_factory=dict)

    @cached_property
    def counted(self) -> NDArray[np.bool_]:
        """(B,) blocks that count among the K."""
        counted = ~self.rows
        counted[list(self.rest)] = False
        return counted

    @cached_property
    def _log_weights(self) -> Array:
        with np.errstate(divide="ignore"):
            log_weights = np.log(self.weights / max(self.total or np.sum(self.weights[self.counted]), 1e-300))
        log_weights[self.rows] = np.log(WRONG)
        log_weights[list(self.rest)] = np.log(REST_ODDS)
        return np.asarray(log_weights)

    def log_prior(self, blocks: Sequence[int]) -> float:
        """Log prior odds of a set against nothing missing; -inf where it may not be."""
        chosen = set(blocks)
        if any(chosen >= {*pair} for pair in self.apart) or (chosen & self.needy and not chosen & self.givers):
            return -np.inf
        count = int(np.sum(self.counted[list(blocks)]))
        return log_odds_of_count(count) + float(np.sum(self._log_weights[list(blocks)]))

    def climb(self, start: Set = ()) -> Weighed:
        """The likeliest set that adding, dropping and exchanging blocks leads to;  start : a set that may be good"""
        nothing = self.weigh((), ())
        tops = [nothing, self._up(self.weigh(start, (2,) * len(start)), self.rest)]
        for single in self._longer(nothing, PAIRS):  # two that hide each other are seen together
            self.weigh(single.blocks, single.sizes)
            tops += [self.weigh(o.blocks, o.sizes) for o in self._longer(single, 1)]
        return self._up(self._up(min(tops, key=_likeliest_first), self.rest), exchange=True)

    def near(self, top: Weighed) -> list[int]:
        """All blocks but those that are together negligible beside a set and in place of one of its blocks."""
        odds = [
            one.log_odds + _over_sizes(self._with_each(one)) for one in [self.weigh((), ()), top, *self._shorter(top)]
        ]
        shares = np.exp(np.minimum(np.max(odds, axis=0) - top.log_odds, 0.0))
        order = np.argsort(shares, kind="stable")
        return sorted({*order[np.cumsum(shares[order]) > NEGLIGIBLE * (1.0 + shares.sum())].tolist(), *top.blocks})

    def walk(self, top: Weighed, generator: np.random.Generator) -> list[Weighed]:
        """All sets that matter, likeliest first, their odds such that they share the posterior;  top : to start from"""
        at = dict(zip(top.blocks, top.sizes, strict=True))
        steps: dict[tuple[Set, tuple[int, ...]], tuple[Array, Array]] = {}
        visits: Counter[tuple[Set, tuple[int, ...]]] = Counter()
        for _ in range(MOVES):
            taken = int(generator.integers(len(at) + 1))
            if taken < len(at):
                del at[sorted(at)[taken]]
            blocks = tuple(sorted(at))
            there = blocks, tuple(at[b] for b in blocks)
            visits[there] += 1
            if there not in steps:
                odds = self._with_each(Weighed(*there, 0.0)) - np.log(len(at) + 2)
                stay = -np.log(len(at) + 1) if np.isfinite(self.log_prior(blocks)) else -np.inf
                every = np.append(odds.ravel(), stay)
                shares = np.exp(every - logsumexp(every))
                steps[there] = shares, np.cumsum(shares)
            drawn = int(np.searchsorted(steps[there][1], generator.random() * steps[there][1][-1], side="right"))
            if drawn < len(self.weights) * len(SIZES):
                at[drawn // len(SIZES)] = drawn % len(SIZES)
        return self._counted_up(visits, {there: shares for there, (shares, _) in steps.items()})

    def _counted_up(
        self, visits: Counter[tuple[Set, tuple[int, ...]]], steps: dict[tuple[Set, tuple[int, ...]], Array]
    ) -> list[Weighed]:
        """The sets, from the probabilities with which each was drawn."""
        total: defaultdict[Set, float] = defaultdict(float)
        most: dict[Set, tuple[float, tuple[int, ...]]] = {}

        def add(blocks: Set, sizes: tuple[int, ...], share: float) -> None:
            total[blocks] += share
            if blocks not in most or share > most[blocks][0]:
                most[blocks] = share, sizes

        for (blocks, sizes), count in visits.items():
            shares = steps[blocks, sizes] * (count / MOVES)
            add(blocks, sizes, float(shares[-1]))
            table = shares[:-1].reshape(-1, len(SIZES))
            each = table.sum(axis=1)
            for b in np.flatnonzero(each > 0.1 * LEAST).tolist():
                new = dict(zip(blocks, sizes, strict=True)) | {b: int(np.argmax(table[b]))}
                add(tuple(sorted(new)), tuple(new[k] for k in sorted(new)), float(each[b]))
        sets = sorted((-share, blocks) for blocks, share in total.items() if share > LEAST)
        best = self.weigh(sets[0][1], most[sets[0][1]][1])
        evidence = best.log_odds - np.log(-sets[0][0])  # of all sets together
        return [Weighed(blocks, most[blocks][1], float(np.log(-share)) + evidence) for share, blocks in sets]

    def weigh(self, blocks: Set, sizes: tuple[int, ...]) -> Weighed:
        """A set with its likeliest sizes and its odds;  sizes : to start from"""
        if blocks not in self.weighed:
            at, ratio, self._fewer[blocks] = self.products.likeliest(blocks, sizes)
            self.weighed[blocks] = Weighed(blocks, at, ratio + self.log_prior(blocks))
        return self.weighed[blocks]

    def _up(self, current: Weighed, barred: frozenset[int] = frozenset(), exchange: bool = False) -> Weighed:
        """Add, drop or exchange the best block as long as the set gets likelier;  barred : blocks that are not added"""
        while True:
            shorter = self._shorter(current)
            best = self._best([*self._longer(current, 1, barred), *shorter[:1]], current)
            if best is current and exchange:
                exchanged = [new for one in shorter for new in self._longer(one, 1, barred)]
                best = self._best(sorted(exchanged, key=_likeliest_first)[:TRIED], current)
            if best is current:
                return current
            current = best

    def _best(self, options: Sequence[Weighed], current: Weighed) -> Weighed:
        """The likeliest of some sets, weighed exactly, or the current one if none is likelier."""
        best = min((self.weigh(o.blocks, o.sizes) for o in options), key=_likeliest_first, default=current)
        return best if best.log_odds > current.log_odds + ROUNDING else current

    def _shorter(self, one: Weighed) -> list[Weighed]:
        """The set without each of its blocks, where that may be, likeliest first."""
        fewer = self._fewer[self.weigh(one.blocks, one.sizes).blocks]
        shorter = []
        for k, change in enumerate(fewer.tolist()):
            blocks, sizes = one.blocks[:k] + one.blocks[k + 1 :], one.sizes[:k] + one.sizes[k + 1 :]
            prior = self.log_prior(blocks) - self.log_prior(one.blocks)
            shorter.append(Weighed(blocks, sizes, one.log_odds + change + prior))
        return sorted((o for o in shorter if np.isfinite(o.log_odds)), key=_likeliest_first)

    def _longer(self, one: Weighed, count: int, barred: frozenset[int] = frozenset()) -> list[Weighed]:
        """The set with each of the further blocks that make it likeliest, likeliest first."""
        table = self._with_each(one)
        odds = _over_sizes(table)
        odds[list(barred)] = -np.inf
        longer = []
        for b in np.argsort(-np.round(odds, 9), kind="stable")[:count].tolist():
            if np.isfinite(odds[b]):
                new = dict(zip(one.blocks, one.sizes, strict=True)) | {b: int(np.argmax(table[b]))}
                blocks = tuple(sorted(new))
                longer.append(Weighed(blocks, tuple(new[k] for k in blocks), one.log_odds + float(odds[b])))
        return longer

    def _with_each(self, one: Weighed) -> Array:
        """(B, S) log odds of the set with each further block in each size against the set; -inf where it may not be."""
        if (key := (one.blocks, one.sizes)) not in self._each:
            chosen, own = set(one.blocks), list(one.blocks)
            count = int(np.sum(self.counted[own]))
            step = np.where(self.counted, log_odds_of_count(count + 1) - log_odds_of_count(count), 0.0)
            prior = step + self._log_weights - np.log(self.products.limits)
            prior[own] = -np.inf
            prior[[b for a, b in self.apart if a in chosen] + [a for a, b in self.apart if b in chosen]] = -np.inf
            if not chosen & self.givers:
                others = set(range(len(prior))) - self.givers if chosen & self.needy else self.needy
                prior[list(others)] = -np.inf
            self._each[key] = self.products.added(self.products.left(own, SIZES[list(one.sizes)])) + prior[:, None]
        return self._each[key]


def log_odds_of_count(count: int) -> float:
    """log p(K) / p(0), times the K! orders in which the same blocks can be drawn."""
    return float(np.log(SOME / zeta(TAIL)) - TAIL * np.log(count)) + lgamma(count + 1) if count else 0.0


def _over_sizes(table: Array) -> Array:
    """(B,) log odds of blocks from those of their sizes (B, S)."""
    return np.asarray(logsumexp(table, axis=1))


def _likeliest_first(one: Weighed) -> tuple[float, Set]:
    return -round(one.log_odds, 9), one.blocks
