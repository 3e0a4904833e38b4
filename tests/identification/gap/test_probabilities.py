"""Posterior probabilities: they sum to 1, agree with an enumeration by hand, and follow the evidence."""

from __future__ import annotations

import numpy as np
import pytest

from doe.studies.blind import cells
from identification.gap.diagnose import diagnose, varying
from identification.gap.hypotheses import hypotheses
from identification.gap.probabilities import CREDIBLE, FIRST, LISTED, NEXT, Probabilities, probabilities
from identification.gap.result import Diagnosis
from identification.gap.whitening import Rows
from identification.gap.workflow import investigate

CELLS = ("none m=20", "one, lambda 8, m=20", "two, lambda 8", "outside, lambda 7")


def diagnosis(cell: str, number: int = 3_000_000) -> tuple[cells.DataSet, Diagnosis]:
    data = cells.data_set(cell, number)
    return data, diagnose(data.arm, data.measurements, draws=399)


@pytest.mark.parametrize("cell", CELLS)
def test_what_is_true_is_likely_and_everything_sums_to_one(cell: str) -> None:
    data, found = diagnosis(cell)
    posterior = found.probabilities
    assert posterior.none + posterior.outside + sum(posterior.sets.values()) == pytest.approx(1.0, abs=1e-9)
    assert sum(found.probability.values()) == pytest.approx(1.0, abs=1e-12)
    assert found.probability.keys() == {"none", "unknown", *(c.title for c in found.candidates)}
    truth = posterior.outside if data.place else posterior.of(data.effects)
    assert truth > 0.5
    assert sum(found.credible_set.values()) >= CREDIBLE - 1e-12
    data_of = found.to_json()
    assert data_of["probabilities"] == found.probability
    assert all(entry["probability"] >= LISTED for entry in data_of["other_sets"])


def test_odds_of_one_effect_by_hand() -> None:
    """Ripples have 62 orders; the prior weight of each is that of the joint's effect divided by them."""
    data = cells.data_set("none m=20", 3_000_001)
    library = hypotheses(data.arm, varying(data.measurements))
    found = investigate(library, Rows.of(data.measurements), 399, np.random.default_rng(0))
    posterior, search = probabilities(found), found.search
    assert not found.selection.chosen
    member = next(h for h in library.members if h.key == "gear_ratio:1")
    base, fitted = search.fit(()), search.fit((member,))
    weights = sum(h.weight for h in library.members if not h.tied)
    sizes = 6.0 * 2.0 ** np.arange(7)
    left = fitted.squares + (base.squares - fitted.squares) / (1.0 + sizes**2)
    factor = np.mean((1.0 + sizes**2) ** -0.5 * (left / base.squares) ** (-0.5 * base.freedom))
    # the search used the linear fit, which differs by the size of the effect squared
    assert posterior.of(["gear_ratio:1"]) / posterior.none == pytest.approx(
        FIRST * member.weight / weights * factor, rel=1e-2
    )


def test_the_credible_set_is_the_shortest() -> None:
    found = Probabilities(0.3, {("a",): 0.55, ("b",): 0.02, ("a", "b"): 0.08}, 0.05)
    assert list(found.credible) == [("a",), (), ("a", "b")]
    assert found.of(["b", "a"]) == 0.08
    assert found.of([]) == 0.3
    assert found.beside([("a",)]) == {("a", "b"): 0.08, ("b",): 0.02}


def test_a_further_effect_is_likelier_the_more_there_are() -> None:
    assert 0.0 < NEXT < FIRST
