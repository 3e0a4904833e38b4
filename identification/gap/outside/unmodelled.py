"""Detect an effect outside the library and locate it: at a joint, in time, or in the workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from identification.gap.outside.unmodelled_survey import LEVEL, LEVEL_FIRST, Survey, adjusted, shapes_beside, survey_all
from identification.gap.selection.search import Choice, HypothesisSearch
from identification.progress import Tell, say_nothing, within

# reasons: identification/README.md, "Constants"
# BIC that an unknown shape must gain over k effects that it would replace, 6 (2 - k): a single effect is given credit,
# two are not, and three or more may be the series expansion of something else
ODDS = 6.0
PLACES = {"base_drift": "time", "base_rotation_drift": "time", "axes_skew": "workspace"}


@dataclass(frozen=True)
class Unknown:
    """Result of the search for an effect outside the library.

    p : p-value adjusted for all shapes at all places;  place : `joint:j`, `time`, `workspace`, None: no such effect
    shape : description of the best shape;  chosen : effects of the library that stay named
    bic : of the named effects, together with the shape if there is one
    """

    p: float
    place: str | None
    shape: str | None
    chosen: Choice
    bic: float


def find_unmodelled(
    search: HypothesisSearch, chosen: Choice, generator: np.random.Generator, tell: Tell = say_nothing
) -> Unknown:
    """Test whether any general shape explains the residuals of a set of effects, and locate the best by BIC."""
    sets = [chosen, *_reduced(chosen)]
    surveys = survey_all(search, sets, within("other shapes, ", tell))
    level = (LEVEL if chosen else LEVEL_FIRST) * search.level_factor
    p = adjusted(surveys[0], level, generator) if surveys[0].listed else 1.0
    best = search.bic(chosen)
    options = [_option(search, kept, shapes) for kept, shapes in zip(sets, surveys, strict=True) if shapes.listed]
    if p <= level:
        return _best(p, options)
    fewer = [(o, len(chosen) - len(o.kept)) for o in options]
    replacing = [o for o, k in fewer if k > 0 and o.bic < best - ODDS * (2 - k)]
    return _best(p, replacing) if replacing else Unknown(p, None, None, chosen, best)


def likeliest_shape(search: HypothesisSearch, unknown: Unknown) -> Unknown:
    """The shape outside the library with the lowest BIC, beside the named effects or in place of some, whether or not
    it improves on them."""
    sets = [unknown.chosen, *_reduced(unknown.chosen)]
    surveys = ((kept, shapes_beside(search, kept)) for kept in sets)
    return _best(unknown.p, [_option(search, kept, shapes) for kept, shapes in surveys if shapes.listed])


class _ShapeChoice(NamedTuple):
    """A shape with the named effects that are kept beside it, and the BIC of both together."""

    bic: float
    kept: Choice
    place: str
    shape: str


def _best(p: float, options: list[_ShapeChoice]) -> Unknown:
    """The option with the lowest BIC, as a result."""
    best = min(options, key=lambda option: option.bic)
    return Unknown(p, best.place, best.shape, best.kept, best.bic)


def _option(search: HypothesisSearch, kept: Choice, shapes: Survey) -> _ShapeChoice:
    """The shape that reduces BIC most beside a set of effects."""
    changes = shapes.bic_changes
    k = int(np.argmin(changes))
    return _ShapeChoice(search.bic(kept) + float(changes[k]), kept, *shapes.listed[k])


def _reduced(chosen: Choice) -> list[Choice]:
    """All sets without one member, all without the members at one place, and the empty set."""
    sets = [chosen[:k] + chosen[k + 1 :] for k in range(len(chosen))]
    for place in dict.fromkeys(place_of_effect(h.key) for h in chosen):
        sets.append(tuple(h for h in chosen if place_of_effect(h.key) != place))
    unique = {frozenset(h.label for h in s): s for s in [*sets, *([()] if chosen else [])]}
    return list(unique.values())


def place_of_effect(key: str) -> str:
    """Place at which the effect with this key acts."""
    name, _, joint = key.partition(":")
    return f"joint:{joint}" if joint else PLACES.get(name, name)
