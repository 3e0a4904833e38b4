"""The multiplicative algorithm against the exact weights of column generation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from doe.bounds.column_generation import column_generation
from doe.bounds.multiplicative import multiplicative
from doe.criteria import A, D, E
from doe.problem.candidates import listed_candidates
from identification.errors import InputError
from tests.doe.arms import ECCENTRICITY, FOUR, problem


@pytest.mark.parametrize("criterion", [D(), A()])
@pytest.mark.parametrize("deviations", [{}, {"encoder_eccentricity:2.a": 5e-4, "encoder_eccentricity:2.b": 5e-4}])
def test_within_its_gap_of_the_optimum(criterion: D | A, deviations: dict[str, float]) -> None:
    """Its value is below the optimum and its bound above, both within the gap that it stops at."""
    case = replace(problem(FOUR, ECCENTRICITY, deviations=deviations), criterion=criterion)
    candidates = listed_candidates(case, np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (150, 4)))
    found = multiplicative(case, candidates, runs=20)
    exact = column_generation(case, candidates, runs=20)
    assert found.bound is not None
    assert exact.bound is not None
    assert found.value <= exact.value + 1e-9
    assert exact.value <= exact.bound.value <= found.bound.value + 1e-9
    assert 0.97 < found.efficiency_lower_bound <= 1.0
    assert found.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)


def test_other_criteria_are_refused() -> None:
    case = replace(problem(FOUR), criterion=E())
    with pytest.raises(InputError, match="criterion: E for solver multiplicative"):
        multiplicative(case, listed_candidates(case, np.zeros((3, 4))))
