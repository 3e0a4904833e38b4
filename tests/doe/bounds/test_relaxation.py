"""The cvxpy relaxation: three solvers agree, no status but solved becomes a bound, and sizes that fail are refused."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds import column_generation as relaxation
from doe.bounds import weights as convex_program
from doe.bounds.column_generation import LARGEST, relax
from doe.criteria import A, Criterion, D, Ds, E, I
from doe.problem.postures import PostureList
from identification.errors import InputError, JobError
from identification.running import Status
from tests.doe.arms import FOUR, OFFSET, problem

TEST_JACOBIANS = problem(FOUR).scaled_jacobians(np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (8, 4)))
SOLVERS = (*LARGEST, "column_generation")
CRITERIA: dict[str, Criterion] = {"D": D(), "A": A(), "I": I(TEST_JACOBIANS), "E": E()}
# what an interior point of cvxpy's default accuracy (1e-8 on the program) leaves of the gap; a first-order method less
GAPS = {"clarabel": 1e-3, "scs": 1e-5, "column_generation": 1e-6}


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_independent_solvers_agree(criterion: Criterion) -> None:
    case = problem(FOUR, criterion=criterion)
    found = {solver: relax(case, 5, solver) for solver in SOLVERS}
    exact = found["column_generation"]
    assert exact.bound is not None
    for solver, design in found.items():
        assert design.candidates == 125
        assert design.status is Status.converged
        assert design.gap <= GAPS[solver] * max(1.0, abs(exact.value))
        assert design.value == pytest.approx(exact.value, rel=1e-4, abs=1e-5)
        assert design.value <= exact.bound.value + 1e-9
        assert design.bound is not None
        assert design.bound.value >= exact.value - 1e-9
        assert design.bound.source == "grid"
        assert design.efficiency_lower_bound >= 1.0 - 1e-3
        assert design.plan.shares.sum() == pytest.approx(1.0, abs=1e-12)
        assert design.plan.shares.min() > 0.0


def test_grid_with_the_limits_reaches_the_closed_form() -> None:
    """Limits and middle of every joint are enough: q_2 has a range above pi, q_3 = -100..60 and q_4 below or equal."""
    expected = 4.0 * np.log(np.sin(np.radians(80.0)))
    for solver in SOLVERS:
        assert relax(problem(FOUR), 5, solver).log_det == pytest.approx(expected, abs=1e-4)
    assert relax(problem(FOUR), 5).log_det == pytest.approx(expected, abs=1e-9)


def test_around_measured_postures() -> None:
    generator = np.random.default_rng(1)
    case = problem(FOUR, OFFSET, kept=generator.uniform(FOUR.lower, FOUR.upper, (6, 4)))
    scs, mine = (relax(case, 3, solver, runs=4) for solver in ("scs", "column_generation"))
    assert scs.value == pytest.approx(mine.value, abs=1e-5)
    with pytest.raises(InputError, match="runs"):
        relax(case, 3, "scs")


@pytest.mark.parametrize("word", ["optimal_inaccurate", "user_limit", "unknown_to_us"])
def test_a_status_other_than_solved_is_reported_and_is_no_bound(monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    """Even with perfect weights; the gap and the efficiency are facts about the weights and stay."""
    exact = relax(problem(FOUR), 3)
    real = convex_program._run
    monkeypatch.setattr(convex_program, "_run", lambda program, solver: (real(program, solver), word)[1])
    found = relax(problem(FOUR), 3, "clarabel")
    assert found.bound is None
    assert found.status is not Status.converged
    assert found.solver_status == word
    assert found.to_json()["bound"] is None
    assert found.log_det == pytest.approx(exact.log_det, abs=1e-3)
    assert 0.99 < found.efficiency_lower_bound <= 1.0


def test_no_weights_is_a_job_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relaxation, "solve_program", lambda *_: (None, "solver_error", None))
    with pytest.raises(JobError, match=r"solver_error on 27 candidates.*column_generation"):
        relax(problem(FOUR), 3, "clarabel")


def test_weights_of_a_liar_are_judged_for_what_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Uniform weights called optimal: the gap and the bound come from the weights, so that nothing false is said."""
    uniform = (np.full(125, 3.0), "optimal", None)
    monkeypatch.setattr(relaxation, "solve_program", lambda *_: uniform)
    found = relax(problem(FOUR), 5, "clarabel")
    expected = 4.0 * np.log(np.sin(np.radians(80.0)))
    assert found.gap > 0.1
    assert found.bound is not None
    assert found.bound.value > expected
    assert found.efficiency_lower_bound <= np.exp((found.log_det - expected) / 8.0)


@pytest.mark.parametrize("solver", LARGEST)
def test_too_large_names_the_method_that_works(solver: str) -> None:
    with pytest.raises(InputError, match=f"{LARGEST[solver]}.*column_generation"):
        relax(problem(FOUR), 60, solver)
    assert relax(problem(FOUR), PostureList(np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (100, 4))), solver)


def test_bad_input() -> None:
    with pytest.raises(InputError, match="did you mean 'clarabel'"):
        relax(problem(FOUR), 3, "clarabell")
    with pytest.raises(InputError, match="Ds has no program"):
        relax(problem(FOUR, criterion=Ds((0,))), 3, "clarabel")
    with pytest.raises(InputError, match="at least 2"):
        relax(problem(FOUR), 1)
    with pytest.raises(InputError, match="candidates"):
        relax(problem(FOUR), np.full((3, 4), 4.0))
    with pytest.raises(JobError, match="identify"):
        relax(problem(FOUR), np.zeros((3, 4)), "scs")
