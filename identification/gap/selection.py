"""Which effects: BIC after the omnibus test, forward, swap and backward, with nonlinear refits."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import compress

import numpy as np
from scipy.special import fdtrc

from identification.gap.f_tests import Dictionary
from identification.gap.fit import Fit, fit
from identification.gap.hypotheses import Hypothesis, HypothesisSet, Slopes, projected
from identification.gap.noise import homoscedastic
from identification.gap.omnibus_test import OmnibusTest, Scatter, omnibus_test
from identification.gap.whitening import Rows
from identification.model import Model

# reasons: identification/README.md, "Constants"
MOST = 4  # effects at once; more are the series of something else
ALPHA_FIRST, ALPHA_NEXT = 0.035, 0.005  # of 0.05 in all, screening and the test for unknown shapes need a part
# two effects can mask each other in single tests; both at once must be far beyond chance, one alone not implausible
ALPHA_PAIR, PAIR_HINT = 1e-5, 0.35
PAIR_STARTS = 3  # effort: single effects that a pair is built on
LEVEL_FACTOR = 0.5  # tuned: factor on the levels where the noise model was estimated from the same data
MARGIN, REFITS = 8.0, 6  # effort: rivals within this linear BIC, and as many at most, are refitted
WINDOW = 6.0  # Delta BIC of the ambiguity set: odds of 20 to 1
Choice = tuple[Hypothesis, ...]


@dataclass(frozen=True)
class HypothesisTest:
    """One omnibus test of all hypotheses that could be added to a set."""

    members: list[Hypothesis]
    omnibus_test: OmnibusTest
    change: np.ndarray  # (H,) linear change of BIC


@dataclass
class HypothesisSearch:
    """Fits of sets of effects to the same rows, kept so that none is made twice.

    noise_estimated : the noise model of the rows comes from the same data, so all levels are multiplied by LEVEL_FACTOR
    """

    hypotheses: HypothesisSet
    rows: Rows
    noise_estimated: bool = False
    fits: dict[frozenset[str], Fit] = field(default_factory=dict)
    tests: dict[frozenset[str], HypothesisTest] = field(default_factory=dict)

    @cached_property
    def slopes(self) -> Slopes:
        """The part of all columns that needs no fit, see `HypothesisSet.slopes`."""
        return self.hypotheses.slopes(self.rows)

    @property
    def level_factor(self) -> float:
        """On all levels of significance."""
        return LEVEL_FACTOR if self.noise_estimated else 1.0

    def fit(self, chosen: Choice) -> Fit:
        """The base model with these effects added, refitted."""
        key = frozenset(h.label for h in chosen)
        if key not in self.fits:
            arm = self.hypotheses.arm
            ordered = sorted(chosen, key=self.hypotheses.place)
            model = Model(arm.with_effects(*arm.effects, *(h.spec for h in ordered)))
            start = model.parameters.mapping(model.values) | self.fit(()).by_name if chosen else None
            ties = [[p.name for p in h.effect.parameters] for h in chosen if h.tied]
            self.fits[key] = fit(model, self.rows, start, ties)
        return self.fits[key]

    def bic(self, chosen: Choice) -> float:
        """BIC of a set; of a family whose parameters may be equal, the better of the two forms."""
        forms = [self._bic(chosen)]
        equal = {h.key: h for h in self.hypotheses.members if h.tied}
        if any(h.key in equal and not h.tied for h in chosen):
            forms.append(self._bic(tuple(equal.get(h.key, h) for h in chosen)))
        return min(forms)

    def _bic(self, chosen: Choice) -> float:
        """N log(RSS / N) + p log N - 2 log(prior weight); the scan of a setting costs the logarithm of its length."""
        found = self.fit(chosen)
        n = len(found.residual)
        prior = -2.0 * sum(np.log(h.weight) for h in chosen)
        return float(n * np.log(max(found.squares, 1e-300) / n) + found.count * np.log(n) + prior)

    def tested(self, chosen: Choice, draws: int, generator: np.random.Generator) -> HypothesisTest:
        """Omnibus test and linear BIC of every hypothesis that could be added to a set."""
        key = frozenset(h.label for h in chosen)
        if key not in self.tests:
            found = self.fit(chosen)
            members, against = self.rivals(chosen)
            scatter = self.scatter(chosen, members, against, generator)
            result = omnibus_test(found.residual, against, self.rows.dimension, draws, generator, scatter)
            change = bic_change(result.reductions, against, len(found.residual), found.squares)
            self.tests[key] = HypothesisTest(members, result, change)
        return self.tests[key]

    def scatter(
        self, chosen: Choice, members: list[Hypothesis], against: Dictionary, generator: np.random.Generator
    ) -> Scatter | None:
        """What is left beside the strongest hypothesis, if that looks like the same noise everywhere; else None.

        An effect that is there makes the residuals larger where it is strong, and a bootstrap of them expects just
        that of chance. Where the noise itself may be larger at some postures, that caution is right.
        """
        if self.noise_estimated or not members:
            return None
        found = self.fit(chosen)
        reductions = against.reductions(found.residual[:, None])
        p = against.p_values(reductions, np.array([found.squares]))[:, 0] / against.weights
        best = self.fit((*chosen, members[int(np.argmin(p))]))
        return (best.residual, best.basis) if homoscedastic(best, self.rows, generator) else None

    def rivals(self, chosen: Choice) -> tuple[list[Hypothesis], Dictionary]:
        """Hypotheses that can still be added to a set, projected off its fit."""
        found, used = self.fit(chosen), {h.effect.label for h in chosen}
        columns = self.hypotheses.columns(self.rows, found.by_name, self.slopes, found.model)
        left = [h.effect.label not in used and h.size < found.freedom for h in self.hypotheses.members]
        members = list(compress(self.hypotheses.members, left))
        full = projected(found.basis, members, [self.rows.whiten(c) for c in compress(columns, left)])
        keep = np.flatnonzero(full.sizes > 0)  # of the others nothing survives projection
        return [members[k] for k in keep], full.subset(keep)

    def changes(self, chosen: Choice) -> tuple[list[Hypothesis], np.ndarray]:
        """Hypotheses that can still be added to a set, and (H,) the change of BIC by each, from the linear fit."""
        members, against = self.rivals(chosen)
        residual = self.fit(chosen).residual
        reductions = against.reductions(residual[:, None])[:, 0]
        return members, bic_change(reductions, against, len(residual), self.fit(chosen).squares)


def bic_change(reductions: np.ndarray, against: Dictionary, n: int, squares: float) -> np.ndarray:
    """(H,) change of BIC when each hypothesis is added, from the linear fit's reductions of the sum of squares (H,)."""
    left = np.maximum(1.0 - reductions / squares, 1e-12)
    return n * np.log(left) + against.sizes * np.log(n) - 2.0 * np.log(against.weights)


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
        members, change = search.changes(rest)
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
