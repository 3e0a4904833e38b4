"""Posterior probabilities: they sum to 1, agree with an enumeration by hand, and follow the evidence."""

from __future__ import annotations

import numpy as np
import pytest

from doe.studies.blind import cells
from identification.gap.diagnose import diagnose, varying
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import hypotheses
from identification.gap.probability.probabilities import CREDIBLE, FIRST, LISTED, NEXT, Probabilities, probabilities
from identification.gap.result import Diagnosis
from identification.gap.workflow import Workflow

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
    assert sum(found.credible_set.values()) > 0.5 * CREDIBLE
    data_of = found.to_json()
    assert data_of["probabilities"] == found.probability
    assert all(entry["probability"] >= LISTED for entry in data_of["other_sets"])


def test_odds_of_one_effect_by_hand() -> None:
    """Ripples have 62 orders; the prior weight of each is that of the joint's effect divided by them."""
    data = cells.data_set("none m=20", 3_000_001)
    library = hypotheses(data.arm, varying(data.measurements))
    found = Workflow(library, 399, np.random.default_rng(0)).findings(Rows.of(data.measurements))
    posterior, search = probabilities(found), found.search
    assert not found.selection.chosen
    member = next(h for h in library.members if h.key == "gear_ratio:1")
    base, fitted = search.fit(()), search.fit((member,))
    weights = sum(h.weight for h in library.members if not h.tied)
    sizes = 6.0 * 2.0 ** np.arange(14)
    left = fitted.squares + (base.squares - fitted.squares) / (1.0 + sizes**2)
    kept = sizes**2 / (1.0 + sizes**2)
    moment = (kept + kept**2 * (base.squares - fitted.squares) * base.freedom / left) / sizes**2
    factor = np.mean((1.0 + sizes**2) ** -0.5 * (left / base.squares) ** (-0.5 * base.freedom) * moment)
    # the search used the linear fit, which differs by the size of the effect squared
    assert posterior.of(["gear_ratio:1"]) / posterior.none == pytest.approx(
        FIRST * member.weight / weights * factor, rel=1e-2
    )


def test_the_credible_set_ends_where_it_is_nearest() -> None:
    """0.55 + 0.3 are nearer to 0.9 than 0.55 or 0.55 + 0.3 + 0.12."""
    found = Probabilities(0.3, {("a",): 0.55, ("b",): 0.01, ("a", "b"): 0.12}, 0.02)
    assert list(found.credible) == [("a",), ()]
    assert list(Probabilities(0.03, {("a",): 0.95}, 0.02).credible) == [("a",)]
    assert list(Probabilities(0.3, {("a",): 0.55}, 0.15).credible) == [("a",), ()]
    assert found.of(["b", "a"]) == 0.12
    assert found.of([]) == 0.3
    assert found.beside([("a",)]) == {("a", "b"): 0.12, ("b",): 0.01}


def test_a_curve_of_an_unknown_function_is_outside_the_library() -> None:
    found = Probabilities(0.2, {("a",): 0.7}, 0.1)
    named, unknown = found.with_odds(["b", "a"], np.log(3.0)), found.with_odds(None, np.log(3.0))
    assert (named.none, named.of(["a", "b"]), named.outside) == pytest.approx((0.05, 0.75, 0.025))
    assert (unknown.none, unknown.of(["a"]), unknown.outside) == pytest.approx((0.05, 0.175, 0.775))


def test_a_further_effect_is_likelier_the_more_there_are() -> None:
    assert 0.0 < NEXT < FIRST
