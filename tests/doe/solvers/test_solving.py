"""The door: the same seed gives the same plan, and what is no problem, plan or solver is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from doe.design import score_plan
from doe.problem.problem import DesignProblem
from doe.solvers import solve
from doe.solvers.driver import SearchResult
from doe.solvers.random import Random
from doe.solvers.solver import LONG_PLAN
from doe.solvers.solving import spread_out
from identification.errors import InputError
from identification.status import Status
from tests.doe.arms import FIVE, FOUR, OFFSET, problem


@pytest.mark.parametrize("solver", [None, "exchange", "ipopt", "exchange_ipopt", "random", "analytic"])
def test_same_seed_same_plan(solver: str | None) -> None:
    runs = 8 if solver == "analytic" else 6
    plans = [solve(problem(FOUR), runs, solver, seed=s, starts=4).plan.postures for s in (3, 3, 4)]
    np.testing.assert_array_equal(plans[0], plans[1])
    assert not np.array_equal(plans[0], plans[2])


def test_bad_input() -> None:
    with pytest.raises(InputError, match=r"runs: 3 with 8 parameters.*at least 4"):
        solve(problem(FOUR), 3)
    with pytest.raises(InputError, match="at least 5"):
        solve(problem(FOUR, OFFSET), 4)
    with pytest.raises(InputError, match="did you mean 'ipopt'"):
        solve(problem(FIVE), 8, "ipot")


def test_models_and_criteria_are_objects() -> None:
    with pytest.raises(InputError, match=r"model: Arm, allowed: .*Model\(arm\)"):
        DesignProblem.of(FOUR)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="criterion: 'A', allowed"):
        problem(FOUR, criterion="A")


@pytest.mark.parametrize(
    ("plan", "expected"),
    [
        (np.where(np.arange(32).reshape(8, 4) == 9, np.nan, 1.0), "run 3 is not finite"),
        (np.ones((8, 3)), r"shape \(8, 3\), allowed: \(m, 4\)"),
        ([[1.0, 2.0], [3.0]], "allowed: an array"),
        ("plan.csv", "'plan.csv', allowed: an array"),
    ],
)
def test_what_is_no_plan_is_not_scored(plan: Any, expected: str) -> None:
    with pytest.raises(InputError, match=f"plan: .*{expected}"):
        score_plan(problem(FOUR), plan)


def test_of_very_many_runs_a_random_plan_is_better_than_none() -> None:
    """What a search found of 100,000 runs came too near each other, and no time was left to move it apart: a random
    plan keeps the distance, by the distances of all pairs; another result, and fewer runs, stay as they are."""
    case = problem(FOUR, OFFSET, minimum_distance=np.radians(1.0))
    near = SearchResult(np.tile(FOUR.lower, (LONG_PLAN + 100, 1)), -np.inf, Status.time_limit, 3)
    found, solver = spread_out(case, LONG_PLAN + 100, 0, near, Random(7))
    assert found.postures is not None
    apart = np.abs(found.postures[:, None] - found.postures).max(axis=2)[np.triu_indices(LONG_PLAN + 100, 1)]
    assert apart.min() >= np.radians(1.0)
    assert np.all((FOUR.lower <= found.postures) & (found.postures <= FOUR.upper))
    assert found.value == pytest.approx(case.objective(found.postures))
    assert (found.status, solver) == (Status.time_limit, Random())
    for result, runs in ((replace(near, value=-3.0), LONG_PLAN + 100), (near, LONG_PLAN)):
        assert spread_out(case, runs, 0, result, Random(7)) == (result, Random(7))
