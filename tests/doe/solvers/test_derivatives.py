"""First and second derivatives of the criterion by the joint angles, against finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from doe.problem.problem import DesignProblem
from doe.solvers import Ipopt
from doe.solvers.ipopt import Climber
from doe.solvers.solver import Budget
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
    function = Climber(case, runs, Ipopt(), Budget(1))
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
