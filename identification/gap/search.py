"""Posterior over sets of blocks (identification/README.md, "One posterior"): a climb to a likely set, and a Gibbs walk
from there, for each likely noise model.

A step removes one block x, or none, from a set A of k blocks, then adds one with its size, or none. The climb takes
the likeliest step as long as it makes the set likelier. The walk removes each block, or none, with probability
1 / (k + 1) and draws the addition with odds proportional to p(A' + x) / (|A' + x| + 1), where A' = A - x. This is a
Gibbs step of the joint distribution of A and x, so A is drawn from its posterior. Not the draws are counted but the
probabilities they were drawn with ("Rao-Blackwellization", A. E. Gelfand, A. F. M. Smith, 1990).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import lgamma

import numpy as np
from scipy.special import logsumexp, softmax, zeta

from identification.arrays import Array
from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.estimation.uncertainty import left_out, together
from identification.gap.blocks import Block, Library, Linearized, linearized
from identification.gap.fit import Fitted, Rows, fit
from identification.gap.likelihood import SIZES, Key, Products, State
from identification.gap.noise import NoiseModel, log_likelihoods, noises
from identification.information import VISIBLE, spectrum
from identification.model import Model

TAIL = 3.0  # prior: p(K) ~ K^-TAIL, so p(2) / p(1) = 1/8, but p(15) / p(14) = 0.81: many effects suggest further ones
WRONG = 0.0005  # prior odds of a row to be outlying: clean sessions of 60 rows seldom lose one, 15 sigma always show
SPREAD = 1.5  # prior: octaves by which sizes differ from the common one; those of one effect alone scatter by that much
STRAY = 0.2  # prior: share of blocks whose size has nothing to do with the others', such as a wrong payload
NEGLIGIBLE = 0.01  # effort: share of the probability in blocks that the walk leaves out, and of a set not listed
MOVES = 700  # effort: of the walk
MOST = 10  # effort: pairs of blocks, candidates, and explanations cross-validated
CREDIBLE = 0.9  # convention: probability of the credible set
LEAST = 1e-5  # numerical: probability of a set that is kept
ROUNDING = 1e-6  # numerical: of a log likelihood
MOST_ROWS = 1250  # effort: rows that are searched for any effect
PASSES = 3  # effort: linearizations of many rows, passes of a climb, and kinds of noise

_OCTAVES = np.subtract.outer(np.arange(len(SIZES)), np.arange(len(SIZES)))
# derived: (S, S) p(s | c) of a size, by column, around a common one
AROUND: Array = (1.0 - STRAY) * softmax(-0.5 * np.square(_OCTAVES / SPREAD), axis=1) + STRAY / len(SIZES)
_LOG_AROUND = np.log(AROUND)

Weighed = tuple[Key, float]  # a set with its likeliest sizes, and its log posterior odds against nothing


class Search:
    """The sets of blocks of one linearized problem;  total : weight of all blocks, where these are some of them;
    at : model of the fit that it is linear about, None: no block needs others"""

    def __init__(
        self, products: Products, blocks: Sequence[Block], total: float = 0.0, at: Model | None = None
    ) -> None:
        self.products, self._tables = products, dict[Key, Array]()
        self.counted = np.array([not b.rows for b in blocks], dtype=bool)  # (B,) that count among the K
        weights = np.array([b.weight for b in blocks])
        self.total = total or max(float(np.sum(weights[self.counted])), 1e-300)
        with np.errstate(divide="ignore"):
            self._log_weights = np.log(np.where(self.counted, weights / self.total, WRONG))
        # (B, B) pairs of which one contains the other: a family, and the same effect at one joint
        families, self.apart = {b.key: k for k, b in enumerate(blocks) if b.family}, np.zeros((len(blocks),) * 2, bool)
        for k, b in enumerate(blocks):
            family = families.get(b.key.partition(":")[0], k)
            self.apart[family, k] = self.apart[k, family] = family != k
        # (B,) that show only through others: their columns are right in sets with all of these that are in the fit
        self.needy = np.array([b.through != "" for b in blocks], dtype=bool)
        kinds = {b.through for b in blocks if b.through}
        giving = [] if at is None else [e.label for e in at.effects if not kinds.isdisjoint(e.needs)]
        self.givers = ~self.needy & np.isin([b.label for b in blocks], giving)

    def log_prior(self, blocks: Sequence[int]) -> float:
        """Log prior odds of a set against nothing missing; -inf where it may not be."""
        inside = list(blocks)
        alone = self.needy[inside].any() and np.count_nonzero(self.givers[inside]) < np.count_nonzero(self.givers)
        if alone or self.apart[np.ix_(inside, inside)].any():
            return -np.inf
        return log_odds_of_count(int(np.sum(self.counted[inside]))) + float(np.sum(self._log_weights[inside]))

    def log_odds(self, state: State) -> float:
        """Log posterior odds of a set with its sizes against nothing missing."""
        sizes = self._sizes(state)
        of_sizes = log_odds_of_sizes(sizes)[0] - (len(state.key) - len(sizes)) * float(np.log(len(SIZES)))
        return state.ratio + state.signed + self.log_prior(state.blocks) + of_sizes

    def _sizes(self, state: State) -> list[int]:
        """Numbers of the sizes of the blocks that count."""
        return [size for block, size in state.key if self.counted[block]]

    def climb(self, start: State | None = None) -> State:
        """The likeliest set that adding, dropping and exchanging blocks leads to;  start : a set that may be good"""
        nothing = self.products.state()
        tops = [start if start is not None and start.key else self._up(nothing), nothing]
        table = self._each(nothing)
        for block in np.argsort(-np.round(np.logaddexp.reduce(table, axis=1), 9), kind="stable")[:MOST].tolist():
            if np.isfinite(table[block]).any():  # two that hide each other are seen together
                single = nothing.with_block((block, int(np.argmax(table[block]))))
                best = self._likeliest(self._each(single))
                tops += [single, self._exchanged(single.with_block(best), block, block)]
        top = max(tops, key=lambda one: round(self.log_odds(one), 9))
        for _ in range(PASSES):
            before, top = top, self._up(top)
            if top.key == before.key:
                break
        return top

    def _up(self, state: State) -> State:
        """Add the likeliest block as long as that is likelier; put the likeliest, or none, in the place of each."""
        for block in (None, *state.blocks):
            state = state if block is None else self._exchanged(state, block)
            while (best := self._likeliest(self._each(state))) is not None:
                state = state.with_block(best)
        return state

    def _exchanged(self, state: State, block: int, only: int | None = None) -> State:
        """The likeliest block, or none, in the place of one that is in the set;  only : what may be there"""
        if block not in state.blocks:
            return state
        left, own = state.without(block), dict(state.key)[block]
        table = self._each(left)
        alone = np.isfinite(self.log_prior(left.blocks))
        best = self._likeliest(
            table if only is None else np.where(np.arange(len(table))[:, None] == only, table, -np.inf), block, alone
        )
        return state if best == (block, own) else left.with_block(best)

    def _likeliest(self, table: Array, first: int | None = None, alone: bool = True) -> tuple[int, int] | None:
        """The block that is likeliest in a table, and its likeliest size; None if it is likelier without any.

        first : of those equally likely;  alone : whether the set may be without any
        """
        odds = np.logaddexp.reduce(table, axis=1)
        most = np.max(odds, initial=-np.inf)
        if most <= (ROUNDING if alone else -np.inf):
            return None
        best = first if first is not None and odds[first] >= most - ROUNDING else int(np.argmax(np.round(odds, 9)))
        return best, int(np.argmax(np.round(table[best], 9)))

    def near(self, top: State) -> list[int]:
        """All blocks but those that are together negligible beside a set and in place of one of its blocks."""
        lefts = (self.products.state(), top, *map(top.without, top.blocks))
        odds = [self.log_odds(left) + np.logaddexp.reduce(self._each(left), axis=1) for left in lefts]
        shares = np.exp(np.minimum(np.max(odds, axis=0) - self.log_odds(top), 0.0))
        order = np.argsort(shares, kind="stable")
        return sorted({*order[np.cumsum(shares[order]) > NEGLIGIBLE * (1.0 + shares.sum())].tolist(), *top.blocks})

    def walk(self, top: State, generator: np.random.Generator) -> tuple[list[Weighed], Counter[Key]]:
        """The sets that matter, likeliest first, and draws of sets (one for each tenth of a set that was moved), from a
        set to start from."""
        state, steps, odds, visits, draws = top, dict[Key, Array](), dict[Key, float](), Counter[Key](), Counter[Key]()
        for move in range(MOVES):
            taken = int(generator.integers(len(state.key) + 1))
            left = state.without(state.key[taken][0]) if taken < len(state.key) else state
            if left.key not in steps:
                stay = -np.log(len(left.key) + 1) if np.isfinite(self.log_prior(left.blocks)) else -np.inf
                steps[left.key] = softmax(np.append(self._each(left).ravel() - np.log(len(left.key) + 2), stay))
            visits[left.key] += 1
            total = np.cumsum(steps[left.key])
            drawn = int(np.searchsorted(total, generator.random() * total[-1], side="right"))
            state = left.with_block(divmod(drawn, len(SIZES)) if drawn < len(total) - 1 else None)
            if move % max(len(state.key) // 10, 1) == 0:
                if state.key not in odds:
                    odds[state.key] = self.log_odds(state)
                draws[state.key] += 1
        # the sets from the probabilities with which each was drawn, whatever its sizes; and of those drawn with theirs
        sets, share = defaultdict[tuple[int, ...], list[tuple[float, Key]]](list), 0.0
        ways = defaultdict[Key, list[int]](list)
        for key in draws:
            ways[key].append(-1)
            for k, (block, size) in enumerate(key):
                ways[key[:k] + key[k + 1 :]].append(block * len(SIZES) + size)
        for key, count in visits.items():
            chances, blocks = steps[key] * (count / MOVES), [block for block, _ in key]
            share += float(np.sum(chances[ways[key]]))
            sets[tuple(blocks)].append((float(chances[-1]), key))
            table = chances[:-1].reshape(-1, len(SIZES))
            of_blocks = np.sum(table, axis=1)
            for block in np.flatnonzero(of_blocks > 0.1 * LEAST).tolist():
                with_it = tuple(sorted((*key, (block, int(np.argmax(table[block]))))))
                sets[tuple(sorted((*blocks, block)))].append((float(of_blocks[block]), with_it))
        # what was drawn has these odds together, and this share of the probability
        evidence = float(logsumexp([*odds.values()]) - np.log(share))
        # sizes as rounding cannot turn them
        listed = sorted(
            (-sum(p for p, _ in found), max((round(p, 9), key) for p, key in found)[1]) for found in sets.values()
        )
        return [(key, float(np.log(-less)) + evidence) for less, key in listed if -less > LEAST], draws

    def _each(self, left: State) -> Array:
        """(B, S) log odds of a set with each further block in each size against the set; -inf where it may not be."""
        if left.key not in self._tables:
            inside = list(left.blocks)
            count = int(np.sum(self.counted[inside]))
            step = np.where(self.counted, log_odds_of_count(count + 1) - log_odds_of_count(count), 0.0)
            prior, barred = step + self._log_weights, self.apart[inside].any(axis=0)
            if lacking := np.count_nonzero(self.givers) - np.count_nonzero(self.givers[inside]):
                barred |= (~self.givers | (lacking > 1)) if self.needy[inside].any() else self.needy
            prior[barred], prior[inside] = -np.inf, -np.inf
            of_size = np.where(self.counted[:, None], log_odds_of_sizes(self._sizes(left))[1], -np.log(len(SIZES)))
            self._tables[left.key] = self.products.added(left) + prior[:, None] + of_size
        return self._tables[left.key]


def log_odds_of_count(count: int) -> float:
    """log p(K) / p(0), times the K! orders in which the same blocks can be drawn."""
    return float(-np.log(zeta(TAIL)) - TAIL * np.log(count)) + lgamma(count + 1) if count else 0.0


def log_odds_of_sizes(sizes: Sequence[int]) -> tuple[float, Array]:
    """log p(s_1, .., s_K) of blocks with the numbers of these sizes, and (S,) log p(s | s_1, .., s_K) of another's."""
    common = np.sum(_LOG_AROUND[:, list(sizes)], axis=1)
    most = float(common.max())
    shares = np.exp(common - most)
    return most + float(np.log(shares.mean())), np.log(shares @ AROUND / shares.sum())


# -- of a data set -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Explanation:
    """One set of blocks, in the order of the dictionary, under one noise model.

    key : numbers of the blocks and of their sizes in the problem of that noise;  noise : number of the noise model
    """

    blocks: tuple[Block, ...]
    key: Key
    noise: int
    probability: float

    # its effects of the library, and its blocks outside the library
    effects = cached_property(lambda self: tuple(b for b in self.blocks if b.listed))
    outside = cached_property(lambda self: tuple(b for b in self.blocks if b.outside))

    @cached_property
    def named(self) -> tuple[str, ...] | None:
        """Sorted keys of its effects; None where something is outside the library."""
        return None if self.outside else tuple(sorted(b.key for b in self.effects))


@dataclass(frozen=True)
class Posterior:
    """explanations : likeliest first, with sum 1
    noises, problems, draws : searched, with the blocks that are not negligible, and sets drawn by the walk there
    whole : problem of the likeliest noise, with all blocks;  at : fit where it is linearized, with all rows
    """

    explanations: tuple[Explanation, ...]
    noises: tuple[NoiseModel, ...]
    problems: tuple[Linearized, ...]
    draws: tuple[Counter[Key], ...]
    whole: Linearized
    library: Library
    at: Fitted

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]

    @cached_property
    def beside_unknown(self) -> Explanation | None:
        """What is likelier than not, given that something is outside the library, each with its likeliest settings: as
        a set that was not drawn. None: nothing is outside."""
        if not (sets := [one for one in self.explanations if one.outside]):
            return None
        chances = defaultdict[str, defaultdict[tuple[str, ...], float]](lambda: defaultdict(float))
        for one in sets:
            settings = defaultdict[str, tuple[str, ...]](tuple)
            for block in (b for b in one.blocks if not b.rows):
                settings[block.key] += (block.label,)
            for key, labels in settings.items():
                chances[key][labels] += one.probability
        half = 0.5 * sum(one.probability for one in sets)
        likely = (shares for shares in chances.values() if sum(shares.values()) > half)
        named = {label for shares in likely for label in max(shares, key=lambda one: (round(shares[one], 9), one))}
        return Explanation(tuple(b for b in self.whole.blocks if b.label in named), (), sets[0].noise, 0.0)

    @cached_property
    def shares(self) -> Array:
        """(K,) probability of each noise model."""
        noises, probabilities = zip(*((one.noise, one.probability) for one in self.explanations), strict=True)
        return np.bincount(noises, probabilities, len(self.noises)).astype(float)

    def about(self, at: Fitted) -> Posterior:
        """The same sets, linearized at another fit, without blocks that do not show there."""

        def renumbered(key: Key, places: dict[int, int]) -> Key:
            return tuple((places[b], size) for b, size in key if b in places)

        wrong = [b.rows for b in self.whole.blocks if b.rows]
        wholes = [linearized(self.library, at.on(noise.rows), wrong) for noise in self.noises]
        problems, draws, places = list[Linearized](), list[Counter[Key]](), list[dict[int, int]]()
        for old, new, drawn in zip(self.problems, wholes, self.draws, strict=True):
            shown = [b for b, block in enumerate(old.blocks) if block.label in new.numbers]
            places.append({b: k for k, b in enumerate(shown)})
            problems.append(new.of([new.numbers[old.blocks[b].label] for b in shown]))
            draws.append(Counter())
            for key, count in drawn.items():
                draws[-1][renumbered(key, places[-1])] += count
        sets = tuple(replace(one, key=renumbered(one.key, places[one.noise])) for one in self.explanations)
        return replace(self, explanations=sets, problems=tuple(problems), draws=tuple(draws), whole=wholes[0], at=at)


def posterior_of(
    library: Library,
    rows: Rows,
    generator: np.random.Generator,
    tell: Callable[[str], object] = lambda _: None,
    doubtful: Sequence[int] = (),
) -> Posterior:
    """The posterior of these rows, around a likely set, under each noise that is not unlikely.

    Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the same
    angle); the last pass has all of them, with the set and the noises that are not unlikely in the sample.

    doubtful : rows (from 1) that the first fit does without
    """
    some = np.arange(len(rows)) if len(rows) <= MOST_ROWS else np.sort(generator.permutation(len(rows))[:MOST_ROWS])
    few, kept = rows if len(some) == len(rows) else rows.pick(some), ~np.isin(some + 1, doubtful)
    at, noise, names = fit(library.base, few.pick(kept)), ("", 0.0), set[str]()
    chosen = {f"row:{(k,)}": 2 for k in np.flatnonzero(~kept).tolist()}  # several may hide each other
    passes = PASSES if few is not rows else 2 * PASSES  # few rows settle late
    for turn in range(1, passes + 1):
        tell(f"pass {turn}")
        here, numbers = at.on(few), few.posture_numbers
        y, base = library.as_base(here)
        # by how much each row is off from where others put it that the fit used. Effects are held at zero as loosely as
        # can be seen: what a row determines by itself, as one between two steps does, the others put half way
        columns = here.jacobian.reshape(*y.shape, -1)
        hold = np.sqrt(VISIBLE) * np.linalg.norm(columns, axis=(0, 1))
        hold[base] = 0.0
        columns = columns @ spectrum(columns[kept], here.model.scales, prior=np.diag(hold)).root
        left = np.linalg.norm(left_out(columns, few.whiten(y).reshape(y.shape), numbers, kept), axis=1)
        # rows that are far (3 robust standard deviations and 30 rows at most: effort) and do not come together as
        # whole postures or neighbors do, unless the fit did without them; and postures with several that are far, of
        # which a joint may be misread
        far = left > max(3.0 * float(np.median(left)) / 0.83, np.sort(left)[-31:][0])
        wrong = [(k,) for k in np.flatnonzero(far & ~(kept & together(far, few.postures, numbers))).tolist()]
        wrong += [tuple(np.flatnonzero(numbers == k).tolist()) for k in np.flatnonzero(np.bincount(numbers, far) > 1.0)]
        every = [n for n in noises(here) if not names or n.name in names]
        number = next(k for k, n in enumerate(every) if (n.name, n.size) == noise)
        problem = linearized(library, at.on(every[number].rows), wrong)
        search, before = Search(problem.products, problem.blocks, at=at.model), [*chosen]
        top = _same_set(problem, chosen)
        # from sizes in the middle, as those of the last linearization would hold the climb where it was; of rows from
        # the largest, as each that is held back leaves so much that no other grows
        start = [(b, len(SIZES) - 1 if problem.blocks[b].rows else 2) for b in top.blocks]
        top = top if names else search.climb(problem.products.state(start))
        chosen = {problem.blocks[b].label: size for b, size in top.key}
        effects = [problem.blocks[b] for b in top.blocks if problem.blocks[b].listed]
        # the set with the odds of each noise, in units of the noise that was searched: with nothing, with the set, and
        # with its outlying rows alone, which noise of another kind may need, too
        jacobian, each = here.linearized[1], []
        rows_only = [pair for pair in top.key if problem.blocks[pair[0]].rows]
        for key in dict.fromkeys([(), top.key, tuple(rows_only)]):
            one = search.products.state(key)
            columns = [jacobian[:, :, :0], *(problem.columns[b] @ problem.roots[b] for b in one.blocks)]
            free = jacobian[:, :, base] / at.model.scales[base]
            likelihoods = log_likelihoods(every, y, free, np.concatenate(columns, axis=2), one.sizes)
            likelihoods += np.array([n.prior for n in every])
            each.append(likelihoods - likelihoods[number] + every[number].prior + search.log_odds(one))
        scores = np.max(each, axis=0)
        order = np.argsort(-scores, kind="stable").tolist()
        kinds = {every[k].name: k for k in reversed(order)}  # of each kind the likeliest
        likely = sorted((k for k in kinds.values() if scores[k] > scores.max() + np.log(LEVEL)), key=order.index)
        best = int(np.argmax(np.where(np.arange(len(every)) == number, scores + ROUNDING, scores)))
        settled = [*chosen] == before and best == number
        if turn == passes:
            break
        if not settled:
            noise, kept = (every[best].name, every[best].size), np.ones(len(few), dtype=bool)
            kept[[k for b, _ in rows_only for k in problem.blocks[b].rows]] = False
            at = fit(library.model(effects), every[best].rows.pick(kept), at.by_name)
            if families := {b.label for b in effects if b.family}:
                effects = [b for b in effects if not b.family]
                without = fit(library.model(effects), at.rows, at.by_name)
                gain = len(at.residual) * float(np.log(np.linalg.norm(without.residual) / np.linalg.norm(at.residual)))
                if gain < 3.0:  # convention: e^3 = 20 times as likely; held at its bounds it explains nothing
                    why = "its values would have to be negative (does [gravity] point the right way?)"
                    skipped = {**library.skipped, **dict.fromkeys(families, why)}
                    members = tuple(b for b in library.members if b.label not in families)
                    at, library = without, replace(library, members=members, skipped=skipped)
                    chosen = {label: size for label, size in chosen.items() if label not in families}
        wider = library.with_further_orders(at.on(every[best].rows), effects)
        if few is not rows and turn == passes - 1:
            few, at, kept = rows, fit(at.model, rows, at.by_name), np.ones(len(rows), dtype=bool)
            names = {noise[0], *(every[k].name for k in likely)}
        elif settled and wider is library and few is rows:
            break
        library = wider

    # the walk under each noise, among the blocks alone that are not negligible
    taken = [number, *(k for k in likely if every[k].name != every[number].name)][:PASSES]
    problems, draws, listed = list[Linearized](), list[Counter[Key]](), list[tuple[int, Key, float]]()
    for k in taken:
        tell(f"sets of effects{', noise: ' + every[k].name if every[k].name else ''}")
        under = problem if k == number else linearized(library, at.on(every[k].rows), wrong)
        top, search = _same_set(under, chosen), Search(under.products, under.blocks, at=at.model)
        near = search.near(top)
        if 2 * len(near) <= len(under.blocks):  # else what was computed serves the walk, too
            total, place = search.total, {b: i for i, b in enumerate(near)}
            under = under.of(near)
            search = Search(under.products, under.blocks, total, at.model)
            top = under.products.state([(place[b], size) for b, size in top.key])
        sets, drawn = search.walk(top, generator)
        listed += [(len(problems), key, odds + float(each[0][k])) for key, odds in sets]
        problems.append(under)
        draws.append(drawn)

    probabilities = softmax([odds for *_, odds in listed])
    explanations = []
    for i in np.argsort(-np.round(probabilities, 9), kind="stable").tolist():
        which, key, _ = listed[i]
        blocks = tuple(problems[which].blocks[b] for b, _ in key)
        explanations.append(Explanation(blocks, key, which, float(probabilities[i])))
    models = tuple(every[k] for k in taken)
    return Posterior(tuple(explanations), models, tuple(problems), tuple(draws), problem, library, at.on(rows))


def _same_set(problem: Linearized, chosen: dict[str, int]) -> State:
    """A set, label -> number of the size, as far as a problem has its blocks."""
    return problem.products.state([(problem.numbers[x], size) for x, size in chosen.items() if x in problem.numbers])
