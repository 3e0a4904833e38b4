"""Select effects: forward by BIC while the omnibus test is significant, exchange, then backward, with refits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import lgamma

import numpy as np
from scipy.special import fdtrc

from identification.gap.fits.fit import Fit
from identification.gap.hypotheses.f_tests import TINY
from identification.gap.hypotheses.hypotheses import Hypothesis
from identification.gap.noise.noise import homoscedastic
from identification.gap.selection.pairs import pairs
from identification.gap.selection.search import Choice, HypothesisSearch, HypothesisTest
from identification.progress import Tell, say_nothing

# reasons: identification/README.md, "Constants"
MOST, SWAPS = 40, 8  # effort: effects at once, exchanges in one round
ALPHA_FIRST, ALPHA_NEXT = 0.035, 0.005  # of 0.05 in all, screening and the test for unknown shapes need a part
# effects can mask each other in single tests; several at once must be far beyond chance
ALPHA_SEVERAL, ALPHA_CLEAR = 1e-5, 1e-20
PATIENCE = 4  # effort: effects added without getting more significant before that ends
LEAST_GAIN = 0.02  # of the sum of squares: a round must lower the RMS by 1 % or more
SPARE_AFTER = 10  # degrees of freedom that several effects must leave
MARGIN, REFITS = 8.0, 6  # effort: rivals within this linear BIC, and as many at most, are refitted
WINDOW = 6.0  # Delta BIC of the ambiguity set: odds of 20 to 1


@dataclass(frozen=True)
class Selection:
    """Result of the selection.

    chosen : the best set, empty if nothing was significant
    rivals : all sets within `WINDOW` of its BIC with the difference, best first
    first, last : omnibus tests of the base model and of the chosen set
    path : the sets after each round, from the empty one on
    """

    chosen: Choice
    rivals: tuple[tuple[Choice, float], ...]
    first: HypothesisTest
    last: HypothesisTest
    path: tuple[Choice, ...] = ()


def trial_of(
    search: HypothesisSearch, chosen: Choice, draws: int, generator: np.random.Generator
) -> tuple[float, float]:
    """F statistic and adjusted p-value of the least significant member of a set, each tested beside the others."""
    found = []
    for k, member in enumerate(chosen):
        tested = search.tested(chosen[:k] + chosen[k + 1 :], draws, generator)
        same = [i for i, h in enumerate(tested.members) if h.free.label == member.label]
        if same:
            at = min(same, key=lambda i: tested.omnibus_test.adjusted[i])
            found.append((float(tested.omnibus_test.f[at]), float(tested.omnibus_test.adjusted[at])))
    return max(found, key=lambda trial: (trial[1], -trial[0]), default=(0.0, 1.0))


def best_of(search: HypothesisSearch, chosen: Choice, members: list[Hypothesis], change: np.ndarray) -> Choice | None:
    """The set with the one hypothesis added that gives the lowest BIC; the best few by linearized BIC are refitted.

    change : (H,) change of BIC with each of the `members`, infinite for those not allowed
    """
    order = np.argsort(change, kind="stable")[:REFITS]
    near = [k for k in order if np.isfinite(change[k]) and change[k] <= change[order[0]] + MARGIN]
    return min(((*chosen, members[k].free) for k in near), key=search.bic, default=None)


def counted(effects: int) -> str:
    """`1 effect`, `3 effects`."""
    return f"{effects} effect{'s' * (effects != 1)}"


def select(
    search: HypothesisSearch,
    draws: int,
    generator: np.random.Generator,
    known: tuple[Choice, ...] = ((),),
    tell: Tell = say_nothing,
) -> Selection:
    """Add effects while the omnibus test or the test of several effects at once is significant.

    After each addition single effects are exchanged, and at the end those not needed are removed. The level increases
    with the number of effects named: of k effects found one after the other about `ALPHA_NEXT` (k - 1) / 2 of each are
    false, whatever k (a bound on the false discovery rate rather than on any false name at all).

    known : path of a search with another noise model, which a `linear` search continues
    tell : is told the number of effects named so far
    """
    many = search.linear
    first = search.tested((), draws, generator)
    path: list[Choice] = list(known) if many else [()]
    chosen = path[-1]
    tell(counted(len(chosen)))
    tested = search.tested(chosen, draws, generator)
    while len(chosen) < MOST and (longer := _next(search, chosen, tested, generator)) is not None:
        chosen = longer if many else swapped(search, longer)
        path.append(chosen)
        tell(counted(len(chosen)))
        tested = search.tested(chosen, draws, generator)
    shorter = backward(search, swapped(search, chosen) if many else chosen)
    if shorter != chosen:
        chosen, tested = shorter, search.tested(shorter, draws, generator)
    return Selection(chosen, neighbors(search, chosen), first, tested, (*path, chosen))


def _next(
    search: HypothesisSearch, chosen: Choice, tested: HypothesisTest, generator: np.random.Generator
) -> Choice | None:
    """The set with the next significant effects added; None if there are none, or their gain is below `LEAST_GAIN`."""
    level = (ALPHA_NEXT * len(chosen) if chosen else ALPHA_FIRST) * search.level_factor
    change = np.where(tested.omnibus_test.adjusted <= level, tested.change, np.inf)
    longer = best_of(search, chosen, tested.members, change)
    longer = longer or several(search, chosen, generator) or pair_instead(search, chosen)
    if longer is None or search.bic(longer) >= search.bic(chosen):
        return None
    return longer if search.fit(longer).squares <= (1.0 - LEAST_GAIN) * search.fit(chosen).squares else None


def several(search: HypothesisSearch, chosen: Choice, generator: np.random.Generator) -> Choice | None:
    """Two or more effects that are jointly significant, assuming homoscedastic noise; None if there are none.

    Several missing effects mask each other in tests of one at a time: each is tested against scatter that includes the
    others. Blocks of effects are therefore tested as a whole: an F test against the given set, with Bonferroni's
    correction for the weighted number of sets of that size. Below `ALPHA_CLEAR` homoscedastic noise is not required, as
    no noise explains so small a p-value.
    """
    level = ALPHA_CLEAR if search.noise_estimated else ALPHA_SEVERAL
    found = [(p, longer) for longer, p in _blocks(search, chosen) if p < level]
    if not found:
        return None
    smallest, best = min(found, key=lambda block: block[0])
    return best if smallest <= ALPHA_CLEAR or homoscedastic(search.fit(best), search.rows, generator) else None


def _blocks(search: HypothesisSearch, chosen: Choice) -> Iterator[tuple[Choice, float]]:
    """Sets with two or more effects added, and the p-value of these.

    First the best pair where there is nothing yet, as the effect that seems strongest may be neither of the two; then
    effects that are added one after the other, untested, until that no longer gets more significant.
    """
    if not chosen:
        yield from ((pair, sets_p(search, chosen, pair)) for pair, _ in _possible_pairs(search)[:1])
    longer, useless, lowest = chosen, 0, 1.0
    while len(longer) < MOST and useless < PATIENCE:
        more = _longer(search, longer)
        if more is None:
            break
        longer = more
        p = sets_p(search, chosen, longer)
        useless = 0 if p < lowest else useless + 1
        lowest = min(p, lowest)
        if len(longer) > len(chosen) + 1:
            yield longer, p


def _possible_pairs(search: HypothesisSearch) -> list[tuple[Choice, float]]:
    """`pairs` that leave `SPARE_AFTER` degrees of freedom."""
    spare = search.fit(()).freedom - search.repeated - SPARE_AFTER
    return [(pair, change) for pair, change in pairs(search) if sum(h.size for h in pair) <= spare]


def pair_instead(search: HypothesisSearch, chosen: Choice) -> Choice | None:
    """The pair of effects that explains the data better than one or two others; None if there is none.

    Of as many effects BIC decides. One effect more is a new claim: with the number of sets of each size counted in the
    prior (J. Chen and Z. Chen, "Extended Bayesian information criteria", 2008) the odds must be 20 to 1. Pairs that
    contain the set are left out, as the omnibus test has judged the second effect.
    """
    if not 1 <= len(chosen) <= 2:
        return None
    margin = WINDOW + 2.0 * np.log(search.hypotheses.total_weight) if len(chosen) == 1 else 0.0
    limit = search.bic(chosen) - margin
    change = limit - search.bic(())
    likely = [pair for pair, linear in _possible_pairs(search) if linear < change]
    others = [pair for pair in likely if not set(chosen) <= set(pair)]
    best = min(others[:REFITS], key=search.bic, default=chosen)
    return best if search.bic(best) < limit else None


def _longer(search: HypothesisSearch, chosen: Choice) -> Choice | None:
    """The set with the hypothesis added that reduces the linearized BIC most; None if too few rows are left.

    An effect already in the set is not added with another setting: two settings do not mask each other, and joint noise
    resembles ripples of any order.
    """
    state = search.state(chosen)
    if not state.members or state.against.freedom - search.repeated < SPARE_AFTER:
        return None
    named = {h.key for h in chosen}
    change = np.where([h.key in named for h in state.members], np.inf, state.change)
    k = int(np.argmin(change))
    return (*chosen, state.members[k].free) if np.isfinite(change[k]) else None


def sets_p(search: HypothesisSearch, chosen: Choice, longer: Choice) -> float:
    """p-value of the effects that one set has beyond another, corrected for the weighted number of such sets."""
    added = [h for h in longer if h not in chosen]
    count, total = len(added), sum(h.weight for h in search.hypotheses.members)
    log_sets = count * np.log(total) - lgamma(count + 1.0) - sum(np.log(h.weight) for h in added)
    p = max(nested_p(search.fit(chosen), search.fit(longer), search.repeated), TINY)
    return float(np.exp(min(np.log(p) + log_sets, 0.0)))


def nested_p(before: Fit, after: Fit, repeated: int = 0) -> float:
    """p-value of the F test of a fit against the fit of a nested model.

    repeated : coordinates of repeated postures, not counted as degrees of freedom: their errors may repeat as well
    """
    size, freedom = max(after.rank - before.rank, 1), max(after.freedom - repeated, 1)
    f = (before.squares - after.squares) / size / max(after.squares / freedom, TINY)
    return float(fdtrc(size, freedom, f))


def exchanges(search: HypothesisSearch, chosen: Choice, window: float = WINDOW) -> list[Choice]:
    """Sets in which one member is replaced by one of its best rivals.

    window : in a `linear` search, by how much the BIC of a rival may exceed that of the member itself
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
    """The best set reached by single exchanges: the omnibus test decides that an effect is missing, BIC which one."""
    for _ in range(SWAPS):
        best = min(exchanges(search, chosen, window=-1.0), key=search.bic, default=chosen)
        if search.bic(best) >= search.bic(chosen) - 1e-9:
            return chosen
        chosen = best
    return chosen


def backward(search: HypothesisSearch, chosen: Choice) -> Choice:
    """Remove members as long as BIC decreases; a `linear` search tries only the least important one each time."""
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
    """Ambiguity set: sets of equal length within `WINDOW` of the best BIC, one for each set of keys, best first."""
    if not chosen:
        return ()
    best = search.bic(chosen)
    found: dict[tuple[str, ...], tuple[Choice, float]] = {}
    for option in sorted([chosen, *exchanges(search, chosen)], key=search.bic):
        delta = search.bic(option) - best
        if delta <= WINDOW:
            found.setdefault(tuple(sorted(h.key for h in option)), (option, delta))
    return tuple(found.values())
