"""The equivalence theorem and its bounds, on designs whose optimality is known otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds.equivalence import Certificate, certify, largest_sensitivity, sensitivity
from doe.bounds.planar_theorem import closed_form_log_det
from doe.problem.candidates import PostureList
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem
from tests.doe.bounds.test_planar_theorem import factorial


def certificate(case: DesignProblem, postures: Array, candidates: Array) -> Certificate:
    """Of an exact plan, over designs on these candidates only."""
    information, prior = case.information(postures), case.prior.per_new_run(len(postures))
    gradient = case.criterion.gradient(information)
    return certify(case, information, largest_sensitivity(case, PostureList(candidates), gradient, prior))


def test_sensitivity_is_the_trace() -> None:
    case = problem(FOUR, OFFSET)
    generator = np.random.default_rng(0)
    plan = generator.uniform(FOUR.lower, FOUR.upper, (12, 4))
    information = case.information(plan)
    found = sensitivity(case, information, plan)
    for value, jacobian in zip(found, case.model.jacobian(plan) / case.model.scales, strict=True):
        assert value == pytest.approx(np.trace(np.linalg.solve(information, jacobian.T @ jacobian)))
    assert np.mean(found) == pytest.approx(case.parameters)  # sum_i w_i d_i = tr(M^-1 M) = p for every design


def test_gap_is_zero_at_the_optimum() -> None:
    case = problem(FOUR)
    candidates = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (5000, 4))
    assert certificate(case, factorial(FOUR, offset=False), candidates).gap <= 1e-12  # d <= p everywhere
    at_support = np.vstack([candidates, factorial(FOUR, offset=False)])
    found = certificate(case, factorial(FOUR, offset=False), at_support)
    assert found.gap == pytest.approx(0.0, abs=1e-12)
    assert found.bound == pytest.approx(closed_form_log_det(case), abs=1e-12)
    assert found.value == pytest.approx(closed_form_log_det(case), abs=1e-12)
    assert found.efficiency == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_bound_of_any_design_holds_for_every_other(seed: int) -> None:
    generator = np.random.default_rng(seed)
    case = problem(FOUR, ECCENTRICITY)
    candidates = generator.uniform(FOUR.lower, FOUR.upper, (60, 4))
    bound = certificate(case, candidates[:10], candidates).bound
    for _ in range(200):
        assert case.objective(candidates[generator.integers(60, size=10)]) <= bound
        weights = generator.dirichlet(np.full(60, 0.2))
        assert case.objective(candidates, weights) <= bound


@pytest.mark.parametrize("seed", range(3))
def test_bound_with_measured_postures(seed: int) -> None:
    generator = np.random.default_rng(seed)
    kept = generator.uniform(FOUR.lower, FOUR.upper, (7, 4))
    case = problem(FOUR, kept=kept)
    candidates = generator.uniform(FOUR.lower, FOUR.upper, (40, 4))
    plan = candidates[:5]
    found = certificate(case, plan, candidates)
    assert found.gap >= 0.0
    values = [case.objective(candidates[generator.integers(40, size=5)]) for _ in range(500)]
    assert max(values) <= found.bound
    information = case.information(plan)
    largest = sensitivity(case, information, candidates).max()  # by the definition: five new runs beside seven known
    known = sum(b.T @ b for b in case.scaled_jacobians(kept))
    fixed = float(np.sum(np.linalg.inv(information) * known))
    assert found.gap == pytest.approx((5.0 * largest + fixed) / 12.0 - case.parameters, rel=1e-9)
    assert certify(case, information, 100.0).bound > found.bound
