"""IPOPT: limits, stationarity of its ends, the same maximum as scipy from the same start."""

import signal
import threading
import time

import numpy as np
import pytest

from doe import DesignProblem, solve
from doe.solvers.ipopt import Climber
from doe.solvers.solver import Budget
from identification import InputError, Status
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem
from tests.doe.plan.test_ascent import KEPT, STEP


def test_ends_are_stationary_within_the_limits() -> None:
    case = problem(FIVE)
    generator = np.random.default_rng(0)
    climb = Climber(case, 7, Budget(1))
    joints = list(case.active_joints)
    for _ in range(5):
        start = generator.uniform(case.lower, case.upper, (7, 5))
        plan = climb(start)
        assert case.objective(plan) > case.objective(start)
        assert np.all(plan >= case.lower)
        assert np.all(plan <= case.upper)
        slope = climb.ascent.rise(plan)[1]
        assert np.abs(slope[(plan > case.lower)[:, joints] & (plan < case.upper)[:, joints]]).max() < 1e-6
        assert np.all(slope[plan[:, joints] == case.lower[joints]] < 1e-6)  # nothing to gain by moving in
        assert np.all(slope[plan[:, joints] == case.upper[joints]] > -1e-6)


def test_ctrl_c_inside_ipopt_returns_the_best_so_far() -> None:
    timer = threading.Timer(0.1, signal.raise_signal, [signal.SIGINT])

    def once_there_is_a_plan(done: float, total: float, message: str) -> None:
        if message.startswith("best") and not timer.ident:
            timer.start()

    design = solve(problem(FIVE), 41, "ipopt", starts=10**6, progress=once_there_is_a_plan)
    timer.join()
    assert design.status is Status.interrupted
    assert np.isfinite(design.value)


def test_ctrl_c_during_the_first_start_returns_what_there_is() -> None:
    climb = Climber(problem(FIVE), 41, Budget(1))
    start = np.random.default_rng(0).uniform(FIVE.lower, FIVE.upper, (41, 5))
    ends = climb(start)
    calls = iter(range(10**6))
    rise = climb.rise

    def interrupted_in_step_three(point: bytes) -> tuple:
        if next(calls) == 9:
            signal.raise_signal(signal.SIGINT)
            for _ in range(1000):  # the main thread notes it when it wakes
                if climb.interrupted:
                    break
                time.sleep(0.01)
        return rise(point)

    climb.rise = interrupted_in_step_three
    so_far = climb(start)
    before, between, after = (problem(FIVE).objective(each) for each in (start, so_far, ends))
    assert before - 1e-9 <= between < after  # rounding: the first points may be the start
    assert climb.interrupted


def test_time_limit_inside_ipopt() -> None:
    design = solve(problem(FIVE), 40, "ipopt", starts=10**6, seconds=0.1)
    assert design.status is Status.time_limit
    assert np.isfinite(design.value)


def test_more_variables_than_dense_second_derivatives_allow() -> None:
    with pytest.raises(InputError, match="runs: 100000 postures are 300000 variables for ipopt, allowed: at most 5000"):
        solve(problem(FOUR), 100_000, "ipopt", starts=1, seconds=1.0)


# -- derivatives -------------------------------------------------------------------------------------------------------
CASES = {
    "base": problem(FIVE),
    "base offset and an effect": problem(FOUR, OFFSET, ECCENTRICITY),
    "around measured postures": problem(FOUR, kept=KEPT),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_against_finite_differences(case: DesignProblem) -> None:
    runs = case.fewest_runs + 2
    plan = np.random.default_rng(0).uniform(case.lower, case.upper, (runs, case.joints))
    function = Climber(case, runs, Budget(1))
    (value, gradient), hessian = function.ascent.rise(plan), function.hessian(plan)
    assert value == pytest.approx(case.objective(plan), rel=1e-12)
    slopes, curvatures = [], []
    for run in range(runs):
        for joint in case.active_joints:
            step = np.zeros_like(plan)
            step[run, joint] = STEP
            slopes.append((case.objective(plan + step) - case.objective(plan - step)) / (2 * STEP))
            ends = [function.ascent.rise(plan + sign * step)[1].ravel() for sign in (1, -1)]
            curvatures.append((ends[0] - ends[1]) / (2 * STEP))
    np.testing.assert_allclose(gradient.ravel(), slopes, rtol=1e-6, atol=1e-8 * np.abs(slopes).max())
    np.testing.assert_allclose(hessian, curvatures, rtol=1e-6, atol=1e-8 * np.abs(curvatures).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())
