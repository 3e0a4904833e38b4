"""The multiplicative algorithm against the exact weights of column generation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.bounds import certificate as equivalence
from doe.bounds import column_generation as module
from doe.bounds.column_generation import column_generation, rough_design
from doe.criteria import A, D, E
from doe.problem.postures import listed_candidates
from identification.errors import InputError
from identification.running import Status
from tests.doe.arms import ECCENTRICITY, FOUR, problem

NAMES = ("encoder_eccentricity:2.a", "encoder_eccentricity:2.b")


@pytest.mark.parametrize("criterion", [D(), A()])
@pytest.mark.parametrize("deviations", [{}, {"encoder_eccentricity:2.a": 5e-4, "encoder_eccentricity:2.b": 5e-4}])
def test_within_its_gap_of_the_optimum(criterion: D | A, deviations: dict[str, float]) -> None:
    """Its value is below the optimum and its bound above, both within the gap that it stops at."""
    case = replace(problem(FOUR, ECCENTRICITY, deviations=deviations), criterion=criterion)
    candidates = listed_candidates(case, np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (150, 4)))
    found = rough_design(case, candidates, runs=20)
    exact = column_generation(case, candidates, runs=20)
    assert found.bound is not None
    assert exact.bound is not None
    assert found.value <= exact.value + 1e-9
    assert exact.value <= exact.bound.value <= found.bound.value + 1e-9
    assert 0.97 < found.efficiency_lower_bound <= 1.0
    assert found.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("criterion", [D(), A()])
def test_many_candidates_in_parts(monkeypatch: pytest.MonkeyPatch, criterion: D | A) -> None:
    """A sample of 60 of 3,000, and what passes over all offer: still within the gap of the optimum over all."""
    monkeypatch.setattr(module, "WEIGHTED", 60)
    monkeypatch.setattr(module, "REMEMBERED", 0)
    case = replace(problem(FOUR, ECCENTRICITY, deviations=dict.fromkeys(NAMES, 5e-4)), criterion=criterion)
    candidates = listed_candidates(case, np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (3000, 4)))
    found, exact = rough_design(case, candidates, runs=20), column_generation(case, candidates, runs=20)
    assert (found.status, found.candidates) == (Status.converged, 3000)
    assert found.bound is not None
    assert exact.bound is not None
    assert found.value <= exact.value + 1e-9
    assert exact.value <= exact.bound.value <= found.bound.value + 1e-9
    assert found.efficiency_lower_bound > 0.97
    listed = {tuple(posture) for posture in candidates.postures}
    assert {tuple(posture) for posture in found.plan.postures} <= listed
    assert len(found.plan) == len({tuple(posture) for posture in found.plan.postures})


def test_no_bound_where_no_time_is_left_to_visit_every_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(equivalence, "LAST", -1.0)
    monkeypatch.setattr(equivalence, "perf_counter", lambda: 0.0)  # no time passes, and all of it is over
    case = problem(FOUR, ECCENTRICITY, deviations=dict.fromkeys(NAMES, 5e-4))
    candidates = listed_candidates(case, np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (300, 4)))
    found = rough_design(case, candidates, runs=20, stop=lambda: True)
    assert (found.status, found.bound, found.gap) == (Status.time_limit, None, np.inf)
    assert found.efficiency_lower_bound == 0.0
    assert found.solver_status == "no bound: no time to visit every candidate"
    assert found.value == pytest.approx(case.criterion.value(case.prior.per_new_run(20).information(
        case.weighted_information(found.plan.postures, found.plan.shares)
    )))  # fmt: skip


def test_other_criteria_are_refused() -> None:
    case = replace(problem(FOUR), criterion=E())
    with pytest.raises(InputError, match="criterion: E for solver multiplicative"):
        rough_design(case, listed_candidates(case, np.zeros((3, 4))))
