"""Which effects: BIC after the omnibus test, forward, swap and backward, with nonlinear refits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from identification.gap.fit import Fit
from identification.gap.hypotheses import Hypothesis
from identification.gap.noise import homoscedastic
from identification.gap.search import Choice, HypothesisSearch, HypothesisTest

# reasons: identification/README.md, "Constants"
MOST = 4  # effects at once; more are the series of something else
ALPHA_FIRST, ALPHA_NEXT = 0.035, 0.005  # of 0.05 in all, screening and the test for unknown shapes need a part
# two effects can mask each other in single tests; both at once must be far beyond chance, one alone not implausible
ALPHA_PAIR, PAIR_HINT = 1e-5, 0.35
PAIR_STARTS = 3  # effort: single effects that a pair is built on
MARGIN, REFITS = 8.0, 6  # effort: rivals within this linear BIC, and as many at most, are refitted
WINDOW = 6.0  # Delta BIC of the ambiguity set: odds of 20 to 1


@dataclass(frozen=True)
class Selection:
    """chosen : the best set, empty if the omnibus test found nothing
    rivals : all sets within `WINDOW` of its BIC, best first
    first : the omnibus test of the base model;  last : that of the chosen set
    """

    chosen: Choice
    rivals: tuple[tuple[Choice, float], ...]
    first: HypothesisTest
    last: HypothesisTest


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


def select(search: HypothesisSearch, draws: int, generator: np.random.Generator) -> Selection:
    """Forward while the omnibus test finds something, swap after every addition, backward at the end."""
    chosen: Choice = ()
    first = tested = search.tested(chosen, draws, generator)
    while len(chosen) < MOST:
        level = (ALPHA_NEXT if chosen else ALPHA_FIRST) * search.level_factor
        change = np.where(tested.omnibus_test.adjusted <= level, tested.change, np.inf)
        longer = best_of(search, chosen, tested.members, change)
        if longer is None and not chosen and tested.omnibus_test.smallest <= PAIR_HINT:
            longer = pair(search, tested, generator)
        if longer is None or search.bic(longer) >= search.bic(chosen):
            break
        chosen = swapped(search, longer)
        tested = search.tested(chosen, draws, generator)
    shorter = backward(search, chosen)
    if len(shorter) < len(chosen):
        chosen, tested = shorter, search.tested(shorter, draws, generator)
    return Selection(chosen, neighbors(search, chosen), first, tested)


def pair(search: HypothesisSearch, tested: HypothesisTest, generator: np.random.Generator) -> Choice | None:
    """The best two effects at once, if together they are significant under noise that is the same everywhere.

    F test of both against neither, times the weighted number of pairs (Bonferroni).
    """
    if search.noise_estimated:
        return None
    starts = [tested.members[k].free for k in np.argsort(tested.change, kind="stable")[:PAIR_STARTS]]
    best = min((two for one in starts if (two := _with_second(search, one)) is not None), key=search.bic, default=None)
    if best is None:
        return None
    pairs = sum(h.weight for h in search.hypotheses.members) ** 2 / 2.0 / np.prod([h.weight for h in best])
    p = nested_p(search.fit(()), search.fit(best)) * pairs
    return best if p <= ALPHA_PAIR and homoscedastic(search.fit(best), search.rows, generator) else None


def nested_p(before: Fit, after: Fit) -> float:
    """p-value of the F test of a fit against one of a model that it contains."""
    size = after.rank - before.rank
    f = (before.squares - after.squares) / size / (after.squares / after.freedom)
    return float(fdtrc(size, after.freedom, f))


def _with_second(search: HypothesisSearch, one: Hypothesis) -> Choice | None:
    """A hypothesis and the one that lowers the linear BIC most beside it.

    Two settings of one effect are no pair: they do not mask each other, and joint noise makes ripples of any order.
    """
    members, change = search.changes((one,))
    if not members:
        return None
    change = np.where([h.key == one.key for h in members], np.inf, change)
    return (one, members[int(np.argmin(change))].free)


def exchanges(search: HypothesisSearch, chosen: Choice) -> list[Choice]:
    """Sets in which one member is replaced by one of its best rivals."""
    found = []
    for k in range(len(chosen)):
        rest = chosen[:k] + chosen[k + 1 :]
        state = search.state_without(chosen, chosen[k])
        members, change = state.members, state.change
        for index in np.argsort(change, kind="stable")[:REFITS]:
            if change[index] <= change.min() + MARGIN + WINDOW:
                found.append((*rest, members[index].free))
    return found


def swapped(search: HypothesisSearch, chosen: Choice) -> Choice:
    """The best set that single exchanges lead to: the omnibus test says that something is missing, BIC says what."""
    for _ in range(MOST):
        best = min(exchanges(search, chosen), key=search.bic, default=chosen)
        if search.bic(best) >= search.bic(chosen) - 1e-9:
            return chosen
        chosen = best
    return chosen


def backward(search: HypothesisSearch, chosen: Choice) -> Choice:
    """Drop members as long as BIC falls."""
    while len(chosen) > 1:
        best = min((chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))), key=search.bic)
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
