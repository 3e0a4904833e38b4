"""The door: the same seed gives the same plan, and what is no problem, plan or solver is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.design import score_plan
from doe.problem.problem import DesignProblem
from doe.solvers import Offer, solve
from doe.solvers.solver import LONG_PLAN
from doe.solvers.solving import SOLVERS
from identification.errors import InputError
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem


@dataclass
class Crowded:
    """A solver whose postures are all one."""

    name: str = "crowded"

    def starts_for(self, _: object) -> int:
        return 1

    def offers(self, case: DesignProblem, runs: int, *_: object) -> Iterator[Offer]:
        yield Offer(np.tile(case.lower, (runs, 1)), 1)


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


def test_of_very_many_runs_a_random_plan_is_better_than_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the search offers comes too near each other: the random plan beside it keeps the distance, by the distances
    of all pairs."""
    case, runs = problem(FOUR, OFFSET, ECCENTRICITY), LONG_PLAN + 100
    monkeypatch.setitem(SOLVERS, "exchange_ipopt", Crowded())
    design = solve(case, runs, seconds=1e-3, bound=Bound(np.inf, "continuous"))
    assert design.solver == "random"
    plan = design.plan.postures
    apart = np.abs(plan[:, None] - plan).max(axis=2)[np.triu_indices(runs, 1)]
    assert apart.min() >= np.radians(1.0) * (1 - 1e-9)
    assert np.all((plan >= FOUR.lower) & (plan <= FOUR.upper))
