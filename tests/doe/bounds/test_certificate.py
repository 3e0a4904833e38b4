"""The equivalence theorem and its bounds, on designs whose optimality is known otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from doe.bounds import certificate as equivalence
from doe.bounds.certificate import (
    CERTIFIED,
    REACHED,
    CandidateJacobians,
    Certificate,
    certify,
    largest_sensitivity,
    last_pass,
)
from doe.bounds.planar_theorem import closed_form_log_det
from doe.problem.postures import PostureList
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from tests.doe.arms import ECCENTRICITY, FOUR, problem
from tests.doe.bounds.test_planar_theorem import factorial


def certificate(case: DesignProblem, postures: Array, candidates: Array) -> Certificate:
    """Of an exact plan, over designs on these candidates only."""
    information, prior = case.information(postures), case.prior.per_new_run(len(postures))
    gradient = case.criterion.gradient(information)
    return certify(case, information, largest_sensitivity(case, PostureList(candidates), gradient, prior))


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
    jacobians, gradient = case.scaled_jacobians(candidates), case.criterion.gradient(information)
    # by the definition: five new runs beside seven known
    largest = np.einsum("mdp,pq,mdq->m", jacobians, gradient, jacobians).max()
    known = sum(b.T @ b for b in case.scaled_jacobians(kept))
    fixed = float(np.sum(np.linalg.inv(information) * known))
    assert found.gap == pytest.approx((5.0 * largest + fixed) / 12.0 - case.parameters, rel=1e-9)
    assert certify(case, information, 100.0).bound > found.bound


def test_what_counts_as_optimal() -> None:
    assert (CERTIFIED, REACHED) == (0.999999, 0.999999999)


@pytest.mark.parametrize("smallest", [1.0, 0.0])
def test_sensitivities_of_candidates_are_traces(smallest: float) -> None:
    """Of a gradient that is definite (by its root) and of one that is singular, with a prior."""
    kept = np.random.default_rng(3).uniform(FOUR.lower, FOUR.upper, (7, 4))
    case = problem(FOUR, kept=kept)
    rotation = np.linalg.qr(np.random.default_rng(4).standard_normal((case.parameters,) * 2))[0]
    sizes = np.linspace(1.0, 2.0, case.parameters)
    sizes[0] = smallest
    gradient = rotation @ np.diag(sizes) @ rotation.T
    candidates = np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (30, 4))
    jacobians = CandidateJacobians(case, PostureList(candidates))
    found = np.concatenate([g for _, g in jacobians.sensitivities(gradient, case.prior.per_new_run(5))])
    known = sum(b.T @ b for b in case.scaled_jacobians(kept))  # 7 runs beside 5 new ones: M = (5 B^T B + known) / 12
    for value, b in zip(found, case.scaled_jacobians(candidates), strict=True):
        assert value == pytest.approx(np.trace(gradient @ (5.0 * b.T @ b + known)) / 12.0, rel=1e-12)


def test_a_pass_that_was_given_up_proves_nothing() -> None:
    """inf is no less than any sensitivity; the bound from it is the one that always holds."""
    case = problem(FOUR)
    postures = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (40, 4))
    information = case.information(postures)
    gradient = case.criterion.gradient(information)
    largest = largest_sensitivity(case, PostureList(postures), gradient, case.prior, give_up=lambda: True)
    assert largest == np.inf
    proven = certify(case, information, largest)
    assert (proven.gap, proven.bound, proven.efficiency) == (np.inf, np.inf, 0.0)
    assert proven.value == pytest.approx(np.linalg.slogdet(information)[1])


def test_how_long_a_last_pass_may_take(monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as the search before it, or `LAST` seconds if that is longer; for ever where time is not over."""
    clock = [100.0]
    monkeypatch.setattr(equivalence, "perf_counter", lambda: clock[0])
    short, long, free = (
        last_pass(lambda: True, 99.0),
        last_pass(lambda: True, 60.0),
        last_pass(lambda: False, 99.0),
    )
    for seconds, expected in ((1.9, (False, False)), (2.1, (True, False)), (39.9, (True, False)), (40.1, (True, True))):
        clock[0] = 100.0 + seconds
        assert (short(), long()) == expected
        assert not free()
