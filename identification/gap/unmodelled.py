"""Is something left that no effect of the library explains, and where does it sit?"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.gap.f_tests import Dictionary, dictionary
from identification.gap.omnibus_test import wild_draws
from identification.gap.selection import Choice, HypothesisSearch, bic_change
from identification.gap.unmodelled_shapes import GeneralShape, general_shapes

# reasons: identification/README.md, "Constants"
LEVEL = 0.001  # tuned: `unknown` takes names back
BOOTSTRAP_LEVEL = 0.05  # tuned: the wild bootstrap has a veto only
DRAWS = (399, 1999)  # 1 / 2000 is the strictest level; the second number only where the first shows nothing as strange
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


@dataclass(frozen=True)
class Shapes:
    """General shapes projected off a fit."""

    listed: list[GeneralShape]
    against: Dictionary
    reductions: Array  # (shapes,) of the sum of squares
    bic: Array  # (shapes,) of the fit with the shape added
    smallest: float  # weighted p-value


def find_unmodelled(search: HypothesisSearch, chosen: Choice, generator: np.random.Generator) -> Unknown:
    """General block test after the last accepted effect, then the place by BIC."""
    after = shapes_beside(search, chosen)
    p = _adjusted(after, search, chosen, generator) if after.listed else 1.0
    best = search.bic(chosen)
    options = _options(search, chosen, after)
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
    shape: GeneralShape


def _best(p: float, options: list[_Option], place: str | None = None) -> Unknown:
    """The option of the lowest BIC;  place : where it counts as, whatever the place of the shape."""
    bic, kept, best = min(options, key=lambda option: option.bic)
    return Unknown(p, place or best.place, best.shape if place in (None, best.place) else None, kept, bic)


def effects_at(chosen: Choice, place: str) -> int:
    """How many effects of a set sit at a place."""
    return sum(place_of(h.key) == place for h in chosen)


def _joint_with_series(chosen: Choice) -> str | None:
    """A joint with `SERIES_TERMS` effects or more: they are the series of one unknown function."""
    for place in (place_of(h.key) for h in chosen):
        if place.startswith("joint:") and effects_at(chosen, place) >= SERIES_TERMS:
            return place
    return None


def _options(search: HypothesisSearch, chosen: Choice, after: Shapes) -> list[_Option]:
    """A shape added to the chosen set, or put in the place of some of its members; few rows may leave none."""
    sets = [(chosen, after), *((rest, shapes_beside(search, rest)) for rest in _reduced(chosen))]
    lowest = [(rest, shapes, int(np.argmin(shapes.bic))) for rest, shapes in sets if shapes.listed]
    return [_Option(float(shapes.bic[k]), rest, shapes.listed[k]) for rest, shapes, k in lowest]


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


def shapes_beside(search: HypothesisSearch, chosen: Choice) -> Shapes:
    """What no effect of the library has, tested on what a set of effects leaves."""
    found = search.fit(chosen)
    listed = [a for a in general_shapes(found, search.rows) if a.columns.shape[2] < found.freedom - 1]
    counts = Counter(a.place for a in listed)
    weights = np.array([1.0 / (counts[a.place] * len(counts)) for a in listed])
    columns = [search.rows.whiten(a.columns) for a in listed]
    full = dictionary(found.basis, columns, np.zeros(len(listed), dtype=bool), weights)
    keep = np.flatnonzero((full.sizes > 0) & (full.norm_fractions > 0.02))
    against = full.subset(keep)
    residual = found.residual[:, None] - against.model_basis @ (against.model_basis.T @ found.residual[:, None])
    reductions = against.reductions(residual)
    bic = search.bic(chosen) + bic_change(reductions[:, 0], against, len(residual), found.squares)
    smallest = against.smallest_weighted(reductions, np.square(residual).sum(axis=0))[0]
    return Shapes([listed[k] for k in keep], against, reductions[:, 0], bic, float(smallest))


def _adjusted(shapes: Shapes, search: HypothesisSearch, chosen: Choice, generator: np.random.Generator) -> float:
    """Adjusted p-value of the best shape under white Gaussian noise, if the wild bootstrap does not object.

    The wild bootstrap alone would have no power against a shape that moves a few postures only (their signs come out
    alike too often), Gaussian noise alone would take scatter for waves; so the bootstrap is asked at `BOOTSTRAP_LEVEL`
    only.
    """
    q, residual = shapes.against.model_basis, search.fit(chosen).residual
    drawn = wild_draws(residual, q, q, search.rows.dimension, DRAWS[0], generator)
    scatter = _tail(shapes, drawn) * LEVEL / BOOTSTRAP_LEVEL
    white = 1.0
    for draws in DRAWS:
        drawn = generator.standard_normal((len(q), draws))
        white = _tail(shapes, drawn - q @ (q.T @ drawn))
        if white > 1.0 / (draws + 1.0):
            break
    return max(white, scatter)


def _tail(shapes: Shapes, drawn: Array) -> float:
    smallest = shapes.against.smallest_weighted(shapes.against.reductions(drawn), np.square(drawn).sum(axis=0))
    return float((1.0 + np.sum(smallest <= shapes.smallest)) / (1.0 + drawn.shape[1]))
