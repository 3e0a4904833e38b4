"""Is something left that no effect of the library explains, and where does it sit?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from identification.gap.search import Choice, HypothesisSearch
from identification.gap.unmodelled_survey import LEVEL, Sample, Survey, adjusted, survey_all

# reasons: identification/README.md, "Constants"
SERIES_TERMS = 3  # effects at one joint that are the series of one unknown function
# BIC that an unknown shape must gain on k effects that it would replace, 6 (2 - k): one effect is believed, two have no
# credit left, three or four at once are the series expansion of something else
ODDS = {1: 6.0, 2: 0.0, 3: -6.0, 4: -12.0}
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
    joint = _joint_with_series(chosen)
    if joint is not None and options:
        return _best(p, [o for o in options if effects_at(o.kept, joint) == 0] or options, place=joint)
    if p <= LEVEL * search.level_factor:
        return _best(p, options)
    fewer = [(o, len(chosen) - len(o.kept)) for o in options]
    replacing = [o for o, k in fewer if k > 0 and o.bic < best - ODDS[k]]
    return _best(p, replacing) if replacing else Unknown(p, None, None, chosen, best)


class _Option(NamedTuple):
    """A shape beside what is kept of the named effects, with the BIC of both."""

    bic: float
    kept: Choice
    place: str
    shape: str


def _best(p: float, options: list[_Option], place: str | None = None) -> Unknown:
    """The option of the lowest BIC;  place : where it counts as, whatever the place of the shape."""
    best = min(options, key=lambda option: option.bic)
    shape = best.shape if place in (None, best.place) else None
    return Unknown(p, place or best.place, shape, best.kept, best.bic)


def effects_at(chosen: Choice, place: str) -> int:
    """How many effects of a set sit at a place."""
    return sum(place_of(h.key) == place for h in chosen)


def _joint_with_series(chosen: Choice) -> str | None:
    """A joint with `SERIES_TERMS` effects or more: they are the series of one unknown function."""
    for place in (place_of(h.key) for h in chosen):
        if place.startswith("joint:") and effects_at(chosen, place) >= SERIES_TERMS:
            return place
    return None


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
