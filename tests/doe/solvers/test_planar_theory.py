"""Plans from theory attain the bound: checked by complex arithmetic, limits by comparison."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem
from doe.bounds.planar_theorem import closed_form_bound
from doe.solvers import solve
from identification import Arm, EffectSpec, JobError, Status
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, SIX, problem, random_box
from tests.doe.bounds.test_planar_theorem import complex_log_det
from tests.doe.plan.test_plan import smallest_gap


@pytest.mark.parametrize("links", range(2, 9))
def test_without_limits_any_number_of_runs_is_optimal_without_a_solver(links: int) -> None:
    arm = Arm(np.full(links, 100.0))
    for runs in (links, links + 1, 2 * links + 1, 3 * links):
        design = solve(problem(arm), runs, seed=runs)
        assert design.solver == "analytic"
        assert abs(complex_log_det(design.plan.postures)) < 1e-8  # the issue's bar
        assert design.certified_optimal
    for runs in (links + 1, 3 * links):
        assert abs(complex_log_det(solve(problem(arm, OFFSET), runs).plan.postures, offset=True)) < 1e-8


def check(arm: Arm, runs: int, *effects: EffectSpec) -> None:
    """Optimal by complex arithmetic, within the limits, without repeats."""
    case = problem(arm, *effects)
    design = solve(case, runs)
    postures = design.plan.postures
    assert (design.solver, design.status, len(postures)) == ("analytic", Status.bound_reached, runs)
    assert complex_log_det(postures, offset=bool(effects)) == pytest.approx(closed_form_bound(case).value, abs=1e-9)
    assert np.all(postures >= arm.lower)
    assert np.all(postures <= arm.upper)
    assert smallest_gap(postures) >= np.radians(1.0) * (1 - 1e-9)


@pytest.mark.parametrize("runs", [4, 20, 28, 364, 500])
def test_multiples_of_four_with_the_limits_of_the_issue(runs: int) -> None:
    """doe/README.md, "Planar theorem": m = 4 attains the bound, and so do blocks of four, however many."""
    check(FOUR, runs)


@pytest.mark.parametrize("arm", [FOUR, Arm(FOUR.lengths)])
@pytest.mark.parametrize("runs", [8, 364])
def test_with_a_base_offset_no_joint_is_free_to_tell_postures_apart(arm: Arm, runs: int) -> None:
    check(arm, runs, OFFSET)


@settings(max_examples=15)
@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_whole_factorials_in_random_limits(links: int, seed: int) -> None:
    """The two-level factorial of joints 2..n, and its multiples, attain the bound (doe/README.md, "Planar theorem")."""
    generator = np.random.default_rng(seed)
    size, box = 2 ** (links - 1), random_box(generator, links)
    arm = Arm(box.lengths, np.r_[-np.pi, box.lower[1:]], np.r_[np.pi, box.upper[1:]])  # joint 1 is free to tell apart
    check(arm, size * int(generator.integers(max(1, links // size + 1), 500 // size + 1)))


def test_other_numbers_of_many_runs_begin_from_theory() -> None:
    """361 is odd, so joint 3 cannot be at both limits equally often; 360 runs can, and one more costs 1/361 at most.

    M' of 361 runs is at least 360/361 of that of 360: log det is lower by 8 log(361/360) at most.
    """
    design = solve(problem(FOUR), 361, seconds=0.3)
    assert complex_log_det(design.plan.postures) >= closed_form_bound(problem(FOUR)).value - 8.0 * np.log(361 / 360)
    assert smallest_gap(design.plan.postures) >= np.radians(1.0) * (1 - 1e-9)


def test_many_runs_have_a_time_budget_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("doe.solvers.solving.LONG_PLAN_SECONDS", 0.2)
    assert solve(problem(FIVE), 101, "exchange").status is Status.time_limit
    assert solve(problem(FIVE), 101, "random", starts=2).status is Status.starts_finished


def test_first_joint_is_spread_over_its_limits_in_shuffled_order() -> None:
    first = solve(problem(FOUR), 8).plan.postures[:, 0]
    np.testing.assert_allclose(np.sort(first), np.radians(np.arange(-180 + 22.5, 180, 45)))
    assert np.any(np.diff(first) < 0)


@pytest.mark.parametrize("case", [problem(SIX), problem(FIVE), problem(Arm(FOUR.lengths), ECCENTRICITY)])
def test_none_where_theory_has_none(case: DesignProblem) -> None:
    with pytest.raises(JobError, match="analytic"):
        solve(case, 13, "analytic")
