"""The posterior of a data set: sets of blocks and noise models together, linearized at the best set until it stays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from identification.arrays import Array
from identification.estimation.outlying import together
from identification.gap.blocks import Block, Linearized, linearized
from identification.gap.evidence import ROUNDING
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet
from identification.gap.scatter import Noise, log_likelihood, noises
from identification.gap.search import Search, Weighed
from identification.gap.waves import with_further_orders
from identification.progress import Tell, say_nothing

# reasons: identification/README.md, "Constants"
MOST_ROWS = 1250  # that are searched for any effect
SEEN = 1e-5  # probability in the sample, of what is weighed with all rows
PASSES = 4  # effort: linearizations
NOISES = 3  # effort: noise models that are searched
UNLIKELY = 5.0  # log odds below the best, of a noise model that is not searched
STRIKING = 3.0  # robust standard deviations of a row that may be outlying
MOST_WRONG = 30  # effort: rows that may be


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
    def wrong(self) -> tuple[int, ...]:
        """Rows (from 0) that it takes for outlying."""
        return tuple(int(b.place.partition(":")[2]) for b in self.blocks if b.row)


@dataclass(frozen=True)
class Posterior:
    """explanations : likeliest first, with sum 1;  noises, problems : searched;  at : fit where it is linearized"""

    explanations: tuple[Explanation, ...]
    noises: tuple[Noise, ...]
    problems: tuple[Linearized, ...]
    library: HypothesisSet
    rows: Rows
    at: Fit

    @property
    def best(self) -> Explanation:
        """The likeliest."""
        return self.explanations[0]

    @property
    def order(self) -> tuple[str, ...]:
        """Labels of all blocks in the order of the dictionary."""
        return tuple(block.label for block in self.problems[0].blocks)


def posterior(
    library: HypothesisSet, rows: Rows, generator: np.random.Generator | None = None, tell: Tell = say_nothing
) -> Posterior:
    """The posterior of these rows.

    Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the same
    angle); the blocks that are not unlikely there are then weighed with all rows.
    """
    if len(rows) <= MOST_ROWS:
        return _settled(library, rows, None, (), tell)
    some = np.sort((generator or np.random.default_rng(0)).permutation(len(rows))[:MOST_ROWS])
    found = _settled(library, rows.pick(some), None, (), tell)
    tell("all rows")
    labels = {b.label for e in found.explanations if e.probability >= SEEN for b in e.blocks if not b.row}
    narrow = replace(library, members=tuple(h for h in library.members if h.label in labels))
    chosen = tuple(b.label for b in found.best.blocks if not b.row)
    return _settled(narrow, rows, frozenset(labels), chosen, tell)


def _settled(
    library: HypothesisSet, rows: Rows, outside: frozenset[str] | None, chosen: tuple[str, ...], tell: Tell
) -> Posterior:
    """The posterior, linearized at its best set until that stays;  outside : blocks outside the library, None: all"""
    at, number = fit(library.base, rows), 0
    for turn in range(PASSES):
        tell(f"pass {turn + 1}")
        wrong, every = _striking(rows, at), list(noises(rows, at))
        problem = linearized(library, at, every[number].rows, wrong, outside)
        sets = _searched(library, problem, chosen)
        best = tuple(problem.blocks[b].label for b in sets[0].blocks)
        first, there = _likelihoods(library, every, at, problem, sets[0])
        prior = np.array([n.prior for n in every])
        # with nothing and with the best set, in units of the noise that was searched
        score = np.maximum(first - first[number], there - there[number] + sets[0].log_odds) + prior
        likely = int(np.argmax(np.where(np.arange(len(every)) == number, score + ROUNDING, score)))
        one = Explanation(tuple(problem.blocks[b] for b in sets[0].blocks), 0, sets[0], 1.0)
        settled = best == chosen and likely == number
        if not settled:
            chosen, number = best, likely
            at = refit(Posterior((one,), (every[number],), (problem,), library, rows, at), one)
        wider = library if outside is not None else with_further_orders(library, every[number].rows, at, one.effects)
        if (settled and wider is library) or turn == PASSES - 1:
            break
        library = wider
    models = [(every[number], problem, sets, float(prior[number]))]
    order = [int(k) for k in np.argsort(-score, kind="stable") if k != number and score[k] > score.max() - UNLIKELY]
    for k in order[: NOISES - 1]:
        tell(f"other noise: {every[k].name or 'white'}")
        other = linearized(library, at, every[k].rows, wrong, outside)
        offset = float(first[k] - first[number]) + every[k].prior
        models.append((every[k], other, _searched(library, other, chosen), offset))
    return _mixture(models, library, rows, at)


def _mixture(
    models: Sequence[tuple[Noise, Linearized, list[Weighed], float]], library: HypothesisSet, rows: Rows, at: Fit
) -> Posterior:
    """All explanations of all noise models, with their log prior odds and likelihoods, together."""
    listed = [(number, one) for number, (_, _, sets, _) in enumerate(models) for one in sets]
    odds = np.array([models[number][3] + one.log_odds for number, one in listed])
    probabilities = np.exp(odds - logsumexp(odds))
    order = np.argsort(-np.round(probabilities, 9), kind="stable")
    explanations = []
    for k in order.tolist():
        number, one = listed[k]
        blocks = tuple(models[number][1].blocks[b] for b in one.blocks)
        explanations.append(Explanation(blocks, number, one, float(probabilities[k])))
    return Posterior(tuple(explanations), tuple(m[0] for m in models), tuple(m[1] for m in models), library, rows, at)


def refit(found: Posterior, one: Explanation) -> Fit:
    """The nonlinear fit of one explanation's effects, to the rows that it takes for right, with its noise."""
    kept = np.ones(len(found.rows), dtype=bool)
    kept[list(one.wrong)] = False
    rows = found.noises[one.noise].rows.pick(kept)
    return fit(found.library.model(one.effects), rows, found.at.by_name)


def _searched(library: HypothesisSet, problem: Linearized, chosen: tuple[str, ...]) -> list[Weighed]:
    numbers = {b.label: k for k, b in enumerate(problem.blocks)}
    start = tuple(sorted(numbers[label] for label in chosen if label in numbers))
    weights = np.array([b.weight for b in problem.blocks])
    rows = np.array([b.row for b in problem.blocks], dtype=bool)
    late = frozenset(k for k, b in enumerate(problem.blocks) if b.parts)
    more = problem.apart, *problem.needy_and_givers(library), late
    return Search(problem.products, weights, rows, *more).posterior([start] if start else [])


def _striking(rows: Rows, at: Fit) -> list[int]:
    """Rows whose residual is large, and that do not come together as whole postures or neighbors do."""
    left = rows.whiten(at.position_residuals(rows, rows.conditions)).reshape(len(rows), -1)
    sizes = np.sqrt(np.mean(np.square(left), axis=1))
    limit = STRIKING * float(np.median(sizes)) / 0.83
    order = np.argsort(-sizes, kind="stable")
    far = np.zeros(len(rows), dtype=bool)
    far[[k for k in order[:MOST_WRONG] if sizes[k] > limit]] = True
    return np.flatnonzero(far & ~together(far, rows.postures, rows.posture_numbers)).tolist()


def _likelihoods(
    library: HypothesisSet, every: list[Noise], at: Fit, problem: Linearized, best: Weighed
) -> tuple[Array, Array]:
    """(K,) log likelihood of each noise, with nothing missing, and with the best set."""
    rows = every[0].rows
    own = library.own_places(at.model)
    added = np.setdiff1d(np.arange(len(at.values)), own)
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    left = rows.positions - position + jacobian[:, :, added] @ at.values[added]
    plain = jacobian[:, :, own] / at.model.scales[own]
    first = np.array([log_likelihood(n.rows, left, plain) for n in every])
    if not best.blocks:
        return first, first
    columns = problem.columns_of(best.blocks)
    sizes = np.sqrt(np.mean(np.square(columns), axis=(0, 1)))
    wide = np.concatenate([plain, columns / np.where(sizes > 0.0, sizes, 1.0)], axis=2)
    with_best = np.array([log_likelihood(n.rows, left, wide) for n in every])
    return first, with_best
