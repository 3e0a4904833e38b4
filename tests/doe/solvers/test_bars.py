"""Best values known of exact designs (doe/README.md, "Exact plans"); times are in `tests/benchmarks`."""

from __future__ import annotations

import numpy as np
import pytest

from doe import solve
from doe.criteria import A, Criterion, Ds, DStar, E, I
from identification import Arm
from tests.doe.arms import FIVE, FOUR, SIX, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det


@pytest.mark.parametrize("runs", [4, 12, 20])
def test_four_links_where_the_bound_is_attained(runs: int) -> None:
    design = solve(problem(FOUR), runs)
    assert complex_log_det(design.plan.postures) == pytest.approx(-0.0612353259, abs=1e-9)
    assert design.certified_optimal


KNOWN = [
    (FOUR, 5, -0.28087), (FOUR, 6, -0.29680), (FOUR, 7, -0.19865), (FOUR, 9, -0.13103), (FOUR, 10, -0.14288),
    (FOUR, 14, -0.10247), (FOUR, 18, -0.08608), (FIVE, 5, -1.358410), (FIVE, 8, -0.704661), (FIVE, 11, -0.830502),
    (FIVE, 16, -0.704178), (SIX, 12, -1.433950), (SIX, 20, -1.3515), (SIX, 32, -1.2994579),
]  # fmt: skip
WITHIN_A_SECOND = {(4, 9), (4, 14), (6, 32)}  # links, runs


@pytest.mark.parametrize(
    ("arm", "runs", "value"),
    [pytest.param(*row, marks=() if (row[0].links, row[1]) in WITHIN_A_SECOND else pytest.mark.slow) for row in KNOWN],
)
def test_best_known_values(arm: Arm, runs: int, value: float) -> None:
    """At least the best value known, to the digits it is printed with (doe/README.md, "Exact plans").

    Fewer starts than the default find it or not by the last digit of a processor: no test asks for it.
    """
    digits = 1e-5 if arm is FOUR else 1e-6
    assert complex_log_det(solve(problem(arm), runs).plan.postures) >= value - digits


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_six_links_eight_runs(seed: int) -> None:
    """The hardest of the table: few of the starts lead there."""
    assert complex_log_det(solve(problem(SIX), 8, seed=seed).plan.postures) >= -1.624468


# -- other criteria ----------------------------------------------------------------------------------------------------
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
    design = solve(case, 20, starts=5)
    assert design.bound.source == "continuous"
    assert design.value <= design.bound.value + 1e-8
    assert design.efficiency >= 0.99
    other = solve(problem(FOUR), 20)  # D-optimal, by theory
    assert design.value >= case.objective(other.plan.postures) - SEARCHED


def test_e_is_better_than_plans_for_other_criteria() -> None:
    case = problem(FOUR, criterion=E())
    design = solve(case, 10, starts=5)
    for rival in (problem(FOUR), problem(FOUR, criterion=A())):
        other = solve(rival, 10, starts=4).plan.postures
        assert design.value >= case.objective(other) - SEARCHED
    generator = np.random.default_rng(1)
    rows = design.plan.postures
    for _ in range(500):  # no small change of any posture helps
        moved = case.clip(rows + 1e-3 * generator.standard_normal(rows.shape))
        assert case.objective(moved) <= design.value + 1e-6


def test_the_papers_criterion_leaves_accuracy_behind() -> None:
    """D* is reached (its bound is zero) by plans that are poor for D: the length-angle block S' is not looked at."""
    case = problem(FOUR, criterion=DStar(((0, 1, 2, 3), (4, 5, 6, 7))))
    found = [solve(case, 12, starts=25)]  # one such plan or another, by the last digit
    assert [design.value for design in found] == pytest.approx([0.0], abs=1e-6)
    assert min(design.log_det for design in found) < -0.5  # against -0.0612 that the D-optimal plan has


def test_the_papers_criterion_within_narrow_limits() -> None:
    """Of the base model D* = 2 log det Re H. Its best weights are here on two postures, which determine 4 of the 6
    parameters, and M is singular: the bound holds for all weights, and plans of 7 runs come near it."""
    narrow = Arm([260.0, 180.0, 120.0], np.radians([-100, -60, -30]), np.radians([100, 80, 75]))
    design, generator = solve(problem(narrow, criterion=DStar(((0, 1, 2), (3, 4, 5)))), 7), np.random.default_rng(0)
    assert 0.95 < design.efficiency <= 1.0
    for count in generator.integers(3, 9, 3000):
        unit = np.exp(1j * np.cumsum(generator.uniform(narrow.lower, narrow.upper, (count, 3)), axis=1))
        real = ((unit.conj().T * generator.dirichlet(np.full(count, 0.5))) @ unit).real
        assert 2.0 * np.linalg.slogdet(real)[1] <= design.bound.value
