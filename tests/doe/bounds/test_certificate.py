"""The equivalence theorem and its bounds: what is recomputed, and what is not believed. A design that is better than
its numerical bound shows that the bound is wrong: it is never reported."""

import json
from dataclasses import replace

import numpy as np
import pytest

from doe import DesignProblem, solve
from doe.bounds.certificate import ApproximateDesign, Bound
from doe.bounds.column_generation import CandidateSet, best_design, best_known_bound, bound_that_holds, bounds_of_runs
from doe.bounds.planar_theorem import closed_form_bound
from doe.criteria import A
from identification import Arm, Array, Model, Plan, Status
from identification.workspace import WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem
from tests.doe.six_axis import SIX_AXIS, six_axis

FACTORIAL = Plan(np.radians([[0, a, b, c] for a in (-90, 90) for b in (-90, 60) for c in (-90, 90)]), np.full(8, 0.125))
AXES = [np.linspace(a, b, 5) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
GRID = np.stack([np.zeros(125), *(a.ravel() for a in np.meshgrid(*AXES))], axis=1)


def judged(case: DesignProblem, plan: Plan, candidates: Array, status: Status = Status.converged) -> ApproximateDesign:
    """Over designs on these candidates only."""
    prior = case.prior.per_new_run(len(plan))
    gradient = case.criterion.gradient(case.information(plan.postures, plan.weights))
    largest = float(CandidateSet(case, candidates, prior).sensitivities(gradient).max())
    return ApproximateDesign(case, plan, prior, None, largest, len(candidates), True, status, "done", "by hand", 0.5)


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
    found = ApproximateDesign(case, plan, case.prior).certified(given_up.max(), 1e-6, cut=True)
    assert (found.gap, found.upper, found.efficiency_lower_bound, found.bound) == (np.inf, np.inf, 0.0, None)
    assert found.status is Status.time_limit
    assert found.value == pytest.approx(np.linalg.slogdet(case.information(plan.postures))[1])


@pytest.mark.parametrize("status", Status)
def test_a_bound_only_where_solved_or_cut_by_time(status: Status) -> None:
    found = judged(problem(FOUR), FACTORIAL, GRID, status)
    data = found.to_json()
    assert data["status"] == status.name
    if status not in (Status.converged, Status.time_limit):
        assert found.bound is data["bound"] is None
        return
    assert (found.bound.cut, found.bound.value) == (status is Status.time_limit, found.upper)
    assert json.loads(json.dumps(data)) == data
    assert data["support"][3] == {"posture_deg": pytest.approx([0.0, -90.0, 60.0, 90.0]), "weight": 0.125}


# -- the best bound known ----------------------------------------------------------------------------------------------
LIST = np.random.default_rng(3).uniform(FOUR.lower, FOUR.upper, (200, 4))
BOX = Arm([300.0, 200.0, 150.0], lower=np.radians([-180, -120, -100]), upper=np.radians([180, 60, 90]), sigma=0.1)


def test_a_bound_that_is_beaten_is_found_again_and_equals_the_closed_form() -> None:
    case = DesignProblem.of(Model(BOX))
    design = solve(case, 12, seed=1)
    wrong = Bound(design.value - 0.1, "continuous")
    assert "better than the bound" in replace(design, bound=wrong).no_efficiency
    bound = bound_that_holds(case, wrong, design.plan.postures, design.value)
    assert bound.value == pytest.approx(closed_form_bound(case).value, abs=1e-6)
    assert bound.value >= design.value - 1e-9


def test_constraints_and_lists_lower_the_closed_form() -> None:
    free = DesignProblem.of(Model(BOX))
    assert best_known_bound(free, 8) == closed_form_bound(free)
    walled = DesignProblem.of(Model(replace(BOX, constraints=(WorkspaceBox((100.0, 400.0), (100.0, 400.0)),))))
    listed = replace(free, choices=np.random.default_rng(0).uniform(free.lower, free.upper, (30, 3)))
    for case, source in ((walled, "continuous"), (listed, "grid")):
        bound = best_known_bound(case, 8)
        assert bound.source == source
        assert bound.value < closed_form_bound(free).value - 1e-4  # far more than the error of a bound, 1e-8


def test_one_link_without_a_joint_to_choose() -> None:
    """q_1 turns everything: every plan has M = I (2, 2), and -trace M^-1 = -2."""
    case = DesignProblem.of(Model(Arm([300.0])), criterion=A())
    assert best_known_bound(case, 5) == Bound(pytest.approx(-2.0, abs=1e-12), "continuous", rigorous=True)


@pytest.mark.parametrize(
    "case",
    [problem(FOUR, ECCENTRICITY), problem(FOUR), problem(FOUR, choices=LIST)],
    ids=["continuous", "proven", "list"],
)
def test_a_bound_whose_search_is_cut_holds_and_says_so(case: DesignProblem) -> None:
    """Stopped after its first pricing: above the bound of the whole search, by the equivalence theorem."""
    cut, whole = (best_design(case, 20, stop=lambda c=c: c).bound for c in (True, False))  # type: ignore[misc]
    assert cut.cut
    assert not whole.cut
    assert cut.value >= whole.value - 1e-8


# -- many numbers of runs ----------------------------------------------------------------------------------------------
KEPT = np.random.default_rng(5).uniform(FOUR.lower, FOUR.upper, (3, 4))
KNOWN = problem(FOUR, OFFSET, kept=KEPT, choices=LIST, deviations={"length_error:1": 0.05, "joint_offset:2": 1e-4})


@pytest.mark.parametrize("case", [KNOWN, replace(KNOWN, criterion=A())], ids=["D", "A"])
def test_the_certificate_of_one_number_of_runs_holds_for_others(case: DesignProblem) -> None:
    made, generator = best_design(case, 5), np.random.default_rng(0)
    for m in (2, 5, 20):
        own, upper = best_known_bound(case, m), made.upper_at(m)
        assert upper >= own.value - 1e-6 * abs(own.value) if m != 5 else upper == pytest.approx(own.value, rel=1e-9)
        for _ in range(20):  # by hand: (sum B^T B + K) / (m + k)
            plan = LIST[generator.integers(len(LIST), size=m)]
            rows = case.scaled_jacobians(np.concatenate([plan, KEPT])).reshape(-1, 10)
            assert case.criterion.value((rows.T @ rows + np.diag(case.precisions)) / (m + 3)) <= upper


def test_bounds_of_several_runs_that_are_cut_hold_and_are_looser() -> None:
    """One design is made, which bounds all numbers of runs."""
    whole, cut = bounds_of_runs(KNOWN, [4, 20]), bounds_of_runs(KNOWN, [4, 20], stop=lambda: True)
    for m in (4, 20):
        assert cut[m].cut
        assert cut[m].value > whole[m].value


def test_without_anything_known_there_is_one_bound() -> None:
    found = bounds_of_runs(problem(FOUR), [4, 9])
    assert found[4] is found[9]
    assert found[4].source == "closed_form"


def test_a_bound_that_knows_no_constraints_says_so() -> None:
    """Of many parameters it is over all postures within the limits: the same with constraints as without."""
    box = replace(SIX_AXIS, constraints=(WorkspaceBox((-900.0, 900.0), (-900.0, 900.0)),))
    bound = best_known_bound(six_axis(box), 20, stop=lambda: True)
    assert bound is not None
    assert bound.unconstrained
    assert "with or without constraints" in str(bound)
    assert bound.as_dict()["unconstrained"] is True
