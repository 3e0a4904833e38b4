"""Posterior over sets of blocks: a best-first search that adds, drops and exchanges blocks.

The number K of missing blocks has the prior p(0) = 1 / (1 + `SOME`) and p(K) ~ K^-`TAIL`: one effect is likelier than
two, but where many are seen further ones are expected (a beta mixture of binomials has such a tail). Which ones they are has a
probability in proportion to their weights. An outlying row does not count as a block: each is outlying with the odds `WRONG`.

Every set that was expanded has all its neighbors weighed: with one block more (in closed form, with the sizes of the others
kept), with one less, and with one exchanged. The likeliest are weighed exactly and expanded in turn until those that are not
expanded have little probability left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import lgamma

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, zeta

from identification.arrays import Array
from identification.gap.evidence import SIZES, Products

# reasons: identification/README.md, "Constants"
SOME = 4.0  # prior odds of something missing to nothing
TAIL = 3.0  # p(K) ~ K^-TAIL
WRONG = 0.002  # prior odds of a row to be outlying
WEIGHED = 5.0  # log odds below the best within which a neighbor is weighed exactly
EXPANDED = 3.0  # and within which a set is expanded
MOST = 40  # effort: sets that are expanded
NEGLIGIBLE = 20.0  # log odds below the best: not kept

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
    """

    products: Products
    weights: Array
    rows: NDArray[np.bool_]
    apart: frozenset[tuple[int, int]] = frozenset()
    total: float = 0.0
    weighed: dict[Set, Weighed] = field(default_factory=dict)
    near: dict[Set, Weighed] = field(default_factory=dict)
    _added: dict[Set, None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.total = self.total or float(np.sum(self.weights[~self.rows]))
        with np.errstate(divide="ignore"):
            self._log_weights = np.where(self.rows, np.log(WRONG), np.log(self.weights / self.total))

    def log_prior(self, blocks: Sequence[int]) -> float:
        """Log prior odds of a set against nothing missing."""
        chosen = np.asarray(blocks, dtype=np.int64)
        count = int(np.sum(~self.rows[chosen])) if len(chosen) else 0
        return self._of_count(count) + float(np.sum(self._log_weights[chosen]))

    @staticmethod
    def _of_count(count: int) -> float:
        """log p(K) / p(0), times the K! orders in which the same blocks can be drawn."""
        if not count:
            return 0.0
        return float(np.log(SOME / zeta(TAIL)) - TAIL * np.log(count)) + lgamma(count + 1)

    def posterior(self, starts: Sequence[Set] = ()) -> list[Weighed]:
        """All sets that matter, likeliest first."""
        self._weigh((), ())
        for start in starts:
            self._weigh(start, (2,) * len(start))
        self._climb()
        for _ in range(MOST):
            best = max(one.log_odds for one in self.weighed.values())
            open_ = [o for o in self.weighed.values() if o.blocks not in self._expanded and o.log_odds > best - EXPANDED]
            if not open_:
                break
            self._expand(max(open_, key=lambda o: (round(o.log_odds, 6), tuple(-b for b in o.blocks))))
        best = max(one.log_odds for one in self.weighed.values())
        every = {**self.near, **self.weighed}
        kept = [one for one in every.values() if one.log_odds > best - NEGLIGIBLE]
        return sorted(kept, key=lambda o: (-round(o.log_odds, 9), o.blocks))

    def _weigh(self, blocks: Set, sizes: tuple[int, ...]) -> Weighed:
        if blocks not in self.weighed:
            at, ratio = self.products.likeliest(blocks, sizes)
            self.weighed[blocks] = Weighed(blocks, at, ratio + self.log_prior(blocks))
            self.near.pop(blocks, None)
        return self.weighed[blocks]

    @property
    def _expanded(self) -> set[Set]:
        return self.__dict__.setdefault("_done", set())

    def _climb(self) -> None:
        """Add or drop the best block as long as the set gets likelier."""
        current = max(self.weighed.values(), key=lambda o: o.log_odds)
        while True:
            options = self._longer(current)[:3]
            options += [self._without(current, k) for k in range(len(current.blocks))] if len(current.blocks) > 1 else []
            best = max((self._weigh(o.blocks, o.sizes) for o in options), key=lambda o: o.log_odds, default=current)
            if best.log_odds <= current.log_odds + 1e-9:
                return
            current = best

    def _expand(self, one: Weighed) -> None:
        self._expanded.add(one.blocks)
        neighbors = self._longer(one)
        for k in range(len(one.blocks)):
            fewer = self._weigh(*self._pair(self._without(one, k)))
            neighbors += self._longer(fewer)
        best = max(o.log_odds for o in self.weighed.values())
        for other in neighbors:
            if other.log_odds > best - WEIGHED and other.blocks not in self.weighed:
                best = max(best, self._weigh(other.blocks, other.sizes).log_odds)

    @staticmethod
    def _pair(one: Weighed) -> tuple[Set, tuple[int, ...]]:
        return one.blocks, one.sizes

    @staticmethod
    def _without(one: Weighed, k: int) -> Weighed:
        return Weighed(one.blocks[:k] + one.blocks[k + 1 :], one.sizes[:k] + one.sizes[k + 1 :], -np.inf)

    def _longer(self, one: Weighed) -> list[Weighed]:
        """The set with each further block, likeliest first; kept in `near`."""
        if one.blocks in self._added:
            return []
        self._added[one.blocks] = None
        if one.blocks and not np.isfinite(one.log_odds):
            one = self._weigh(one.blocks, one.sizes)
        given = self.products.given(one.blocks, SIZES[list(one.sizes)])
        added = self.products.added(given)
        count = int(np.sum(~self.rows[list(one.blocks)])) if one.blocks else 0
        step = np.where(self.rows, 0.0, self._of_count(count + 1) - self._of_count(count)) + self._log_weights
        odds = one.log_odds + added.averaged + step
        odds[list(one.blocks)] = -np.inf
        for a, b in self.apart:
            if a in one.blocks:
                odds[b] = -np.inf
            elif b in one.blocks:
                odds[a] = -np.inf
        best = max((o.log_odds for o in self.weighed.values()), default=0.0)
        found = []
        for b in np.argsort(-odds, kind="stable"):
            if odds[b] < max(best - NEGLIGIBLE, -1e9) and len(found) >= 3 or not np.isfinite(odds[b]):
                break
            place = int(np.searchsorted(one.blocks, b))
            blocks = (*one.blocks[:place], int(b), *one.blocks[place:])
            size = int(np.argmax(added.ratios[b]))
            new = Weighed(blocks, (*one.sizes[:place], size, *one.sizes[place:]), float(odds[b]))
            found.append(new)
            if blocks not in self.weighed and (blocks not in self.near or self.near[blocks].log_odds < new.log_odds):
                self.near[blocks] = new
        return found


def shares(sets: Sequence[Weighed]) -> Array:
    """Posterior probabilities of sets."""
    odds = np.array([one.log_odds for one in sets])
    return np.asarray(np.exp(odds - logsumexp(odds)))
