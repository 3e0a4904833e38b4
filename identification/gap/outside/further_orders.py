"""Extend the search to gear ripples of further orders, where a general shape shows one in the residuals.

Gears cause waves with hundreds of periods per turn and of orders that are not whole numbers. Testing all of them would
cost power and time. The general shapes include them all: where one of those explains the residuals at a joint, it is
added to the hypotheses with the weight of one order among all orders of that scan, and the search is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from identification.arm import EffectSpec
from identification.effects import build
from identification.gap.hypotheses.hypotheses import Hypothesis, HypothesisSet
from identification.gap.outside.unmodelled import Unknown, find_unmodelled
from identification.gap.outside.unmodelled_shapes import FREE_ORDERS, WAVES
from identification.gap.selection.search import HypothesisSearch, series_joints
from identification.gap.selection.selection import Selection, select
from identification.progress import Tell, say_nothing, within

# reasons: identification/README.md, "Constants"
EFFECT, ORDER = "transmission_ripple", "k"
LOWEST = 3.0  # periods per turn: slower waves are no teeth, they are part of some smooth curve
BETWEEN = (-0.125, 0.0, 0.125)  # of an order, beside those scanned: likeness 0.99 with every one between
WEIGHT = 0.2  # prior beside the orders that are tried at first
LOOKUPS = 4  # effort


@dataclass(frozen=True)
class ExtendedSearch:
    """A search with the effects it selected and the unknown effect beside them, if any."""

    search: HypothesisSearch
    selection: Selection
    unknown: Unknown


def extended_search(
    search: HypothesisSearch,
    selection: Selection,
    draws: int,
    generator: np.random.Generator,
    tell: Tell = say_nothing,
) -> ExtendedSearch:
    """Look for an unknown effect beside a selection; where that is a gear ripple, search again with it included."""
    found = ExtendedSearch(search, selection, find_unmodelled(search, selection.chosen, generator, tell))
    for _ in range(LOOKUPS):
        wave = wave_of(found.unknown)
        if wave is not None and wave[0] in series_joints(found.selection.chosen):
            break  # one wave more would be a term of a series
        wider = None if wave is None else with_orders(found.search.hypotheses, *wave)
        if wider is None or len(wider.members) == len(found.search.hypotheses.members):
            break
        again = HypothesisSearch(wider, search.rows, search.noise_estimated)
        chosen = select(again, draws, generator, found.selection.path, within("further orders, ", tell))
        found = ExtendedSearch(again, chosen, find_unmodelled(again, chosen.chosen, generator, tell))
    return found


def wave_of(unknown: Unknown) -> tuple[int, float] | None:
    """Joint (from 1) and order of an unknown shape that could be a gear ripple; None for any other."""
    order = WAVES.get(unknown.shape or "", 0.0)
    if unknown.place is None or not unknown.place.startswith("joint:") or order < LOWEST:
        return None
    return int(unknown.place.partition(":")[2]), order


def with_orders(known: HypothesisSet, joint: int, order: float) -> HypothesisSet:
    """The hypotheses extended by ripples of this and of neighboring orders at a joint (from 1)."""
    arm, there = known.arm, {h.label for h in known.members}
    weight = WEIGHT / (np.sqrt(arm.links) * len(FREE_ORDERS))
    added = []
    for beside in BETWEEN:
        spec = EffectSpec(EFFECT, joint, {ORDER: order + beside})
        hypothesis = Hypothesis(build(spec, arm.links, arm.lengths, dimension=arm.dimension), spec, weight)
        if hypothesis.label not in there:
            added.append(hypothesis)
    return replace(known, members=(*known.members, *added))
