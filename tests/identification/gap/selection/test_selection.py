"""Naming several effects: the test of a block, and robots with many errors at once."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from scipy import stats

from doe.studies.blind.cells import data_set
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.selection.search import HypothesisSearch, series_joints
from identification.gap.selection.selection import select, sets_p
from tests.identification.gap.selection.test_search import LIBRARY, searched


def test_p_value_of_a_block_by_hand() -> None:
    """F test of two nested fits, times the number of pairs: with equal weights of H hypotheses that is H^2 / 2."""
    search, chosen = searched()
    before, after = search.fit(()), search.fit(chosen)
    f = (before.squares - after.squares) / 4 / (after.squares / after.freedom)
    total = sum(h.weight for h in LIBRARY.members)
    pairs = total**2 / 2.0 / (chosen[0].weight * chosen[1].weight)
    assert sets_p(search, (), chosen) == pytest.approx(min(stats.f.sf(f, 4, after.freedom) * pairs, 1.0), rel=1e-6)
    assert pairs > comb(9, 2)


def test_waves_of_a_joint_are_no_more_than_three() -> None:
    waves = [h for h in LIBRARY.members if h.key == "transmission_ripple:2"][:3]
    assert series_joints(tuple(waves[:2])) == set()
    assert series_joints(tuple(waves)) == {2}


def test_many_effects_are_named_in_rounds() -> None:
    """A robot of the blind study's simulator with errors of every encoder, compliance, base, backlash and a ripple."""
    data = data_set("many effects", 4)
    rows = Rows.of(data.measurements)
    search = HypothesisSearch(hypotheses(data.arm, data.measurements.given, rows), rows)
    found = select(search, 399, np.random.default_rng(4))
    named = {h.key for h in found.chosen}
    assert len(named & set(data.effects)) >= 0.8 * len(data.effects)
    assert len(named - set(data.effects)) <= 1
    assert len(found.path) > 3
