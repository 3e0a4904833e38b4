"""Every criterion solved: below the bound that column generation proves, above rivals that know the answer."""

from __future__ import annotations

import numpy as np
import pytest

from doe.criteria import A, Criterion, Ds, DStar, E, I
from doe.solvers import solve
from identification.arm import Arm
from tests.doe.arms import FOUR, problem

SEARCHED = 1e-7  # plans whose values differ by less are the same to the solver (`AGREES` in doe/solvers/solving.py)
POSES = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (20, 4))
CASES = {
    "A": A(), "I": I(problem(FOUR).scaled_jacobians(POSES)), "Ds": Ds((0, 1, 2, 3)),
    "Dstar": DStar(((0, 1, 2, 3), (4, 5, 6, 7))),
}  # fmt: skip


@pytest.mark.parametrize("criterion", CASES.values(), ids=CASES)
def test_twenty_runs_are_near_the_bound(criterion: Criterion) -> None:
    """With m = 20 >> p exact plans are within a percent of the approximate optimum, and above a D-optimal plan."""
    case = problem(FOUR, criterion=criterion)
    design = solve(case, 20, starts=10)
    assert design.bound is not None
    assert design.bound.source == "continuous"
    assert design.value <= design.bound.value + 1e-8
    assert design.efficiency is not None
    assert design.efficiency >= 0.99
    other = solve(problem(FOUR), 20)  # D-optimal, by theory
    assert design.value >= case.objective(other.plan.postures) - SEARCHED


def test_e_is_better_than_plans_for_other_criteria() -> None:
    case = problem(FOUR, criterion=E())
    design = solve(case, 10, starts=10)
    for rival in (problem(FOUR), problem(FOUR, criterion=A())):
        other = solve(rival, 10, starts=10).plan.postures
        assert design.value >= case.objective(other) - SEARCHED
    generator = np.random.default_rng(1)
    rows = design.plan.postures
    for _ in range(500):  # no small change of any posture helps
        moved = case.clip(rows + 1e-3 * generator.standard_normal(rows.shape))
        assert case.objective(moved) <= design.value + 1e-6


def test_single_link() -> None:
    """Of a single link M' is the identity, whatever the posture."""
    arm = Arm([100.0])
    for criterion, value in ((A(), -2.0), (E(), 1.0)):
        assert solve(problem(arm, criterion=criterion), 3).value == pytest.approx(value, abs=1e-9)


def test_the_papers_criterion_leaves_accuracy_behind() -> None:
    """D* is reached (its bound is zero) by plans that are poor for D: the length-angle block S' is not looked at."""
    case = problem(FOUR, criterion=DStar(((0, 1, 2, 3), (4, 5, 6, 7))))
    found = [solve(case, 12, starts=25, seed=seed) for seed in range(2)]  # one such plan or another, by the last digit
    assert [design.value for design in found] == pytest.approx([0.0] * 2, abs=1e-6)
    assert min(design.log_det for design in found) < -0.5  # against -0.0612 that the D-optimal plan has
