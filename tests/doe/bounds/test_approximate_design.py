"""Approximate designs: what is recomputed, and what is not believed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from doe.bounds.certificate import ApproximateDesign, largest_sensitivity
from doe.plan.plan import Plan
from doe.problem.postures import grid
from doe.problem.problem import PriorInformation
from identification.running import Status
from tests.doe.arms import FOUR, problem

FACTORIAL = Plan(np.radians([[0, a, b, c] for a in (-90, 90) for b in (-90, 60) for c in (-90, 90)]), np.full(8, 0.125))


def judged(plan: Plan, status: Status = Status.converged):  # type: ignore[no-untyped-def]
    case = problem(FOUR)
    candidates = grid(case, 5)
    largest = largest_sensitivity(
        case, candidates, np.linalg.inv(case.information(plan.postures, plan.shares)), PriorInformation()
    )
    return ApproximateDesign(
        case, PriorInformation(), plan, None, largest, len(candidates), True, status, "done", "by hand", 0.5
    )


def test_certificate_of_any_weights() -> None:
    """gap = max d - p, efficiency >= p / max d, bound = log det M + p log(max d / p).

    doe/README.md, "Equivalence theorem".
    """
    case, found = problem(FOUR), judged(FACTORIAL)
    information = case.information(FACTORIAL.postures, FACTORIAL.weights)
    axes = [np.linspace(a, b, 5) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    q = np.stack([np.zeros(125), *(a.ravel() for a in np.meshgrid(*axes))], axis=1)
    d = np.array([np.trace(np.linalg.solve(information, b.T @ b)) for b in case.scaled_jacobians(q)])
    assert found.log_det == pytest.approx(np.linalg.slogdet(information)[1], abs=1e-12)
    assert found.gap == pytest.approx(d.max() - 8.0, abs=1e-10)
    assert found.efficiency_lower_bound == pytest.approx(8.0 / d.max(), abs=1e-12)
    assert found.bound is not None
    assert found.bound.value == pytest.approx(found.log_det + 8.0 * np.log(d.max() / 8.0), abs=1e-10)
    assert found.bound.source == "grid"
    assert found.bound.value >= 4.0 * np.log(np.sin(np.radians(80.0)))  # the optimum is on this grid


@pytest.mark.parametrize("status", [s for s in Status if s not in (Status.converged, Status.time_limit)])
def test_no_bound_unless_solved(status: Status) -> None:
    found = judged(FACTORIAL, status)
    assert found.bound is None
    assert found.to_json()["bound"] is None
    assert found.to_json()["status"] == status.name
    assert found.gap > 0.0


def test_contract_keys() -> None:
    data = judged(FACTORIAL).to_json()
    assert json.loads(json.dumps(data)) == data
    keys = {"candidates", "log_det", "bound", "gap", "efficiency_lower_bound", "support", "status", "seconds"}
    assert keys <= data.keys()
    assert data["candidates"] == 125
    assert len(data["support"]) == 8
    assert data["support"][3] == {"posture_deg": pytest.approx([0.0, -90.0, 60.0, 90.0]), "weight": 0.125}
    assert data["bound"].keys() >= {"value", "source"}


def test_where_time_ended_the_search_the_bound_holds_and_says_so() -> None:
    cut, whole = judged(FACTORIAL, Status.time_limit).bound, judged(FACTORIAL, Status.converged).bound
    assert cut is not None
    assert whole is not None
    assert cut.cut
    assert not whole.cut
    assert cut.value == whole.value
