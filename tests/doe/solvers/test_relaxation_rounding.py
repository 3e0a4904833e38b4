"""Relaxation + rounding + polish as one more exact solver."""

from __future__ import annotations

import numpy as np

from doe.bounds.planar_theorem import closed_form_log_det
from doe.solvers import solve
from tests.doe.arms import FIVE, FOUR, problem


def test_reaches_known_optima() -> None:
    """Sixteen runs: the relaxation's factorial, rounded, is optimal at once; eleven: near the best known."""
    design = solve(problem(FIVE), 16, "relaxation_rounding")
    assert design.value > closed_form_log_det(problem(FIVE)) - 1e-6
    assert solve(problem(FOUR), 10, "relaxation_rounding").value > -0.1445  # -0.14288 is the best known


def test_a_rounded_plan_has_the_runs_asked_for() -> None:
    design = solve(problem(FIVE), 9, "relaxation_rounding", starts=3)
    assert len(design.plan) == 9
    assert np.all((design.plan.postures >= FIVE.lower) & (design.plan.postures <= FIVE.upper))


def test_long_plans_are_not_polished() -> None:
    """600 runs: IPOPT would need a dense matrix of 1,800 x 1,800 second derivatives for each step."""
    four = problem(FOUR)
    found = solve(four, 600, "relaxation_rounding", starts=2, seconds=20.0)
    assert found.value <= found.bound.value + 1e-9
    assert found.value >= found.bound.value - 1e-3
