"""First and second derivatives of the criterion by the joint angles, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from doe.problem.problem import DesignProblem
from doe.solvers.ipopt import PlanFunction
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, OFFSET, problem

STEP = 1e-5  # central differences: truncation about 1e-10, rounding 1e-16 / 1e-5 = 1e-11, relative
KEPT = np.random.default_rng(8).uniform(FOUR.lower, FOUR.upper, (3, 4))

CASES = {
    "base": problem(FIVE),
    "base offset and an effect": problem(FOUR, OFFSET, ECCENTRICITY),
    "around measured postures": problem(FOUR, kept=KEPT),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_against_finite_differences(case: DesignProblem) -> None:
    runs = case.fewest_runs + 2
    plan = np.random.default_rng(0).uniform(case.lower, case.upper, (runs, case.joints))
    function = PlanFunction(case, case.active_joints)
    value, gradient, hessian = function.expand(plan)
    assert value == pytest.approx(case.objective(plan), rel=1e-12)
    slopes, curvatures = [], []
    for run in range(runs):
        for joint in case.active_joints:
            step = np.zeros_like(plan)
            step[run, joint] = STEP
            slopes.append((case.objective(plan + step) - case.objective(plan - step)) / (2 * STEP))
            curvatures.append((function.expand(plan + step)[1] - function.expand(plan - step)[1]) / (2 * STEP))
    np.testing.assert_allclose(gradient, slopes, rtol=1e-6, atol=1e-8 * np.abs(slopes).max())
    np.testing.assert_allclose(hessian, curvatures, rtol=1e-6, atol=1e-8 * np.abs(curvatures).max())
    np.testing.assert_allclose(hessian, hessian.T, atol=1e-12 * np.abs(hessian).max())


def test_joints_that_play_no_part_have_no_derivative() -> None:
    case = problem(FOUR)
    plan = np.random.default_rng(1).uniform(case.lower, case.upper, (6, 4))
    _, gradient, hessian = PlanFunction(case, (0,)).expand(plan)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-13)
    np.testing.assert_allclose(hessian, 0.0, atol=1e-12)
    assert case.active_joints == (1, 2, 3)
