"""Plans that climb: slopes by finite differences, ends where nothing gains, feasible ends, and against scipy."""

import numpy as np
import pytest

from doe import DesignProblem
from doe.criteria import A, E
from doe.plan.ascent import PlanAscent
from doe.problem.problem import random_postures
from identification import Array
from tests.doe.arms import FOUR, problem
from tests.doe.problem.test_spatial_constraints import ARM
from tests.doe.six_axis import LIMITED, SIX_AXIS, six_axis

STEP = 1e-5  # central differences: truncation and rounding about 1e-10, relative
KEPT = np.random.default_rng(8).uniform(FOUR.lower, FOUR.upper, (3, 4))
WALLS = six_axis(ARM)  # box, sphere, pillar and line of sight
CASES = {
    "around measured postures, A": problem(FOUR, kept=KEPT, criterion=A()),
    "smooth E": problem(FOUR, criterion=E()),
    "six axes with a prior": six_axis(LIMITED),
}


def random_plan(case: DesignProblem, runs: int, seed: int = 0) -> Array:
    return random_postures(case, runs, np.random.default_rng(seed))


def differences(ascent: PlanAscent, plan: Array, run: int, joint: int, size: float) -> float:
    step = np.zeros_like(plan)
    step[run, joint] = size
    return (ascent.rise(plan + step)[0] - ascent.rise(plan - step)[0]) / (2 * size)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_slopes_by_finite_differences(case: DesignProblem) -> None:
    plan, ascent = random_plan(case, case.fewest_runs + 3), PlanAscent(case)
    value, slopes = ascent.rise(plan)
    if case.criterion.name != "E":
        assert value == pytest.approx(case.objective(plan), rel=1e-9)
    for run, k, joint in ((0, 0, case.searched_joints[0]), (2, len(case.searched_joints) - 1, case.joints - 1)):
        expected = differences(ascent, plan, run, joint, STEP)
        assert slopes[run, k] == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(slopes).max())


def test_slopes_of_the_penalty_by_finite_differences() -> None:
    climb = PlanAscent(WALLS)
    climb.firmness = 30.0
    plan = np.random.default_rng(3).uniform(WALLS.lower, WALLS.upper, (12, 6))  # most of it outside
    value, slopes = climb.rise(plan)
    assert value < WALLS.objective(plan) - 1.0
    for run, joint in ((0, 1), (5, 4), (11, 5)):
        expected = differences(climb, plan, run, joint, 0.1 * STEP)
        assert slopes[run, joint] == pytest.approx(expected, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("arm", [SIX_AXIS, LIMITED], ids=["free", "limited"])
def test_plans_end_where_no_joint_gains_anything(arm) -> None:  # type: ignore[no-untyped-def]
    """Where there is room for 0.1 rad the slope is nothing beside that of the start; the limits are kept."""
    case = six_axis(arm)
    ascent = PlanAscent(case)
    for start in (random_plan(case, 12, seed) for seed in range(3)):
        ended = ascent(start, tolerance=1e-13)
        assert np.all((ended >= case.lower) & (ended <= case.upper))
        value, slopes = ascent.rise(ended)
        assert value > ascent.rise(start)[0] + 1.0
        room = np.minimum(np.where(slopes > 0.0, case.upper - ended, ended - case.lower), 0.1)
        assert np.abs(slopes * room).max() < 1e-3 * 0.1 * np.abs(ascent.rise(start)[1]).max()


def test_plans_that_stand_for_fewer_runs() -> None:
    """Weights are equal: the value is that of the mixture, with the prior of so many runs."""
    case = six_axis()
    plan = random_plan(case, 40)
    mixture = case.prior.per_new_run(12).mixture(case.scaled_jacobians(plan), np.full(40, 1 / 40))
    assert PlanAscent(case, runs=12).rise(plan)[0] == pytest.approx(float(case.criterion.value(mixture)), rel=1e-12)


def test_singular_plans_have_no_slope_and_do_not_get_worse() -> None:
    """Stretched out, the arm's four lengths have equal columns, without rounding; at six equal postures the last digit
    decides whether M is singular, so that the plan may climb."""
    case = problem(FOUR)
    value, slopes = PlanAscent(case).rise(np.zeros((6, 4)))
    assert value == -np.inf
    np.testing.assert_array_equal(slopes, 0.0)
    same = np.tile(FOUR.upper / 3.0, (6, 1))
    ended = PlanAscent(case)(same)
    assert np.all((ended >= FOUR.lower - 1e-12) & (ended <= FOUR.upper + 1e-12))
    before, after = (PlanAscent(case).rise(plan)[0] for plan in (same, ended))
    assert after >= before
