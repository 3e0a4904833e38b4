"""Posterior over sets of blocks: a climb to a likely set, and a Gibbs walk from there.

The number K of missing blocks has the prior p(0) = 1 / (1 + `SOME`) and p(K) ~ K^-`TAIL`: one effect is likelier than
two, but where many are seen further ones are expected (a beta mixture of binomials has such a tail). Which ones they
are has a probability in proportion to their weights. An outlying row does not count as a block: each is outlying with
the odds `WRONG`; nor does the rest of the library, which is there with the odds `REST_ODDS`.

A step takes a block x, or nothing, out of a set A of k blocks and puts one back, size included, or none. The climb
takes the likeliest, as long as that is likelier. The walk takes each out with probability 1 / (k + 1) and draws with
odds in proportion to p(A' + x) / (|A' + x| + 1), A' = A - x: a Gibbs step of the joint distribution of A and x, so that
A is drawn from its posterior; what is counted is not the draw but the probabilities it was drawn with (A. E. Gelfand,
A. F. M. Smith, 1990, "Rao-Blackwellization").
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
from identification.gap.evidence import SIZES, Products, State

# reasons: identification/README.md, "Constants"
SOME = 1.0  # prior odds of something missing to nothing
TAIL = 3.0  # p(K) ~ K^-TAIL
WRONG = 0.0005  # prior odds of a row to be outlying
REST_ODDS = 0.1  # prior odds of the rest of the library
NEGLIGIBLE = 0.01  # share of the probability in blocks that the walk leaves out
MOVES = 1000  # effort: of the walk
ROUNDS = 3  # effort: of the climb
PAIRS = 10  # effort: of the climb, blocks that are tried in pairs
LEAST = 1e-5  # probability of a set that is kept
ROUNDING = 1e-6  # of a log likelihood

Set = tuple[int, ...]
Key = tuple[tuple[int, int], ...]  # blocks with their sizes, ascending


class Weighed(NamedTuple):
    """A set of blocks (ascending numbers) with the numbers of its likeliest sizes and its log posterior odds against
    nothing."""

    blocks: Set
    sizes: tuple[int, ...]
    log_odds: float


class Moments:
    """Means over draws from the posterior, of P coefficients that are zero where their block is not in the set.

    count : of draws;  first, second : (P,) and (P, P) sums of the coefficients and of their products
    variance : sum of the noise's variances;  effective : sum of the numbers of parameters
    """

    def __init__(self, products: Products) -> None:
        size = int(products.starts[-1])
        self.count, self.variance, self.effective = 0, 0.0, 0.0
        self.first, self.second = np.zeros(size), np.zeros((size, size))
        self._products = products

    def add(self, state: State, count: int = 1) -> None:
        """One draw of a set with its sizes, its coefficients averaged over."""
        variance = state.squares / max(self._products.freedom, 1)
        of_each = np.repeat(
            [SIZES[size] ** 2 for _, size in state.order], self._products.widths[[block for block, _ in state.order]]
        )
        self.count += count
        self.variance += count * variance
        self.effective += count * float(np.sum(1.0 - np.diag(state.covariance) / of_each))
        self.first[state.places] += count * state.mean
        products = variance * state.covariance + np.outer(state.mean, state.mean)
        self.second[np.ix_(state.places, state.places)] += count * products


class Walked(NamedTuple):
    """The sets that matter, likeliest first, and the moments of draws without and with the rest of the library."""

    sets: list[Weighed]
    moments: tuple[Moments, Moments]


@dataclass(eq=False)
class Search:
    """The sets of blocks of one linearized problem.

    weights : (B,) prior weights;  rows : (B,) True for shifts of single rows
    rest : numbers of blocks that explain a part of many others: the climb starts without them
    apart : pairs of blocks of which one contains the other
    needy : blocks that show only through one of the `givers`, beside which alone they may be
    total : weight of all blocks, where these are some of them
    """

    products: Products
    weights: Array
    rows: NDArray[np.bool_]
    rest: frozenset[int] = frozenset()
    apart: frozenset[tuple[int, int]] = frozenset()
    needy: frozenset[int] = frozenset()
    givers: frozenset[int] = frozenset()
    total: float | None = None
    _tables: dict[tuple[Key, frozenset[int]], Array] = field(default_factory=dict)

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

    def log_odds(self, state: State) -> float:
        """Log posterior odds of a set with its sizes against nothing missing."""
        of_sizes = -float(np.sum(np.log(self.products.limits[list(state.blocks)])))
        return self.products.ratio(state) + self.products.signed(state) + self.log_prior(state.blocks) + of_sizes

    def climb(self, start: Set = ()) -> State:
        """The likeliest set that adding, dropping and exchanging blocks leads to;  start : a set that may be good"""
        nothing = self.products.nothing
        tops = [nothing, self._up(self.products.state([(block, 2) for block in start]), self.rest)]
        table = self._each(nothing)
        for block in np.argsort(-np.round(logsumexp(table, axis=1), 9), kind="stable")[:PAIRS].tolist():
            if np.isfinite(table[block]).any():  # two that hide each other are seen together
                single = self.products.with_block(nothing, block, int(np.argmax(table[block])))
                pair = self._put(single, self._each(single))
                tops += [single, self._up(pair, frozenset(range(len(table))) - set(pair.blocks))]  # its sizes alone
        return self._up(self._up(max(tops, key=lambda one: round(self.log_odds(one), 9)), self.rest))

    def _up(self, state: State, barred: frozenset[int] = frozenset()) -> State:
        """Add the likeliest block as long as the set gets likelier; put the likeliest, or none, in the place of each;
        and so on, round after round, until nothing changes;  barred : blocks that are not added"""
        for _ in range(ROUNDS):
            before = state.key
            for block in (-1, *state.blocks):
                if block in state.blocks:
                    fewer = self.products.without(state, block)
                    table = self._each(fewer, barred - {block})
                    nothing = np.isfinite(self.log_prior(fewer.blocks)) and np.max(logsumexp(table, axis=1)) <= 0.0
                    best = None if nothing else self._likeliest(table, block)
                    if best != (block, dict(state.order)[block]):
                        state = fewer if best is None else self.products.with_block(fewer, *best)
                while len(state.order) < self.products.freedom:  # rows that are fitted exactly would take all blocks
                    table = self._each(state, barred)
                    if np.max(logsumexp(table, axis=1)) <= ROUNDING:
                        break
                    state = self._put(state, table)
            if state.key == before:
                break
        return state

    def _likeliest(self, table: Array, first: int = -1) -> tuple[int, int] | None:
        """The block that is likeliest in a table, and its likeliest size; None without any;  first : of those equally
        likely"""
        odds = logsumexp(table, axis=1)
        if not np.isfinite(np.max(odds, initial=-np.inf)):
            return None
        best = first if first >= 0 and odds[first] >= np.max(odds) - ROUNDING else int(np.argmax(np.round(odds, 9)))
        return best, int(np.argmax(np.round(table[best], 9)))

    def _put(self, state: State, table: Array) -> State:
        """A set with the block that is likeliest in a table."""
        best = self._likeliest(table)
        return state if best is None else self.products.with_block(state, *best)

    def near(self, top: State) -> list[int]:
        """All blocks but those that are together negligible beside a set and in place of one of its blocks."""
        best = self.log_odds(top)
        states = [self.products.nothing, top, *(self.products.without(top, block) for block in top.blocks)]
        odds = [self.log_odds(one) + logsumexp(self._each(one), axis=1) for one in states]
        shares = np.exp(np.minimum(np.nan_to_num(np.max(odds, axis=0), nan=-np.inf) - best, 0.0))
        order = np.argsort(shares, kind="stable")
        return sorted({*order[np.cumsum(shares[order]) > NEGLIGIBLE * (1.0 + shares.sum())].tolist(), *top.blocks})

    def walk(self, top: State, generator: np.random.Generator, moves: int | None = None) -> Walked:
        """The posterior, from a set to start from;  moves : steps, None: `MOVES`"""
        moves = moves or MOVES
        state, steps, odds = top, dict[Key, tuple[Array, Array]](), dict[Key, float]()
        visits, moments = Counter[Key](), (Moments(self.products), Moments(self.products))
        for _ in range(moves):
            taken = int(generator.integers(len(state.order) + 1))
            fewer = self.products.without(state, state.blocks[taken]) if taken < len(state.order) else state
            visits[fewer.key] += 1
            if fewer.key not in steps:
                each = self._each(fewer) - np.log(len(fewer.order) + 2)
                stay = -np.log(len(fewer.order) + 1) if np.isfinite(self.log_prior(fewer.blocks)) else -np.inf
                every = np.append(each.ravel(), stay)
                shares = np.exp(every - logsumexp(every))
                steps[fewer.key] = shares, np.cumsum(shares)
            total = steps[fewer.key][1]
            drawn = int(np.searchsorted(total, generator.random() * total[-1], side="right"))
            inside = drawn < len(self.weights) * len(SIZES)
            state = self.products.with_block(fewer, *divmod(drawn, len(SIZES))) if inside else fewer
            if state.key not in odds:
                odds[state.key] = self.log_odds(state)
            moments[not self.rest.isdisjoint(state.blocks)].add(state)
        return Walked(self._counted_up(visits, {key: shares for key, (shares, _) in steps.items()}, odds), moments)

    def _counted_up(self, visits: Counter[Key], steps: dict[Key, Array], odds: dict[Key, float]) -> list[Weighed]:
        """The sets, from the probabilities with which each was drawn;  odds : log odds of those that were"""
        total: defaultdict[Key, float] = defaultdict(float)
        for key, count in visits.items():
            shares = steps[key] * (count / visits.total())
            total[key] += float(shares[-1])
            for k in np.flatnonzero(shares[:-1] > 0.1 * LEAST).tolist():
                total[tuple(sorted((*key, divmod(k, len(SIZES)))))] += float(shares[k])
        # the draws have these odds together, and this share of the probability
        evidence = float(logsumexp(list(odds.values())) - np.log(sum(total[key] for key in odds)))
        of_set: defaultdict[Set, float] = defaultdict(float)
        likeliest: dict[Set, Key] = {}
        for key, share in sorted(total.items(), key=lambda item: (-item[1], item[0])):
            blocks = tuple(b for b, _ in key)
            of_set[blocks] += share
            likeliest.setdefault(blocks, key)
        order = sorted((-share, blocks) for blocks, share in of_set.items() if share > LEAST)
        sizes = {blocks: tuple(size for _, size in likeliest[blocks]) for _, blocks in order}
        return [Weighed(blocks, sizes[blocks], float(np.log(-negative)) + evidence) for negative, blocks in order]

    def _each(self, state: State, barred: frozenset[int] = frozenset()) -> Array:
        """(B, S) log odds of the set with each further block in each size against the set; -inf where it may not be."""
        if (state.key, barred) not in self._tables:
            chosen, inside = set(state.blocks), list(state.blocks)
            count = int(np.sum(self.counted[inside]))
            step = np.where(self.counted, log_odds_of_count(count + 1) - log_odds_of_count(count), 0.0)
            prior = step + self._log_weights - np.log(self.products.limits)
            prior[[b for a, b in self.apart if a in chosen] + [a for a, b in self.apart if b in chosen]] = -np.inf
            if not chosen & self.givers:
                others = set(range(len(prior))) - self.givers if chosen & self.needy else self.needy
                prior[list(others)] = -np.inf
            self._tables[state.key, barred] = self.products.added(state, barred) + prior[:, None]
        return self._tables[state.key, barred]


def log_odds_of_count(count: int) -> float:
    """log p(K) / p(0), times the K! orders in which the same blocks can be drawn."""
    return float(np.log(SOME / zeta(TAIL)) - TAIL * np.log(count)) + lgamma(count + 1) if count else 0.0
