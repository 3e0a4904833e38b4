"""Posterior probabilities of all explanations: nothing missing, sets of effects, a shape outside the library.

The explanations are the base model, every single effect, the chosen set and its rivals, each of these with one more
effect, the chosen set with one effect less, and a shape outside the library beside each of them. Sets that were
refitted are weighed by their own fit, the others by the linearized one.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from identification.arrays import Array
from identification.gap.outside.unmodelled_survey import shapes_beside
from identification.gap.probability.marginal_likelihood import Decomposition, decomposed, log_bayes_factor
from identification.gap.selection.search import Choice, HypothesisSearch
from identification.gap.workflow import Findings

# reasons: identification/README.md, "Constants"
FIRST = 4.0  # prior odds of one missing effect to none
NEXT = 0.1  # prior odds of a further effect, for each that is there already
OUTSIDE = 0.003  # prior odds of a shape outside the library to an effect of it
CREDIBLE = 0.9  # probability of the credible set
LISTED = 0.01  # less likely sets are not listed by name
NEGLIGIBLE = 45.0  # log odds: all sets of a library below that are 1e-15 together
Names = tuple[str, ...]


@dataclass(frozen=True)
class Probabilities:
    """Posterior probabilities of all explanations, with sum 1.

    none : no detectable effect is missing;  sets : sorted keys of a set of effects -> its probability
    outside : a shape outside the library
    titles : sorted keys -> title with the most probable settings, `base_offset + transmission_ripple:2[k=17]`
    """

    none: float
    sets: Mapping[Names, float]
    outside: float
    titles: Mapping[Names, str] = field(default_factory=dict)

    def title(self, names: Names) -> str:
        """Title of a set of effects, given by its sorted keys."""
        return self.titles.get(names, " + ".join(names))

    def of(self, keys: Iterable[str]) -> float:
        """Probability that exactly the effects with these keys are missing."""
        names = tuple(sorted(keys))
        return self.sets.get(names, 0.0) if names else self.none

    def with_odds(self, keys: Iterable[str] | None, log_odds: float) -> Probabilities:
        """The probabilities with one more explanation, given its log odds against all others together.

        keys : of its effects; None: it is outside the library
        """
        rest = float(1.0 / (1.0 + np.exp(min(log_odds, 700.0))))
        sets, outside = {names: rest * p for names, p in self.sets.items()}, rest * self.outside
        if keys is None:
            outside += 1.0 - rest
        else:
            sets[tuple(sorted(keys))] = 1.0 - rest
        return replace(self, none=rest * self.none, sets=sets, outside=outside)

    def beside(self, candidates: Iterable[Names]) -> dict[Names, float]:
        """Sets of effects other than the candidates with a probability of at least `LISTED`, most probable first."""
        known = {tuple(sorted(keys)) for keys in candidates}
        rest = [(names, p) for names, p in self.sets.items() if p >= LISTED and names not in known]
        return dict(sorted(rest, key=lambda pair: -pair[1]))

    @property
    def credible(self) -> dict[Names | None, float]:
        """Credible set: explanations with a total probability of about `CREDIBLE`, most probable first.

        The last one is included if more than half of its probability is needed, so that over many data sets the set
        contains the truth about as often as stated. () is nothing missing, None a shape outside the library.
        """
        every: list[tuple[Names | None, float]] = [((), self.none), *self.sets.items(), (None, self.outside)]
        found: dict[Names | None, float] = {}
        for names, p in sorted(every, key=lambda pair: -pair[1]):
            if found and sum(found.values()) + 0.5 * p >= CREDIBLE:
                break
            found[names] = p
        return found


class _EffectSet(NamedTuple):
    """One set of effects.

    labels : of its effects, which identify it;  names : sorted keys;  log_odds : against the base model
    refitted : it has a fit of its own
    """

    chosen: Choice
    labels: frozenset[str]
    names: Names
    log_odds: float
    refitted: bool


def probabilities(found: Findings) -> Probabilities:
    """Posterior probabilities from the findings of the workflow."""
    search, chosen = found.search, found.selection.chosen
    fewer = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
    beside = list(dict.fromkeys([(), *fewer, chosen]))
    anchors = {a: _refitted(search, a) for a in [*beside, *(rival for rival, _ in found.selection.rivals)]}
    least = max(option.log_odds for option in anchors.values()) - NEGLIGIBLE
    sets: dict[frozenset[str], _EffectSet] = {}
    for anchor, own in anchors.items():
        for option in [own, *_longer(search, anchor, least)]:
            known = sets.get(option.labels)
            if known is None or (option.refitted, option.log_odds) > (known.refitted, known.log_odds):
                sets[option.labels] = option
    outside = float(logsumexp([_outside(search, anchor) for anchor in beside]))
    return _normalized(search, list(sets.values()), outside)


def _normalized(search: HypothesisSearch, options: list[_EffectSet], outside: float) -> Probabilities:
    total = logsumexp([outside, *(option.log_odds for option in options)])
    sets: dict[Names, float] = {}
    likeliest = {option.names: option.chosen for option in sorted(options, key=lambda option: option.log_odds)}
    for option in options:
        sets[option.names] = sets.get(option.names, 0.0) + float(np.exp(option.log_odds - total))
    none = sets.pop(())
    titles = {names: _title(search, chosen) for names, chosen in likeliest.items()}
    return Probabilities(none, sets, float(np.exp(outside - total)), titles)


def _refitted(search: HypothesisSearch, chosen: Choice) -> _EffectSet:
    """A set of effects, weighed by its own fit."""
    found, base = search.fit(chosen), search.fit(())
    labels, names = _labels(chosen), tuple(sorted(h.key for h in chosen))
    if not chosen:
        return _EffectSet(chosen, labels, names, 0.0, refitted=True)
    factor = log_bayes_factor(_decomposed(search, chosen), found.squares, base.squares, base.freedom)
    return _EffectSet(chosen, labels, names, float(factor) + _log_prior(search, chosen), refitted=True)


def _longer(search: HypothesisSearch, chosen: Choice, least: float) -> Iterator[_EffectSet]:
    """The set with each further effect, weighed by its fit if there is one, else by the linearized fit.

    least : log odds below which a set is negligible
    """
    found, base, own = search.fit(chosen), search.fit(()), _labels(chosen)
    members, against = search.rivals(chosen)
    reductions = against.reductions(found.residual[:, None])[:, 0]
    groups = _decomposed(search, chosen).with_each(against.sizes, reductions)
    log_odds = log_bayes_factor(groups, found.squares, base.squares, base.freedom)
    one_sign = np.array([member.one_sign for member in members])
    log_odds += _log_prior(search, chosen) + _log_steps(search, len(chosen), against.weights, one_sign)
    log_odds -= np.log(2.0) * against.one_sided * (reductions == 0.0)  # it has the other sign
    keys = [h.key for h in chosen]
    fitted = {label for labels in search.fits if own < labels for label in labels - own if len(labels) == len(own) + 1}
    known = np.array([bool(fitted) and member.effect.label in fitted for member in members], dtype=bool)
    for k in np.flatnonzero(known | (log_odds >= least)):
        member, further = members[k], members[k].free
        if known[k]:
            yield _refitted(search, (*chosen, further))
        elif member.tied or member.key not in search.hypotheses.families:
            names = tuple(sorted([*keys, further.key]))  # a family as one value, until it is fitted
            yield _EffectSet((*chosen, further), own | {further.label}, names, float(log_odds[k]), refitted=False)


def _outside(search: HypothesisSearch, chosen: Choice) -> float:
    """Log odds of a shape outside the library beside a set; -inf if too few rows are left for one."""
    base, found = search.fit(()), search.fit(chosen)
    shapes = shapes_beside(search, chosen)
    if not shapes.listed:
        return -np.inf
    sizes, reductions = np.array(shapes.sizes), np.array(shapes.reductions)
    groups = _decomposed(search, chosen).with_each(sizes, reductions)
    factors = log_bayes_factor(groups, found.squares, base.squares, base.freedom)
    prior = np.log(OUTSIDE * (NEXT * len(chosen) if chosen else FIRST)) + _log_prior(search, chosen)
    return float(logsumexp(factors + np.log(shapes.weights)) + prior)


def _labels(chosen: Choice) -> frozenset[str]:
    return frozenset(h.label for h in chosen)


def _title(search: HypothesisSearch, chosen: Choice) -> str:
    """Title as of a candidate: labels in the order of results and files."""
    return " + ".join(h.free.label for h in sorted(chosen, key=search.hypotheses.place))


def _decomposed(search: HypothesisSearch, chosen: Choice) -> Decomposition:
    found = search.fit(chosen)
    added = len(found.model.effects) - len(chosen)  # the arm's own come first
    effects = found.model.effects[added:]
    names = [[p.name for p in effect.parameters] for effect in effects]
    families = {h.effect.label for h in chosen if h.key in search.hypotheses.families}
    return decomposed(found, names, [effect.label in families for effect in effects])


def _log_prior(search: HypothesisSearch, chosen: Choice) -> float:
    """Log prior odds of a set against nothing missing: the sum of its `_log_steps`."""
    steps = (_log_steps(search, count, np.array(h.weight), np.array(h.one_sign)) for count, h in enumerate(chosen))
    return float(sum(steps))


def _log_steps(search: HypothesisSearch, count: int, weights: Array, one_sign: NDArray[np.bool_]) -> Array:
    """Log prior odds of one further effect beside `count` others: `FIRST` for none, `NEXT` times `count` otherwise.

    weights : prior weights of the further effects;  one_sign : True where an effect cannot be negative

    Where several effects are missing, another one is more probable (Polya's urn). An effect of one sign has twice the
    odds, as its prior has half the width.
    """
    odds = NEXT * count if count else FIRST
    return np.asarray(np.log(odds * weights / search.hypotheses.total_weight) + np.log(2.0) * one_sign)
