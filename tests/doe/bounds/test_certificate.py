"""The equivalence theorem and its bounds, on designs whose optimality is known otherwise; what is recomputed, and what
is not believed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from doe import DesignProblem
from doe.bounds.certificate import ApproximateDesign
from doe.bounds.column_generation import CandidateSet
from identification import Array, Plan, Status
from tests.doe.arms import FOUR, problem

FACTORIAL = Plan(np.radians([[0, a, b, c] for a in (-90, 90) for b in (-90, 60) for c in (-90, 90)]), np.full(8, 0.125))
AXES = [np.linspace(a, b, 5) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
GRID = np.stack([np.zeros(125), *(a.ravel() for a in np.meshgrid(*AXES))], axis=1)


def judged(case: DesignProblem, plan: Plan, candidates: Array, status: Status = Status.converged) -> ApproximateDesign:
    """Over designs on these candidates only."""
    prior = case.prior.per_new_run(len(plan))
    gradient = case.criterion.gradient(case.information(plan.postures, plan.weights))
    largest = float(CandidateSet(case, candidates, prior).sensitivities(gradient).max())
    return ApproximateDesign(case, prior, plan, None, largest, len(candidates), True, status, "done", "by hand", 0.5)


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
    found = CandidateSet(case, candidates, case.prior.per_new_run(5)).sensitivities(gradient)
    known = sum(b.T @ b for b in case.scaled_jacobians(kept))  # 7 runs beside 5 new ones: M = (5 B^T B + known) / 12
    for value, b in zip(found, case.scaled_jacobians(candidates), strict=True):
        assert value == pytest.approx(np.trace(gradient @ (5.0 * b.T @ b + known)) / 12.0, rel=1e-12)


def test_a_pass_that_was_given_up_proves_nothing() -> None:
    """inf is no less than any sensitivity; the bound from it is the one that always holds."""
    case, plan = problem(FOUR), Plan(np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (40, 4)))
    gradient = case.criterion.gradient(case.information(plan.postures))
    given_up = CandidateSet(case, plan.postures, case.prior).sensitivities(gradient, lambda: True)
    found = ApproximateDesign(case, case.prior, plan).certified(given_up.max(), 1e-6, cut=True)
    assert (found.gap, found.upper, found.efficiency_lower_bound, found.bound) == (np.inf, np.inf, 0.0, None)
    assert found.solver_status == "no bound: no time to visit every candidate"
    assert found.value == pytest.approx(np.linalg.slogdet(case.information(plan.postures))[1])


@pytest.mark.parametrize("status", Status)
def test_a_bound_only_where_solved_or_cut_by_time(status: Status) -> None:
    found = judged(problem(FOUR), FACTORIAL, GRID, status)
    data = found.to_json()
    assert data["status"] == status.name
    if status not in (Status.converged, Status.time_limit):
        assert found.bound is data["bound"] is None
        return
    assert found.bound.cut == (status is Status.time_limit)
    assert found.bound.value == found.upper
    assert json.loads(json.dumps(data)) == data
    assert data["support"][3] == {"posture_deg": pytest.approx([0.0, -90.0, 60.0, 90.0]), "weight": 0.125}
