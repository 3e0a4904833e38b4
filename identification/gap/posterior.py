"""The posterior of a data set: sets of blocks and noise models together, linearized at the best set until it stays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.estimation.uncertainty import together
from identification.gap.blocks import Linearized, linearized
from identification.gap.fit import At, Rows, fit
from identification.gap.hypotheses import Block, Library, with_further_orders
from identification.gap.likelihood import Key, State
from identification.gap.noise import NoiseModel, log_likelihoods, noises
from identification.gap.search import ROUNDING, Search, Weighed
from identification.running import Tell, say_nothing

MOST_ROWS = 1250  # effort: rows that are searched for any effect
PASSES = 3  # effort: linearizations
NOISES = 3  # effort: noise models that are searched


@dataclass(frozen=True)
class Explanation:
    """One set of blocks, in the order of the dictionary, under one noise model.

    key : numbers of the blocks and of their sizes in the problem of that noise;  noise : number of the noise model
    """

    blocks: tuple[Block, ...]
    key: Key
    noise: int
    probability: float

    @property
    def effects(self) -> tuple[Block, ...]:
        """Its effects of the library."""
        return tuple(b for b in self.blocks if b.effect is not None)

    @property
    def outside(self) -> tuple[Block, ...]:
        """Its blocks outside the library."""
        rest = tuple(b for b in self.blocks if b.effect is None and b.row is None)
        return () if self.effects and all(b.parts for b in rest) else rest

    @property
    def wrong(self) -> list[int]:
        """Rows (from 0) that it takes for outlying."""
        return [b.row for b in self.blocks if b.row is not None]


@dataclass(frozen=True)
class Posterior:
    """explanations : likeliest first, with sum 1
    noises, problems, draws : searched, with the blocks that are not negligible, and the sets drawn by the walk there
    whole : problem of the likeliest noise, with all blocks;  at : fit where it is linearized, with all rows
    writable : the posterior if nothing is missing but what an arm file can have; None where that is the same
    """

    explanations: tuple[Explanation, ...]
    noises: tuple[NoiseModel, ...]
    problems: tuple[Linearized, ...]
    draws: tuple[Counter[Key], ...]
    whole: Linearized
    library: Library
    at: At
    writable: Posterior | None = None

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]


Walked = tuple[NoiseModel, Linearized, list[Weighed], Counter[Key], float]  # the last: log odds of the noise, for none


def posterior_of(library: Library, rows: Rows, generator: np.random.Generator, tell: Tell = say_nothing) -> Posterior:
    """The posterior of these rows, around a likely set, under each noise that is not unlikely.

    Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the same
    angle); the last pass has all of them, with the set and the noises that are not unlikely in the sample.
    """
    few = rows if len(rows) <= MOST_ROWS else rows.pick(np.sort(generator.permutation(len(rows))[:MOST_ROWS]))
    at, noise, names, chosen = fit(library.base, few), ("", 0.0), set[str](), dict[str, int]()
    for turn in range(1, PASSES + 1):
        tell(f"pass {turn}")
        here = _at(at, few)
        wrong, every = _striking(here), [n for n in noises(here) if not names or n.name in names]
        number = next(k for k, n in enumerate(every) if (n.name, n.size) == noise)
        problem = linearized(library, _at(at, every[number].rows), wrong)
        search, before = search_of(problem), [*chosen]
        top = _same_set(problem, search, chosen)
        top = top if names else search.climb(top.blocks)
        chosen = {problem.blocks[b].label: size for b, size in top.key}
        effects = [problem.blocks[b] for b in top.blocks if problem.blocks[b].effect is not None]
        # the set with the odds of each noise, in units of the noise that was searched: with nothing, with the set, and
        # with the outlying rows of the set alone, which noise of another kind may need, too
        y, jacobian, base = library.as_base(here)
        plain, prior, each = jacobian[:, :, base] / at.model.scales[base], np.array([n.prior for n in every]), []
        rows_only = [pair for pair in top.key if problem.blocks[pair[0]].row is not None]
        for key in dict.fromkeys([(), top.key, tuple(rows_only)]):
            one = search.products.state(key)
            free = np.concatenate([plain, *(problem.columns[b] for b in one.blocks)], axis=2)
            likelihoods = log_likelihoods(every, y, free)
            each.append(likelihoods - likelihoods[number] + search.log_odds(one) + prior)
        scores = np.max(each, axis=0)
        order = np.argsort(-scores, kind="stable").tolist()
        likely = [k for k in order if scores[k] > scores.max() + np.log(LEVEL)]
        best = int(np.argmax(np.where(np.arange(len(every)) == number, scores + ROUNDING, scores)))
        settled = [*chosen] == before and best == number
        if turn == PASSES:
            break
        if not settled:
            noise, kept = (every[best].name, every[best].size), np.ones(len(few), dtype=bool)
            kept[[k for k in (problem.blocks[b].row for b, _ in rows_only) if k is not None]] = False
            at = fit(library.model(effects), every[best].rows.pick(kept), at.by_name)
        wider = with_further_orders(library, _at(at, every[best].rows), effects)
        if few is not rows and turn == PASSES - 1:
            few, at = rows, fit(at.model, rows, at.by_name)
            names = {noise[0], *(every[k].name for k in likely)}
        elif settled and wider is library and few is rows:
            break
        library = wider

    walked = []
    for k in [number, *(k for k in likely if k != number)][:NOISES]:
        tell(f"sets of effects{', noise: ' + every[k].name if every[k].name else ''}")
        if k == number:
            under = problem, search, top
        else:
            other = linearized(library, _at(at, every[k].rows), wrong)
            under = other, search_of(other), _same_set(other, search_of(other), chosen)
        walked.append((every[k], *_walked(*under, generator), float(each[0][k])))
    mixture = _mixture(walked, problem, library, _at(at, rows))
    if sum(one.probability for one in mixture.explanations if not all(map(_holds, one.blocks))) < LEVEL:
        return mixture
    tell("what an arm file can have")
    problem = problem.of([k for k, block in enumerate(problem.blocks) if _holds(block)])
    search = search_of(problem)
    top = search.climb(sorted(problem.numbers[label] for label in chosen if label in problem.numbers))
    alone = [(every[number], *_walked(problem, search, top, generator), 0.0)]
    return replace(mixture, writable=_mixture(alone, problem, library, _at(at, rows)))


def _at(at: At, rows: Rows) -> At:
    """The same model at other rows, or with another noise."""
    return At(at.model, at.values, rows)


def _same_set(problem: Linearized, search: Search, chosen: dict[str, int]) -> State:
    """A set, label -> number of the size, as far as a problem has its blocks."""
    return search.products.state([(problem.numbers[x], size) for x, size in chosen.items() if x in problem.numbers])


def _holds(block: Block) -> bool:
    """Whether an arm file can have a block, or its row be left out."""
    return bool(block.effect or block.span or block.parts or block.row is not None)


def _walked(
    problem: Linearized, search: Search, top: State, generator: np.random.Generator
) -> tuple[Linearized, list[Weighed], Counter[Key]]:
    """The problem with the blocks alone that are not negligible, and the walk there."""
    near = search.near(top)
    few, place = problem.of(near), {b: i for i, b in enumerate(near)}
    walk = search_of(few, search.total)
    return few, *walk.walk(walk.products.state([(place[b], size) for b, size in top.key]), generator)


def _mixture(models: Sequence[Walked], whole: Linearized, library: Library, at: At) -> Posterior:
    """All explanations of all noise models together."""
    problems = tuple(problem for _, problem, *_ in models)
    listed = [
        (number, key, of_noise + log_odds)
        for number, (_, _, sets, _, of_noise) in enumerate(models)
        for key, log_odds in sets
    ]
    odds = np.array([one for *_, one in listed])
    probabilities = np.exp(odds - logsumexp(odds))
    explanations = []
    for k in np.argsort(-np.round(probabilities, 9), kind="stable").tolist():
        number, key, _ = listed[k]
        blocks = tuple(problems[number].blocks[b] for b, _ in key)
        explanations.append(Explanation(blocks, key, number, float(probabilities[k])))
    every, draws = tuple(noise for noise, *_ in models), tuple(counted for *_, counted, _ in models)
    return Posterior(tuple(explanations), every, problems, draws, whole, library, at)


def search_of(problem: Linearized, total: float = 0.0) -> Search:
    """The search of a linearized problem;  total : weight of all blocks, where the problem has not all of them"""
    named = {k: b for k, b in enumerate(problem.blocks) if b.effect is not None and b.spec is not None}
    families = {b.key: k for k, b in named.items() if b.family}
    needy = frozenset(k for k, b in named.items() if b.through)
    kinds = {named[k].through for k in needy}
    pairs = {(families.get(b.spec.name, k) if b.spec else k, k) for k, b in named.items()}
    return Search(
        problem.products,
        np.array([b.weight for b in problem.blocks]),
        np.array([b.row is not None for b in problem.blocks], dtype=bool),
        frozenset(k for k, b in enumerate(problem.blocks) if b.parts),
        frozenset((family, k) for family, k in pairs if family != k),
        needy,
        frozenset(k for k, b in named.items() if b.effect and b.effect.needs & kinds) - needy,
        total,
    )


def _striking(at: At) -> list[int]:
    """Rows whose residual is large, and that do not come together as whole postures or neighbors do."""
    rows = at.rows
    left = rows.whiten(at.left).reshape(len(rows), -1)
    sizes = np.sqrt(np.mean(np.square(left), axis=1))
    limit = 3.0 * float(np.median(sizes)) / 0.83  # robust standard deviations
    far = np.zeros(len(rows), dtype=bool)
    far[[k for k in np.argsort(-sizes, kind="stable")[:30] if sizes[k] > limit]] = True  # 30, as 3 above: effort
    return np.flatnonzero(far & ~together(far, rows.postures, rows.posture_numbers)).tolist()
