"""The posterior of a data set: sets of blocks and noise models together, linearized at the best set until it stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from identification.arrays import Array
from identification.estimation.uncertainty import together
from identification.gap.blocks import Linearized, linearized
from identification.gap.detectability import LEVEL
from identification.gap.evidence import State
from identification.gap.fit import Fit, Rows, fit
from identification.gap.hypotheses import Block, Hypothesis, HypothesisSet, with_further_orders
from identification.gap.scatter import NoiseModel, log_likelihoods, noises
from identification.gap.search import ROUNDING, Moments, Search, Walked, Weighed
from identification.progress import Tell, say_nothing

MOST_ROWS = 1250  # effort: rows that are searched for any effect
PASSES = 3  # effort: linearizations
NOISES = 3  # effort: noise models that are searched


@dataclass(frozen=True)
class Explanation:
    """One set of blocks under one noise model.

    blocks : labels in the order of the dictionary;  noise : number of the noise model
    """

    blocks: tuple[Block, ...]
    noise: int
    weighed: Weighed
    probability: float

    @property
    def effects(self) -> tuple[Hypothesis, ...]:
        """Its effects of the library."""
        return tuple(b.member for b in self.blocks if b.member is not None)

    @property
    def outside(self) -> tuple[Block, ...]:
        """Its blocks outside the library."""
        rest = tuple(b for b in self.blocks if not b.named and not b.row)
        return () if self.effects and all(b.parts for b in rest) else rest

    @property
    def rest(self) -> bool:
        """Whether the rest of the library is in it."""
        return any(b.parts for b in self.blocks)

    @property
    def wrong(self) -> tuple[int, ...]:
        """Rows (from 0) that it takes for outlying."""
        return tuple(_row_of(b) for b in self.blocks if b.row)


@dataclass(frozen=True)
class Posterior:
    """explanations : likeliest first, with sum 1
    noises, problems, moments : searched, with the blocks that are not negligible, and what the walk among these drew
    whole : problem of the likeliest noise, with all blocks;  at : fit where it is linearized
    given_file : the posterior if nothing is missing but what an arm file can have; None where that is the same
    """

    explanations: tuple[Explanation, ...]
    noises: tuple[NoiseModel, ...]
    problems: tuple[Linearized, ...]
    whole: Linearized
    library: HypothesisSet
    rows: Rows
    at: Fit
    moments: tuple[tuple[Moments, Moments], ...] = ()
    given_file: Posterior | None = None

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]

    @property
    def writable(self) -> Posterior:
        """The posterior if nothing is missing but what an arm file can have."""
        return self.given_file or self

    @property
    def noise_variance(self) -> float:
        """Expected variance of a whitened coordinate's noise [mm^2]."""
        shares = [sum(e.probability for e in self.explanations if e.noise == k) for k in range(len(self.noises))]
        both = [(sum(m.variance for m in pair), sum(m.count for m in pair)) for pair in self.moments]
        return sum(share * variance / max(count, 1) for share, (variance, count) in zip(shares, both, strict=True))

    @property
    def order(self) -> tuple[str, ...]:
        """Labels of all blocks in the order of the dictionary."""
        return tuple(block.label for block in self.whole.blocks)


class Climbed(NamedTuple):
    """A likely set (blocks of `problem`), where the problem is linearized, and what could be in its place.

    noise : number among `every`;  scores : (K,) log posterior odds of each noise, of the set or of none
    offset : (K,) log prior odds and likelihood ratios of each noise without blocks
    """

    library: HypothesisSet
    at: Fit
    every: list[NoiseModel]
    noise: int
    wrong: list[int]
    problem: Linearized
    search: Search
    top: State
    scores: Array
    offset: Array

    @property
    def labels(self) -> tuple[str, ...]:
        """Of the set's blocks."""
        return tuple(self.problem.blocks[b].label for b in self.top.blocks)

    @property
    def likely(self) -> list[int]:
        """Numbers of the noises that are not unlikely, likeliest first."""
        order = np.argsort(-self.scores, kind="stable").tolist()
        return [k for k in order if self.scores[k] > self.scores.max() + np.log(LEVEL)]


def posterior_of(
    library: HypothesisSet, rows: Rows, generator: np.random.Generator, tell: Tell = say_nothing
) -> Posterior:
    """The posterior of these rows, around a likely set, under each noise that is not unlikely.

    Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the same
    angle); the last pass has all of them, with the set and the noises that are not unlikely in the sample.
    """
    climbed = _climbed(library, rows, generator, tell)
    models = []
    for k in [climbed.noise, *(k for k in climbed.likely if k != climbed.noise)][:NOISES]:
        noise, under = climbed.every[k], climbed
        tell(f"sets of effects{', noise: ' + noise.name if noise.name else ''}")
        if k != climbed.noise:
            problem = linearized(climbed.library, climbed.at, noise.rows, climbed.wrong)
            search = search_of(climbed.library, problem)
            under = climbed._replace(problem=problem, search=search, top=_same_set(climbed, problem, search))
        models.append((noise, *_near_walk(under, generator), float(climbed.offset[k])))
    mixture = _mixture(models, climbed.problem, climbed.library, rows, climbed.at)
    lacking = sum(one.probability for one in mixture.explanations if not all(map(_holds, one.blocks)))
    if lacking < LEVEL:
        return mixture
    # the likely set of what an arm file can have
    problem = climbed.problem.of([k for k, block in enumerate(climbed.problem.blocks) if _holds(block)])
    search = search_of(climbed.library, problem, climbed.search.total)
    top = search.climb(tuple(sorted(problem.numbers[label] for label in climbed.labels if label in problem.numbers)))
    alone = climbed._replace(problem=problem, search=search, top=top)
    tell("what an arm file can have")
    model = climbed.every[climbed.noise], *_near_walk(alone, generator), 0.0
    return replace(mixture, given_file=_mixture([model], alone.problem, climbed.library, rows, climbed.at))


def _climbed(library: HypothesisSet, rows: Rows, generator: np.random.Generator, tell: Tell) -> Climbed:
    """A likely set, linearized at itself and under its likeliest noise."""
    few = rows if len(rows) <= MOST_ROWS else rows.pick(np.sort(generator.permutation(len(rows))[:MOST_ROWS]))
    at, noise, names, turn = fit(library.base, few), ("", 0.0), set[str](), 0
    climbed: Climbed | None = None
    while True:
        turn += 1
        tell(f"pass {turn}")
        wrong, every = _striking(few, at), [n for n in noises(few, at) if not names or n.name in names]
        number = next(k for k, n in enumerate(every) if (n.name, n.size) == noise)
        problem = linearized(library, at, every[number].rows, wrong)
        search, chosen = search_of(library, problem), () if climbed is None else climbed.labels
        top = search.products.nothing if climbed is None else _same_set(climbed, problem, search)
        top = top if names else search.climb(top.blocks)
        # the set with the odds of each noise, in units of the noise that was searched: with nothing, with the set, and
        # with the outlying rows of the set alone, which noise of another kind may need, too
        rows_only = search.products.state([(b, size) for b, size in top.key if problem.blocks[b].row])
        y, jacobian, base = library.as_base(at, every[0].rows)
        plain, prior, each = jacobian[:, :, base] / at.model.scales[base], np.array([n.prior for n in every]), []
        for one in {one.key: one for one in (search.products.nothing, top, rows_only)}.values():
            free = np.concatenate([plain, *(problem.columns[b] for b in one.blocks)], axis=2)
            likelihoods = log_likelihoods(every, y, free)
            each.append(likelihoods - likelihoods[number] + search.log_odds(one) + prior)
        scores = np.max(each, axis=0)
        climbed = Climbed(library, at, every, number, wrong, problem, search, top, scores, each[0])
        likely = int(np.argmax(np.where(np.arange(len(every)) == number, scores + ROUNDING, scores)))
        settled = climbed.labels == chosen and likely == number
        if turn == PASSES:
            return climbed
        if not settled:
            noise = every[likely].name, every[likely].size
            kept = np.ones(len(few), dtype=bool)
            kept[[_row_of(problem.blocks[k]) for k in top.blocks if problem.blocks[k].row]] = False
            at = fit(library.model(_named(climbed)), every[likely].rows.pick(kept), at.by_name)
        wider = with_further_orders(library, every[likely].rows, at, _named(climbed))
        if few is not rows and turn == PASSES - 1:
            few, at = rows, fit(at.model, rows, at.by_name)
            names = {noise[0], *(every[k].name for k in climbed.likely)}
        elif settled and wider is library and few is rows:
            return climbed
        library = wider


def _same_set(climbed: Climbed, problem: Linearized, search: Search) -> State:
    """A set, as far as another problem has its blocks."""
    sized = zip(climbed.labels, climbed.top.key, strict=True)
    return search.products.state(
        [(problem.numbers[label], size) for label, (_, size) in sized if label in problem.numbers]
    )


def _named(climbed: Climbed) -> tuple[Hypothesis, ...]:
    """Effects of the library in the set."""
    blocks = (climbed.problem.blocks[b] for b in climbed.top.blocks)
    return tuple(b.member for b in blocks if b.member is not None)


def _holds(block: Block) -> bool:
    """Whether an arm file can have a block, or its row be left out."""
    return block.written or block.row or bool(block.parts)


def _near_walk(climbed: Climbed, generator: np.random.Generator) -> tuple[Linearized, Walked]:
    """The problem with the blocks alone that are not negligible, and the walk there."""
    search, near = climbed.search, climbed.search.near(climbed.top)
    problem, place = climbed.problem.of(near), {b: i for i, b in enumerate(near)}
    total = search.total or float(np.sum(search.weights[search.counted]))
    walk = search_of(climbed.library, problem, total)
    start = walk.products.state([(place[b], size) for b, size in climbed.top.key])
    return problem, walk.walk(start, generator)


def _mixture(
    models: Sequence[tuple[NoiseModel, Linearized, Walked, float]],
    whole: Linearized,
    library: HypothesisSet,
    rows: Rows,
    at: Fit,
) -> Posterior:
    """All explanations of all noise models, with their log prior odds and likelihoods, together."""
    listed = [(number, one) for number, (_, _, walked, _) in enumerate(models) for one in walked.sets]
    odds = np.array([models[number][3] + one.log_odds for number, one in listed])
    probabilities = np.exp(odds - logsumexp(odds))
    order = np.argsort(-np.round(probabilities, 9), kind="stable")
    explanations = []
    for k in order.tolist():
        number, one = listed[k]
        blocks = tuple(models[number][1].blocks[b] for b in one.blocks)
        explanations.append(Explanation(blocks, number, one, float(probabilities[k])))
    noises_, problems = tuple(m[0] for m in models), tuple(m[1] for m in models)
    moments = tuple(m[2].moments for m in models)
    return Posterior(tuple(explanations), noises_, problems, whole, library, rows, at, moments)


def search_of(library: HypothesisSet, problem: Linearized, total: float | None = None) -> Search:
    """The search of a linearized problem;  total : weight of all blocks, where the problem has not all of them"""
    blocks = problem.blocks
    weights, rows = np.array([b.weight for b in blocks]), np.array([b.row for b in blocks], dtype=bool)
    rest = frozenset(k for k, b in enumerate(blocks) if b.parts)
    return Search(problem.products, weights, rows, rest, problem.apart, *problem.needy_and_givers(library), total=total)


def _row_of(block: Block) -> int:
    return int(block.place.partition(":")[2])


def _striking(rows: Rows, at: Fit) -> list[int]:
    """Rows whose residual is large, and that do not come together as whole postures or neighbors do."""
    left = rows.whiten(at.position_residuals(rows, rows.conditions)).reshape(len(rows), -1)
    sizes = np.sqrt(np.mean(np.square(left), axis=1))
    limit = 3.0 * float(np.median(sizes)) / 0.83  # robust standard deviations
    order = np.argsort(-sizes, kind="stable")
    far = np.zeros(len(rows), dtype=bool)
    far[[k for k in order[:30] if sizes[k] > limit]] = True  # 30, as 3 above, to save effort
    return np.flatnonzero(far & ~together(far, rows.postures, rows.posture_numbers)).tolist()
