"""One certificate bounds all numbers of runs: no plan of any of them is above it, and at its own it is the bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.bounds.best_known import LOOSE, EveryRunCertificate, best_known_bound, bounds_of_runs
from doe.criteria import A
from tests.doe.arms import FOUR, OFFSET, problem

KEPT = np.random.default_rng(5).uniform(FOUR.lower, FOUR.upper, (3, 4))
LIST = np.random.default_rng(6).uniform(FOUR.lower, FOUR.upper, (400, 4))
KNOWN = problem(FOUR, OFFSET, kept=KEPT, choices=LIST, deviations={"length_error:1": 0.05, "joint_offset:2": 1e-4})
NUMBERS = (2, 5, 20)


@pytest.mark.parametrize("case", [KNOWN, replace(KNOWN, criterion=A())], ids=["D", "A"])
def test_the_certificate_of_one_number_of_runs_holds_for_others(case: object) -> None:
    made = EveryRunCertificate.of(KNOWN if case is KNOWN else case, 5)  # type: ignore[arg-type]
    generator = np.random.default_rng(0)
    for m in NUMBERS:
        own = best_known_bound(case, m)  # type: ignore[arg-type]
        assert own is not None
        value, upper = made.at(case, m)  # type: ignore[arg-type]
        assert value <= own.value + 1e-9 * abs(own.value)
        assert upper >= own.value - 1e-6 * abs(own.value) if m != 5 else upper == pytest.approx(own.value, rel=1e-9)
        for _ in range(20):  # by hand: (sum B^T B + K) / (m + k)
            plan = LIST[generator.integers(len(LIST), size=m)]
            rows = case.scaled_jacobians(np.concatenate([plan, KEPT])).reshape(-1, 10)  # type: ignore[attr-defined]
            information = (rows.T @ rows + np.diag(case.precisions)) / (m + 3)  # type: ignore[attr-defined]
            assert case.criterion.value(information) <= upper  # type: ignore[attr-defined]


def test_bounds_in_between_are_near_to_those_of_their_own() -> None:
    found = bounds_of_runs(KNOWN, range(2, 30))
    for m in (2, 7, 13, 29):
        bound, own = found[m], best_known_bound(KNOWN, m)
        assert bound is not None
        assert own is not None
        assert own.value - 1e-7 <= bound.value <= own.value + 4.0 * LOOSE * KNOWN.parameters


def test_without_anything_known_there_is_one_bound() -> None:
    found = bounds_of_runs(problem(FOUR), [4, 9])
    assert found[4] is found[9]
    assert found[4] is not None
    assert found[4].source == "closed_form"


def test_a_search_that_is_cut_leaves_bounds_that_hold() -> None:
    found = bounds_of_runs(KNOWN, [5, 20], stop=lambda: True)
    for m in (5, 20):
        bound, own = found[m], best_known_bound(KNOWN, m)
        assert bound is not None
        assert own is not None
        assert bound.cut
        assert bound.as_dict()["cut"] is True
        assert "cut" in str(bound)
        assert bound.value >= own.value - 1e-7
