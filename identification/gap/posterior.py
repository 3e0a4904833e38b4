"""The posterior of a data set: sets of blocks and noise models together, linearized again at the best set until it stays."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from identification.arrays import Array
from identification.estimation.outlying import together
from identification.gap.blocks import Block, Linearized, linearized
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet
from identification.gap.scatter import Noise, log_likelihood, noises
from identification.gap.search import Search, Weighed, shares
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
        return tuple(b for b in self.blocks if not b.named and not b.row)

    @property
    def wrong(self) -> tuple[int, ...]:
        """Rows (from 0) that it takes for outlying."""
        return tuple(int(b.place.partition(":")[2]) for b in self.blocks if b.row)


@dataclass(frozen=True)
class Posterior:
    """explanations : likeliest first, with sum 1;  noises, problems : searched;  at : fit about which it is linearized"""

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

    Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the same angle);
    the blocks that are not unlikely there are then weighed with all rows.
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
    """The posterior, linearized again at its best set until that stays;  outside : blocks outside the library, None: all"""
    at = fit(library.base, rows)
    found = None
    for number in range(PASSES):
        tell(f"pass {number + 1}")
        found = _around(library, rows, at, chosen, outside)
        best = tuple(b.label for b in found.best.blocks)
        if best == chosen:
            break
        chosen = best
        at = refit(found, found.best)
    assert found is not None
    return found


def refit(found: Posterior, one: Explanation) -> Fit:
    """The nonlinear fit of one explanation's effects, to the rows that it takes for right, with its noise."""
    kept = np.ones(len(found.rows), dtype=bool)
    kept[list(one.wrong)] = False
    rows = found.noises[one.noise].rows.pick(kept)
    return fit(found.library.model(one.effects), rows, found.at.by_name)


def _around(
    library: HypothesisSet, rows: Rows, at: Fit, chosen: tuple[str, ...], outside: frozenset[str] | None
) -> Posterior:
    """The posterior, linearized at a fit;  chosen : labels of a set that may be good""" 
    wrong = _striking(rows, at)
    base = library.base.names
    white = linearized(library, at, rows, base, wrong, outside)
    search = _searched(library, white, chosen)
    models: list[tuple[Noise, Linearized, list[Weighed], float]] = []
    every = list(noises(rows, at))
    there = _likelihoods(library, every, at, white, search[0], wrong)
    models.append((every[0], white, search, 0.0))
    first, best = there  # log likelihoods of each noise relative to white, with nothing and with the best set
    score = np.maximum(first, best + search[0].log_odds) + np.array([n.prior for n in every])
    order = [int(k) for k in np.argsort(-score, kind="stable") if k and score[k] > score.max() - UNLIKELY]
    for k in order[: NOISES - 1]:
        other = linearized(library, at, every[k].rows, base, wrong, outside)
        models.append((every[k], other, _searched(library, other, chosen), float(first[k]) + every[k].prior))
    listed = [
        (number, one, offset + one.log_odds, problem)
        for number, (_, problem, sets, offset) in enumerate(models)
        for one in sets
    ]
    odds = np.array([o for _, _, o, _ in listed])
    probabilities = np.exp(odds - logsumexp(odds))
    explanations = [
        Explanation(tuple(problem.blocks[b] for b in one.blocks), number, one, float(p))
        for (number, one, _, problem), p in zip(listed, probabilities, strict=True)
    ]
    explanations.sort(key=lambda e: (-round(e.probability, 9), e.noise, e.weighed.blocks))
    return Posterior(tuple(explanations), tuple(m[0] for m in models), tuple(m[1] for m in models), library, rows, at)


def _searched(library: HypothesisSet, problem: Linearized, chosen: tuple[str, ...]) -> list[Weighed]:
    numbers = {b.label: k for k, b in enumerate(problem.blocks)}
    start = tuple(sorted(numbers[label] for label in chosen if label in numbers))
    weights = np.array([b.weight for b in problem.blocks])
    rows = np.array([b.row for b in problem.blocks], dtype=bool)
    more = problem.apart, *problem.needy_and_givers(library)
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
    library: HypothesisSet, every: list[Noise], at: Fit, white: Linearized, best: Weighed, wrong: list[int]
) -> tuple[Array, Array]:
    """(K,) log likelihood of each noise relative to the first, with nothing missing, and with the best set."""
    rows = every[0].rows
    base = library.base
    names = list(at.model.names)
    own = [names.index(name) for name in base.names]
    position, jacobian = at.model.linearize(rows.postures, at.values, rows.conditions)
    added = [k for k in range(len(names)) if k not in own]
    left = rows.positions - position + jacobian[:, :, added] @ at.values[added]
    plain = jacobian[:, :, own] / at.model.scales[own]
    members = [white.blocks[b] for b in best.blocks]
    first = np.array([log_likelihood(n.rows, left, plain) for n in every])
    if not members:
        return first - first[0], first - first[0]
    columns = white.columns_of(best.blocks)
    sizes = np.sqrt(np.mean(np.square(columns), axis=(0, 1)))
    wide = np.concatenate([plain, columns / np.where(sizes > 0.0, sizes, 1.0)], axis=2)
    with_best = np.array([log_likelihood(n.rows, left, wide) for n in every])
    return first - first[0], with_best - with_best[0]
