"""Plans that climb together: slopes by finite differences, ends where nothing gains, and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from doe.criteria import A, E
from doe.plan.ascent import PlanAscent, climbs
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem
from tests.doe.six_axis import LIMITED, SIX_AXIS, six_axis

STEP = 1e-5  # central differences: truncation and rounding about 1e-10, relative
KEPT = np.random.default_rng(8).uniform(FOUR.lower, FOUR.upper, (3, 4))
CASES = {
    "base": problem(FIVE),
    "an effect": problem(FOUR, OFFSET, ECCENTRICITY),
    "around measured postures, A": problem(FOUR, kept=KEPT, criterion=A()),
    "smooth E": problem(FOUR, criterion=E()),
    "six axes with a prior": six_axis(LIMITED),
}


def random_plans(case: DesignProblem, plans: int, runs: int) -> Array:
    return np.random.default_rng(0).uniform(case.lower, case.upper, (plans, runs, case.joints))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_slopes_by_finite_differences(case: DesignProblem) -> None:
    plans = random_plans(case, 2, case.fewest_runs + 3)
    ascent = PlanAscent(case)
    values, slopes = ascent.rise(plans)
    if case.criterion.name != "E":
        np.testing.assert_allclose(values, [case.objective(plan) for plan in plans], rtol=1e-9)
    scale = np.abs(slopes).max()
    for run, (k, joint) in ((0, (0, case.searched_joints[0])), (2, (len(case.searched_joints) - 1, case.joints - 1))):
        step = np.zeros_like(plans)
        step[:, run, joint] = STEP
        differences = (ascent.rise(plans + step)[0] - ascent.rise(plans - step)[0]) / (2 * STEP)
        np.testing.assert_allclose(slopes[:, run, k], differences, rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize("arm", [SIX_AXIS, LIMITED], ids=["free", "limited"])
def test_plans_end_where_no_joint_gains_anything(arm) -> None:  # type: ignore[no-untyped-def]
    """Where there is room for 0.1 rad the slope is nothing beside that of the start; the limits are kept."""
    case = six_axis(arm)
    start, ascent = random_plans(case, 3, 12), PlanAscent(case)
    ended = ascent(start, tolerance=1e-13)
    assert np.all((ended >= case.lower) & (ended <= case.upper))
    values, slopes = ascent.rise(ended)
    assert np.all(values > ascent.rise(start)[0] + 1.0)
    room = np.minimum(np.where(slopes > 0.0, case.upper - ended, ended - case.lower), 0.1)
    assert np.abs(slopes * room).max() < 1e-3 * 0.1 * np.abs(ascent.rise(start)[1]).max()


def test_as_good_as_scipy() -> None:
    """One plan of ten runs from the same start: both end at a local optimum, of which there are many."""
    case = six_axis(LIMITED)
    start, ascent = random_plans(case, 1, 10), PlanAscent(case)

    def fall(x: Array) -> tuple[float, Array]:
        value, slope = ascent.rise(x.reshape(1, 10, 6))
        return -float(value[0]), -slope.ravel()

    limits = list(zip(np.tile(case.lower, 10), np.tile(case.upper, 10), strict=True))
    other = minimize(fall, start.ravel(), jac=True, method="L-BFGS-B", bounds=limits)
    began, ended = case.objective(start[0]), case.objective(ascent(start)[0])
    assert ended - began > 0.9 * (-other.fun - began)


def test_plans_that_stand_for_fewer_runs() -> None:
    """Weights are equal: the value is that of the mixture, with the prior of so many runs."""
    case = six_axis()
    plan = random_plans(case, 1, 40)
    value = PlanAscent(case, runs=12).rise(plan)[0][0]
    mixture = case.prior.per_new_run(12).mixture(case.scaled_jacobians(plan[0]), np.full(40, 1 / 40))
    assert value == pytest.approx(float(case.criterion.value(mixture)), rel=1e-12)


def test_without_time_plans_stay_as_they_are() -> None:
    case = problem(FOUR)
    start = random_plans(case, 1, 6)
    np.testing.assert_allclose(PlanAscent(case)(start, stop=lambda: True), start)


def test_singular_plans_have_no_slope_and_do_not_get_worse() -> None:
    """Stretched out, the arm's four lengths have equal columns, without rounding; at six equal postures the last digit
    decides whether M is singular, so that the plan may climb."""
    case = problem(FOUR)
    values, slopes = PlanAscent(case).rise(np.zeros((1, 6, 4)))
    assert values[0] == -np.inf
    np.testing.assert_array_equal(slopes, 0.0)
    same = np.tile(FOUR.upper / 3.0, (1, 6, 1))
    ended = PlanAscent(case)(same)
    assert np.all((ended >= FOUR.lower - 1e-12) & (ended <= FOUR.upper + 1e-12))
    before, after = (PlanAscent(case).rise(plans)[0][0] for plans in (same, ended))
    assert after >= before


def test_where_gradients_are_the_choice() -> None:
    assert climbs(six_axis())
    assert not climbs(problem(FOUR))
    walls = DesignProblem.of(six_axis().model, deviations={})  # type: ignore[arg-type]
    assert climbs(walls)
