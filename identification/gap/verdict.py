"""What a posterior says: probabilities of explanations, and the verdict that follows from them.

An explanation is nothing missing, a set of effects of the library (settings left out), or something outside the
library. A verdict that is wrong costs 1, and so it is the likeliest of these three: nothing, some effects of the
library, something outside. To name a wrong set costs 1, to leave it open which one it is 1/2: a set is `named` where
it has half of the probability, else the verdict is `ambiguous`, and candidates are the sets that have at least
`LEVEL` of the probability of the best.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from identification.estimation.uncertainty import LEVEL_95 as LEVEL
from identification.gap.posterior import Explanation, Posterior
from identification.gap.search import MOST, NEGLIGIBLE

CREDIBLE = 0.9  # convention: probability of the credible set
Names = tuple[str, ...]


@dataclass(frozen=True)
class Probabilities:
    """Posterior probabilities of all explanations, with sum 1.

    none : nothing is missing;  sets : sorted keys of a set of effects -> its probability
    places : place -> probability of something outside the library there, as part of the likeliest explanation
    titles : sorted keys -> title with the most probable settings, `base_offset + transmission_ripple:2[k=17]`
    outside : something outside the library
    """

    none: float
    sets: Mapping[Names, float]
    places: Mapping[str, float]
    titles: Mapping[Names, str] = field(default_factory=dict)
    outside: float = 0.0

    def title(self, names: Names) -> str:
        """Title of a set of effects, given by its sorted keys."""
        return self.titles.get(names, " + ".join(names))

    def of(self, keys: Iterable[str]) -> float:
        """Probability that exactly the effects with these keys are missing."""
        names = tuple(sorted(keys))
        return self.sets.get(names, 0.0) if names else self.none

    def beside(self, candidates: Iterable[Names]) -> dict[Names, float]:
        """Sets of effects other than the candidates that are not `NEGLIGIBLE`, most probable first."""
        listed = {tuple(sorted(keys)) for keys in candidates}
        rest = [(names, p) for names, p in self.sets.items() if p >= NEGLIGIBLE and names not in listed]
        return dict(sorted(rest, key=lambda pair: -pair[1]))

    @property
    def credible(self) -> dict[Names | None, float]:
        """Credible set: explanations with a total probability of about `CREDIBLE`, most probable first.

        The last one is included if more than half of its probability is needed, so that over many data sets the set
        contains the truth about as often as stated. () is nothing missing, None something outside the library.
        """
        every: list[tuple[Names | None, float]] = [((), self.none), *self.sets.items(), (None, self.outside)]
        credible_sets: dict[Names | None, float] = {}
        for names, p in sorted(every, key=lambda pair: -pair[1]):
            if credible_sets and sum(credible_sets.values()) + 0.5 * p >= CREDIBLE:
                break
            credible_sets[names] = p
        return credible_sets

    @property
    def best(self) -> Names:
        """The likeliest set of names, empty without any."""
        return max(self.sets, key=lambda n: (round(self.sets[n], 9), n), default=())

    @property
    def verdict(self) -> str:
        """`none`, `named`, `ambiguous` or `unknown`."""
        totals = {"none": self.none, "named": sum(self.sets.values()), "unknown": self.outside}
        likeliest = max(totals, key=lambda kind: round(totals[kind], 9))
        return "ambiguous" if likeliest == "named" and self.sets[self.best] < 0.5 else likeliest

    @property
    def rivals(self) -> list[Names]:
        """Candidates: sets of names that are not much less likely than the likeliest, this first."""
        if self.verdict not in ("named", "ambiguous"):
            return []
        order = sorted(self.sets, key=lambda n: (-round(self.sets[n], 9), n != self.best, n))
        many = min(MOST, sum(self.sets[names] >= self.sets[self.best] * LEVEL for names in order))
        return order[: max(2 if self.verdict == "ambiguous" else 1, many)]

    @property
    def place(self) -> str | None:
        """Where something outside the library is likeliest."""
        return max(self.places, key=lambda p: (round(self.places[p], 9), p), default=None)

    def not_none(self, p: float) -> Probabilities:
        """Where noise cannot leave so much with more than probability p: nothing is as much less likely."""
        return replace(self, none=self.none * p, outside=self.outside + self.none * (1.0 - p))


def keys_of(one: Explanation) -> Names:
    """Sorted keys of an explanation's effects."""
    return tuple(sorted(b.key for b in one.effects))


def probabilities(posterior: Posterior) -> Probabilities:
    """Probabilities of explanations, noise models and settings summed over."""
    totals, places, titles = defaultdict[Names | None, float](float), defaultdict[str, float](float), dict[Names, str]()
    for one in posterior.explanations:
        names = keys_of(one)
        totals[None if one.outside else names] += one.probability
        for place in {block.place for block in one.outside}:
            places[place] += one.probability
        if not one.outside:
            titles.setdefault(names, " + ".join(b.label for b in one.effects))
    none, outside = totals.pop((), 0.0), totals.pop(None, 0.0)
    return Probabilities(none, {n: p for n, p in totals.items() if n}, dict(places), titles, outside)


def likeliest_with(posterior: Posterior, names: Names, outside: bool = False) -> Explanation:
    """The likeliest explanation with exactly these effects;  outside : or, with something outside beside any effects"""
    if outside:
        return next((one for one in posterior.explanations if one.outside), posterior.best)
    return next(one for one in posterior.explanations if not one.outside and keys_of(one) == names)
