"""The closed-form optimum, against complex arithmetic, the factorial that attains it, and rivals of it; and plans from
theory, which attain it: checked by complex arithmetic, limits by comparison."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import DesignProblem
from doe.bounds.planar_theorem import closed_form_bound, pair_means, table_1_max_residual
from doe.solvers import solve
from identification import Arm, Calibration, EffectSpec, JobError, Status
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, SIX, problem, random_box
from tests.doe.plan.test_plan import smallest_gap

ROUNDING = 1e-9  # log det of well-conditioned matrices of at most 14 rows, condition below 1e6


def complex_log_det(postures: np.ndarray, *, offset: bool = False) -> float:
    """2 log det H from complex exponentials, without the project's code (doe/README.md, "Information matrix")."""
    columns = np.exp(1j * np.cumsum(postures, axis=1))
    if offset:
        columns = np.hstack([np.ones((len(columns), 1)), columns])
    return 2.0 * float(np.linalg.slogdet(columns.conj().T @ columns / len(columns))[1])


def factorial(arm: Arm, *, offset: bool) -> np.ndarray:
    """Two angles per joint in all combinations: the limits, or a pair pi apart where the range allows."""
    levels = []
    for j, (low, high) in enumerate(zip(arm.lower, arm.upper, strict=True)):
        middle, half = (low + high) / 2, min((high - low) / 2, np.pi / 2)
        levels.append((middle - half, middle + half) if j or offset else (middle,))
    return np.array(list(product(*levels)))


@pytest.mark.parametrize("offset", [False, True])
@pytest.mark.parametrize("links", [1, 2, 3, 4, 5, 6])
def test_factorial_at_the_limits_attains_it(links: int, offset: bool) -> None:
    generator = np.random.default_rng([links, offset])
    for _ in range(3):
        arm = random_box(generator, links)
        case = problem(arm, *([OFFSET] if offset else []))
        plan = factorial(arm, offset=offset)
        assert case.objective(plan) == pytest.approx(complex_log_det(plan, offset=offset), abs=ROUNDING)
        assert closed_form_bound(case).value == pytest.approx(complex_log_det(plan, offset=offset), abs=ROUNDING)


@settings(max_examples=60)
@given(st.integers(2, 6), st.booleans(), st.integers(0, 2**32 - 1))
def test_no_design_is_better(links: int, offset: bool, seed: int) -> None:
    generator = np.random.default_rng(seed)
    arm = random_box(generator, links)
    bound = closed_form_bound(problem(arm, *([OFFSET] if offset else []))).value
    levels = [arm.lower, arm.upper, (arm.lower + arm.upper) / 2]
    at_limits = np.choose(generator.integers(0, 2, (64, links)), levels[:2])
    anywhere = generator.uniform(arm.lower, arm.upper, (64, links))
    for plan in (at_limits, anywhere, np.vstack([at_limits, anywhere[:8]])):
        assert complex_log_det(plan, offset=offset) <= bound + ROUNDING


@pytest.mark.parametrize("errors", [[5.0, -3.0, 2.0, 1.0], [10.0] * 4, [-520.0, 90.0, -60.0, 0.0]])
def test_log_det_does_not_depend_on_lengths_calibrated_or_not(errors: list[float]) -> None:
    """log det M' of the base model is 2 log det H <= 0 whatever the lengths (doe/README.md, "Information matrix").

    The third case turns link 1 round: its length is -260 mm.
    """
    calibration = Calibration.of(np.array(errors), np.array([0.02, -0.01, 0.03, 0.01]))
    arm = Arm(FOUR.lengths, FOUR.lower, FOUR.upper, calibration=calibration)
    assert closed_form_bound(problem(arm)).value == pytest.approx(-0.0612353259, abs=5e-11)  # the box of doe/README.md
    anywhere = np.random.default_rng(4).uniform(FOUR.lower, FOUR.upper, (9, 4))
    for plan in (factorial(arm, offset=False), anywhere):
        assert problem(arm).objective(plan) == pytest.approx(complex_log_det(plan), abs=ROUNDING)
    for plan in (factorial(arm, offset=True), anywhere):
        assert problem(arm, OFFSET).objective(plan) == pytest.approx(complex_log_det(plan, offset=True), abs=ROUNDING)


def test_says_where_it_does_not_apply() -> None:
    fixed = EffectSpec("base_offset", values={"x0": 1.0, "y0": 2.0})
    for case in (problem(FOUR, ECCENTRICITY), problem(FOUR, fixed), problem(FOUR, kept=np.zeros((3, 4)))):
        assert closed_form_bound(case) is None


def test_table_1_is_the_corrected_row_of_the_paper() -> None:
    plan = np.random.default_rng(3).uniform(-2, 2, (7, 4))
    q2, q3, q4 = plan.T[1:]
    angles = {"q2": q2, "q3": q3, "q4": q4, "q2+q3": q2 + q3, "q3+q4": q3 + q4, "q2+q3+q4": q2 + q3 + q4}
    found = pair_means(plan)
    assert found.keys() == angles.keys()
    for name, angle in angles.items():
        assert found[name] == pytest.approx(np.mean(np.cos(angle)) + 1j * np.mean(np.sin(angle)), abs=1e-14)
    assert table_1_max_residual(plan) == pytest.approx(max(abs(np.mean(np.exp(1j * a))) for a in angles.values()))
    assert table_1_max_residual(plan[:, :1]) == 0.0  # of one link there are none


# -- plans from theory -------------------------------------------------------------------------------------------------
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
