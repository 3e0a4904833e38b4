"""Selection of effects: BIC after the omnibus test, forward, swap and backward, with nonlinear refits."""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma

import numpy as np
from scipy.special import fdtrc

from identification.gap.f_tests import TINY
from identification.gap.fit import Fit
from identification.gap.hypotheses import Hypothesis
from identification.gap.noise import homoscedastic
from identification.gap.search import Choice, HypothesisSearch, HypothesisTest

# reasons: identification/README.md, "Constants"
MOST, SWAPS = 40, 8  # effort: effects at once, exchanges in one round
ALPHA_FIRST, ALPHA_NEXT = 0.035, 0.005  # of 0.05 in all, screening and the test for unknown shapes need a part
# effects can mask each other in single tests; several at once must be far beyond chance
ALPHA_SEVERAL, ALPHA_CLEAR = 1e-5, 1e-20
PATIENCE = 4  # effort: effects added without getting more significant before that ends
LEAST_GAIN = 0.02  # of the sum of squares: what lowers the RMS by less than 1 % is not worth a round
SPARE_AFTER = 10  # degrees of freedom that several effects must leave
MARGIN, REFITS = 8.0, 6  # effort: rivals within this linear BIC, and as many at most, are refitted
WINDOW = 6.0  # Delta BIC of the ambiguity set: odds of 20 to 1


@dataclass(frozen=True)
class Selection:
    """chosen : the best set, empty if the omnibus test found nothing
    rivals : all sets within `WINDOW` of its BIC, best first
    first : the omnibus test of the base model;  last : that of the chosen set
    path : the sets after each round, from the empty one
    """

    chosen: Choice
    rivals: tuple[tuple[Choice, float], ...]
    first: HypothesisTest
    last: HypothesisTest
    path: tuple[Choice, ...] = ()


def trial_of(
    search: HypothesisSearch, chosen: Choice, draws: int, generator: np.random.Generator
) -> tuple[float, float]:
    """F and adjusted p-value of the member of a set that enters last, the weakest if the order is not clear."""
    found = []
    for k, member in enumerate(chosen):
        tested = search.tested(chosen[:k] + chosen[k + 1 :], draws, generator)
        same = [i for i, h in enumerate(tested.members) if h.free.label == member.label]
        if same:
            at = min(same, key=lambda i: tested.omnibus_test.adjusted[i])
            found.append((float(tested.omnibus_test.f[at]), float(tested.omnibus_test.adjusted[at])))
    return max(found, key=lambda trial: (trial[1], -trial[0]), default=(0.0, 1.0))


def best_of(search: HypothesisSearch, chosen: Choice, members: list[Hypothesis], change: np.ndarray) -> Choice | None:
    """The set with the one hypothesis added that has the lowest BIC; the best few by linear BIC are refitted."""
    order = np.argsort(change, kind="stable")[:REFITS]
    near = [k for k in order if np.isfinite(change[k]) and change[k] <= change[order[0]] + MARGIN]
    return min(((*chosen, members[k].free) for k in near), key=search.bic, default=None)


def select(
    search: HypothesisSearch, draws: int, generator: np.random.Generator, known: tuple[Choice, ...] = ((),)
) -> Selection:
    """Forward while the omnibus test or one of several effects at once finds something, swap after every addition,
    backward at the end.

    The level grows with what is named already: of k names found one after the other, some `ALPHA_NEXT` (k - 1) / 2 are
    false, whatever k is (false discovery rate instead of any false name at all).

    known : rounds with another noise model, which many rows go on from
    """
    many = search.linear
    first = search.tested((), draws, generator)
    path: list[Choice] = list(known) if many else [()]
    chosen = path[-1]
    tested = search.tested(chosen, draws, generator)
    while len(chosen) < MOST and (longer := _next(search, chosen, tested, generator)) is not None:
        chosen = longer if many else swapped(search, longer)
        path.append(chosen)
        tested = search.tested(chosen, draws, generator)
    shorter = backward(search, swapped(search, chosen) if many else chosen)
    if shorter != chosen:
        chosen, tested = shorter, search.tested(shorter, draws, generator)
    return Selection(chosen, neighbors(search, chosen), first, tested, (*path, chosen))


def _next(
    search: HypothesisSearch, chosen: Choice, tested: HypothesisTest, generator: np.random.Generator
) -> Choice | None:
    """The set with what is found next, None if that is nothing, or nothing worth a round."""
    level = (ALPHA_NEXT * len(chosen) if chosen else ALPHA_FIRST) * search.level_factor
    change = np.where(tested.omnibus_test.adjusted <= level, tested.change, np.inf)
    longer = best_of(search, chosen, tested.members, change) or several(search, chosen, generator)
    if longer is None or search.bic(longer) >= search.bic(chosen):
        return None
    return longer if search.fit(longer).squares <= (1.0 - LEAST_GAIN) * search.fit(chosen).squares else None


def several(search: HypothesisSearch, chosen: Choice, generator: np.random.Generator) -> Choice | None:
    """Two effects or more at once that together are significant under noise that is the same everywhere.

    Effects that are all there hide each other from tests of one at a time: each is tested against a scatter that the
    others make. So effects are added one after the other, untested, and every number of them is tested at once: F test
    of the longer set against the one at hand, times the weighted number of sets of that many (Bonferroni). Beyond
    `ALPHA_CLEAR` the noise need not look the same everywhere, since no noise does that.
    """
    best, longer, useless, lowest = None, chosen, 0, 1.0
    smallest = ALPHA_CLEAR if search.noise_estimated else ALPHA_SEVERAL
    while len(longer) < MOST and useless < PATIENCE:
        more = _longer(search, longer)
        if more is None:
            break
        longer = more
        p = sets_p(search, chosen, longer)
        useless = 0 if p < lowest else useless + 1
        lowest = min(p, lowest)
        if p < smallest and len(longer) > len(chosen) + 1:
            best, smallest = longer, p
    if best is None or smallest <= ALPHA_CLEAR:
        return best
    return best if homoscedastic(search.fit(best), search.rows, generator) else None


def _longer(search: HypothesisSearch, chosen: Choice) -> Choice | None:
    """A set with the hypothesis added that lowers the linear BIC most.

    Two settings of one effect are no such set: they do not mask each other, and joint noise makes ripples of any order.
    """
    state = search.state(chosen)
    if not state.members or state.against.freedom - search.repeated < SPARE_AFTER:
        return None
    named = {h.key for h in chosen}
    change = np.where([h.key in named for h in state.members], np.inf, state.change)
    k = int(np.argmin(change))
    return (*chosen, state.members[k].free) if np.isfinite(change[k]) else None


def sets_p(search: HypothesisSearch, chosen: Choice, longer: Choice) -> float:
    """p-value of what a set has more than another, times the weighted number of sets of that many effects."""
    added = [h for h in longer if h not in chosen]
    count, total = len(added), sum(h.weight for h in search.hypotheses.members)
    log_sets = count * np.log(total) - lgamma(count + 1.0) - sum(np.log(h.weight) for h in added)
    p = max(nested_p(search.fit(chosen), search.fit(longer), search.repeated), TINY)
    return float(np.exp(min(np.log(p) + log_sets, 0.0)))


def nested_p(before: Fit, after: Fit, repeated: int = 0) -> float:
    """p-value of the F test of a fit against one of a model that it contains.

    repeated : coordinates of repeats, which are no degrees of freedom: what they repeat may be an error that is there
    """
    size, freedom = max(after.rank - before.rank, 1), max(after.freedom - repeated, 1)
    f = (before.squares - after.squares) / size / max(after.squares / freedom, TINY)
    return float(fdtrc(size, freedom, f))


def exchanges(search: HypothesisSearch, chosen: Choice, window: float = WINDOW) -> list[Choice]:
    """Sets in which one member is replaced by one of its best rivals.

    window : of many rows, how much worse than the member itself by the linear BIC; the linear figures are good enough
    """
    found = []
    many = search.linear
    for k, member in enumerate(chosen):
        rest = chosen[:k] + chosen[k + 1 :]
        state = search.state_without(chosen, member)
        members, change = state.members, state.change
        limit = change.min(initial=np.inf) + MARGIN + WINDOW
        if many:
            own = [c for h, c in zip(members, change, strict=True) if h.effect.label == member.effect.label]
            limit = min([limit, *(c + window for c in own)])
        for index in np.argsort(change, kind="stable")[:REFITS]:
            if change[index] <= limit:
                found.append((*rest, members[index].free))
    return found


def swapped(search: HypothesisSearch, chosen: Choice) -> Choice:
    """The best set that single exchanges lead to: the omnibus test says that something is missing, BIC says what."""
    for _ in range(SWAPS):
        best = min(exchanges(search, chosen, window=-1.0), key=search.bic, default=chosen)
        if search.bic(best) >= search.bic(chosen) - 1e-9:
            return chosen
        chosen = best
    return chosen


def backward(search: HypothesisSearch, chosen: Choice) -> Choice:
    """Drop members as long as BIC falls; of many rows only the one that the linear model can best do without."""
    while len(chosen) > 1:
        options = chosen
        if search.linear:
            options = (min(chosen, key=lambda member: search.linear_bic_without(chosen, member)),)
        best = min((tuple(h for h in chosen if h is not member) for member in options), key=search.bic)
        if search.bic(best) >= search.bic(chosen):
            break
        chosen = best
    return chosen


def neighbors(search: HypothesisSearch, chosen: Choice) -> tuple[tuple[Choice, float], ...]:
    """Sets of the same length within `WINDOW` of the best BIC, one per set of names, best first."""
    if not chosen:
        return ()
    best = search.bic(chosen)
    found: dict[tuple[str, ...], tuple[Choice, float]] = {}
    for option in sorted([chosen, *exchanges(search, chosen)], key=search.bic):
        delta = search.bic(option) - best
        if delta <= WINDOW:
            found.setdefault(tuple(sorted(h.key for h in option)), (option, delta))
    return tuple(found.values())
