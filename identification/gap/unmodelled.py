"""Is something left that no effect of the library explains, and where does it sit?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from identification.gap.search import Choice, HypothesisSearch
from identification.gap.unmodelled_survey import LEVEL, Sample, Survey, adjusted, shapes_beside, survey_all

# reasons: identification/README.md, "Constants"
# BIC that an unknown shape must gain on k effects that it would replace, 6 (2 - k): one effect is believed, two have no
# credit left, three or more at once may be the series expansion of something else
ODDS = 6.0
PLACES = {"base_drift": "time", "base_rotation_drift": "time", "axes_skew": "workspace"}


@dataclass(frozen=True)
class Unknown:
    """p : adjusted for all shapes at all places;  place : `joint:j`, `time`, `workspace`, or None if nothing is left
    shape : the shape that fits best, for people;  chosen : effects of the library that stay named beside it
    bic : of the named effects, with the unknown shape where there is one
    """

    p: float
    place: str | None
    shape: str | None
    chosen: Choice
    bic: float


def find_unmodelled(search: HypothesisSearch, chosen: Choice, generator: np.random.Generator) -> Unknown:
    """General block test after the last accepted effect, then the place by BIC."""
    sets = [chosen, *_reduced(chosen)]
    sample = Sample(len(search.rows), search.rows.dimension, generator)
    surveys = survey_all(search, sets, sample)
    p = adjusted(search, surveys[0], sample, generator) if surveys[0].listed else 1.0
    best = search.bic(chosen)
    options = [_option(search, kept, shapes) for kept, shapes in zip(sets, surveys, strict=True) if shapes.listed]
    if p <= LEVEL * search.level_factor:
        return _best(p, options)
    fewer = [(o, len(chosen) - len(o.kept)) for o in options]
    replacing = [o for o, k in fewer if k > 0 and o.bic < best - ODDS * (2 - k)]
    return _best(p, replacing) if replacing else Unknown(p, None, None, chosen, best)


def likeliest_shape(search: HypothesisSearch, unknown: Unknown) -> Unknown:
    """The shape that the library lacks with the lowest BIC, in place of names or beside them, however it compares with
    the names alone."""
    sets = [unknown.chosen, *_reduced(unknown.chosen)]
    surveys = ((kept, shapes_beside(search, kept)) for kept in sets)
    return _best(unknown.p, [_option(search, kept, shapes) for kept, shapes in surveys if shapes.listed])


class _Option(NamedTuple):
    """A shape beside what is kept of the named effects, with the BIC of both."""

    bic: float
    kept: Choice
    place: str
    shape: str


def _best(p: float, options: list[_Option]) -> Unknown:
    """The option of the lowest BIC."""
    best = min(options, key=lambda option: option.bic)
    return Unknown(p, best.place, best.shape, best.kept, best.bic)


def _option(search: HypothesisSearch, kept: Choice, shapes: Survey) -> _Option:
    """The shape that lowers BIC most beside a set, which has the named effects or only some of them."""
    changes = shapes.bic_changes
    k = int(np.argmin(changes))
    return _Option(search.bic(kept) + float(changes[k]), kept, *shapes.listed[k])


def _reduced(chosen: Choice) -> list[Choice]:
    """The set without one member, without all members at one place, and the empty set."""
    sets = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
    for place in dict.fromkeys(place_of(h.key) for h in chosen):
        sets.append(tuple(h for h in chosen if place_of(h.key) != place))
    unique = {frozenset(h.label for h in s): s for s in [*sets, *([()] if chosen else [])]}
    return list(unique.values())


def place_of(key: str) -> str:
    """Where an effect of the library would be looked for, were it unknown."""
    name, _, joint = key.partition(":")
    return f"joint:{joint}" if joint else PLACES.get(name, name)
