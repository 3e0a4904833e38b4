"""Pairs of effects that explain the data best, against least squares of every pair."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from doe.studies.blind.cells import data_set
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import Hypothesis, hypotheses
from identification.gap.selection.pairs import STARTS, pairs
from identification.gap.selection.search import HypothesisSearch
from identification.gap.selection.selection import (
    ALPHA_FIRST,
    ALPHA_SEVERAL,
    SPARE_AFTER,
    WINDOW,
    pair_instead,
    several,
)
from tests.identification.gap.selection.test_search import LIBRARY, NAMES, searched


def bic_of(search: HypothesisSearch, *members: Hypothesis) -> float:
    """BIC of the model linearized about the base fit with these effects, by least squares."""
    base, columns = search.fit(()), search.base_columns
    own = [columns.matrix[:, np.arange(h.size) + columns.starts[search.hypotheses.place(h)]] for h in members]
    a = np.hstack([base.jacobian / base.model.scales, *own])
    a = a / np.linalg.norm(a, axis=0)
    left = base.residual - a @ np.linalg.lstsq(a, base.residual, rcond=1e-9)[0]
    n = len(left)
    weights = np.log([h.weight for h in members])
    return float(n * np.log(left @ left / n) + sum(h.size for h in members) * np.log(n) - 2.0 * np.sum(weights))


def test_each_start_has_its_best_partner() -> None:
    search, truth = searched()
    found = pairs(search)
    assert {h.label for h in found[0][0]} == set(NAMES)
    assert found[0][1] == min(change for _, change in found)
    assert STARTS / 2 <= len(found) <= STARTS  # a start may be the partner of another one
    nothing = bic_of(search)
    for pair, change in found:
        assert change == pytest.approx(bic_of(search, *pair) - nothing, abs=1e-4)
    others = [h for h in LIBRARY.members if h.key != truth[0].key]
    best = min(others, key=lambda other: bic_of(search, truth[0], other))
    assert best.label == truth[1].label


def blind(cell: str, number: int) -> tuple[HypothesisSearch, dict[str, Hypothesis], set[str]]:
    """Search in a set of the blind study, its hypotheses by label, and the hidden effects' keys."""
    data = data_set(cell, number)
    rows = Rows.of(data.measurements)
    library = hypotheses(data.arm, data.measurements.given, rows)
    return HypothesisSearch(library, rows), {h.label: h for h in library.members}, set(data.effects)


@pytest.mark.parametrize(
    ("number", "first"),
    [(21_000_076, ("encoder_eccentricity:1",)), (21_000_075, ("gear_ratio:1", "backlash:2"))],
)
def test_two_effects_that_others_stand_in_for(number: int, first: tuple[str, ...]) -> None:
    """What a search finds that adds one effect after the other, and the pair that was hidden."""
    search, known, hidden = blind("two, lambda 8", number)
    pair = pair_instead(search, tuple(known[label] for label in first))
    assert pair is not None
    assert {h.key for h in pair} == hidden
    assert pair_instead(search, pair) is None
    assert pair_instead(search, ()) is None
    assert pair_instead(search, (*pair, known["backlash:1"])) is None


def test_one_effect_more_needs_clear_odds() -> None:
    """A pair with a lower BIC, though not by 20 to 1 when it counts how many pairs there are; one effect was hidden."""
    search, known, hidden = blind("one, lambda 6, m=50", 21_000_018)
    named = (known["joint_compliance"],)
    gains = [search.bic(named) - search.bic(pair) for pair, _ in pairs(search) if named[0] not in pair]
    total = sum(h.weight for h in search.hypotheses.members if h.label == h.effect.label)
    assert hidden == {"link_bending"}
    assert WINDOW < max(gains) < WINDOW + 2.0 * np.log(total)
    assert pair_instead(search, named) is None


def test_a_pair_leaves_degrees_of_freedom(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of two links have two coordinates each, and their base four parameters: 8 rows allow a pair of 2, 7 none."""
    whole, known, _ = blind("two, lambda 8", 21_000_076)
    first = known["encoder_eccentricity:1"], known["backlash:1"]
    few, fewer = (
        HypothesisSearch(whole.hypotheses, whole.rows.pick(np.arange(len(whole.rows)) < count)) for count in (8, 7)
    )
    pair = pair_instead(few, first)
    assert pair is not None
    assert 2 * 8 - 4 - sum(h.size for h in pair) == SPARE_AFTER
    assert pair_instead(fewer, first) is None
    monkeypatch.setattr("identification.gap.selection.selection.SPARE_AFTER", 0)
    assert pair_instead(fewer, first) is not None


def test_two_effects_that_hide_each_other() -> None:
    """Neither is significant by itself, and the strongest effect is none of the two; together they are."""
    search, known, hidden = blind("two, lambda 8", 31_000_164)
    generator = np.random.default_rng(7)
    assert search.tested((), 399, generator).omnibus_test.adjusted.min() > ALPHA_FIRST
    assert search.state(()).strongest.key not in hidden
    pair = several(search, (), generator)
    assert pair is not None
    assert {h.key for h in pair} == hidden == {"encoder_eccentricity:1", "encoder_second_harmonic:1"}
    # by Bonferroni's inequality over the pairs of equal weight, four columns beside the arm's four parameters
    before, after = (search.fit(chosen).squares for chosen in ((), pair))
    p = stats.f.sf((before - after) / after * (100 - 8) / 4, 4, 100 - 8)
    total = sum(h.weight for h in search.hypotheses.members)
    assert p * (total / known["encoder_eccentricity:1"].weight) ** 2 / 2.0 < ALPHA_SEVERAL
    assert several(HypothesisSearch(search.hypotheses, search.rows, noise_estimated=True), (), generator) is None


def test_no_pair_is_made_of_noise() -> None:
    search, _, hidden = blind("none m=50", 31_000_000)
    assert hidden == set()
    assert several(search, (), np.random.default_rng(7)) is None
