"""A design's figures and its JSON, recomputed from the stored problem."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest

from doe import score, score_plan, solve
from doe.bounds.certificate import Bound
from doe.bounds.planar_theorem import closed_form_bound
from doe.criteria import A
from doe.report.design import remarks
from identification import Arm, EffectSpec, Plan
from identification.workspace import WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FOUR, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det


def some_plan(runs: int = 8) -> np.ndarray:
    return np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (runs, 4))


def test_figures() -> None:
    """Of a plan; nulls where there is no sigma for the deviations and no bound was asked for; weights count."""
    plan = some_plan()
    data = score_plan(problem(FOUR), plan).to_json()
    assert data["log_det"] == pytest.approx(complex_log_det(plan))
    assert data["bound"]["source"] == "closed_form"
    assert data["efficiency"] == pytest.approx(np.exp((data["log_det"] + 0.0612353259) / 8))
    assert (data["certified_optimal"], data["status"]) == (False, "scored")
    assert [len(data["std"][k]) for k in ("length_mm", "orientation_deg", "joint_offset_deg")] == [4, 4, 4]
    np.testing.assert_allclose(np.radians(data["postures_deg"]), plan)
    json.dumps(data, allow_nan=False)
    bare = score(problem(Arm(FOUR.lengths), ECCENTRICITY), plan).to_json()
    assert bare["bound"] is bare["efficiency"] is None
    assert bare["certified_optimal"] is False
    assert bare["std"] == {"length_mm": None, "orientation_deg": None, "joint_offset_deg": None}
    weighted = Plan(plan, np.r_[np.full(7, 0.1), 0.3])
    assert score(problem(FOUR), weighted).log_det == pytest.approx(complex_log_det(plan[[*range(8), 7, 7]]))


def test_what_the_plan_does_not_tell_is_said() -> None:
    """All postures the same; `base_rotation`, an alias of joint_offset:1; an effect on which nothing depends here."""
    case, plan = problem(FOUR), some_plan()
    data = score_plan(case, np.zeros((6, 4))).to_json()
    assert (data["log_det"], data["efficiency"], data["std"]["length_mm"]) == (None, 0.0, None)
    assert data["table_1_max_residual"] == pytest.approx(1.0)
    json.dumps(data, allow_nan=False)
    for seed in range(5):
        any_plan = np.random.default_rng(seed).uniform(FOUR.lower, FOUR.upper, (12, 4))
        data = score_plan(problem(FOUR, EffectSpec("base_rotation")), any_plan).to_json()
        assert data["log_det"] is data["std"]["length_mm"] is None
    still = score(problem(FOUR, EffectSpec("thermal_growth")), some_plan(12))
    assert (still.log_det, still.to_json()["not_identifiable"]) == (-np.inf, ["thermal_growth.a"])
    assert "nothing depends on thermal_growth.a" in remarks(still)[0]
    assert "not estimable from the plan" in remarks(score(case, np.repeat(some_plan(2), 4, axis=0)))[0]
    told = score(case, plan)
    assert told.to_json()["not_identifiable"] == []
    assert not any("no log det" in line for line in remarks(told))
    walls = replace(case, constraints=(WorkspaceBox((-660.0, 660.0), (-660.0, 660.0)),))
    assert not remarks(score(walls, np.repeat(plan, 2, axis=0)))  # nobody kept its postures apart


def test_certified_from_one_millionth_and_no_efficiency_is_above_one() -> None:
    """Rounding, and what a search for a bound may miss, count as one; beyond that the bound is none."""
    case, plan = problem(FOUR), some_plan()
    value = score(case, plan).value
    assert score(case, plan, Bound(value + 8 * 0.9e-6, "continuous")).certified_optimal
    assert not score(case, plan, Bound(value + 8 * 1.1e-6, "continuous")).certified_optimal
    for excess, expected in ((-1e-15, 1.0), (-8e-13, 1.0), (-8e-9, 1.0), (8e-9, 0.999999999)):
        assert score(case, plan, Bound(value + excess, "continuous")).efficiency == pytest.approx(expected, abs=1e-12)
    beaten = score(case, plan, Bound(value - 8e-3, "continuous"))
    assert beaten.efficiency is beaten.to_json()["efficiency"] is None
    assert "better than the bound" in str(beaten.no_efficiency)
    assert not beaten.certified_optimal


def test_a_plan_outside_the_limits_is_never_certified() -> None:
    fourier = np.outer(2 * np.pi * np.arange(5) / 5, np.ones(4))  # orthogonal columns, log det M' = 0: above the bound
    design = score_plan(problem(FOUR), fourier)
    assert design.outside == (2, 3, 4, 5)
    assert design.to_json()["outside_limits"] == [2, 3, 4, 5]
    closed = closed_form_bound(problem(FOUR))
    assert design.value > closed.value
    said = "4 runs are outside joint limits or constraints, where no bound applies"
    for judged in (design, replace(design, bound=closed)):  # none is looked for, and none that is known applies
        assert judged.efficiency is judged.optimality is None
        assert not judged.certified_optimal
        assert judged.to_json()["no_efficiency"] == said
    assert score_plan(problem(Arm(FOUR.lengths, *np.radians([[-360] * 4, [360] * 4]))), fourier).certified_optimal


def test_whole_turns_are_no_violation_where_a_joint_may_take_every_angle_and_the_model_sees_none() -> None:
    free, plan = Arm(FOUR.lengths), some_plan()
    turned = plan + 2 * np.pi * np.random.default_rng(1).integers(-1, 2, plan.shape)
    assert score_plan(problem(free), turned).outside == ()
    assert score_plan(problem(free), turned).value == pytest.approx(score_plan(problem(free), plan).value, abs=1e-9)
    assert len(score_plan(problem(FOUR), turned).outside) == len(plan)
    assert len(score_plan(problem(free, EffectSpec("gear_ratio", 1)), turned).outside) > 0  # it sees the turns


def test_travels_to_workers_and_caches() -> None:
    """Also after use, when CasADi functions hang on the problem, and with effects, whose values are read-only."""
    design = score_plan(problem(FOUR, ECCENTRICITY), some_plan())
    again = pickle.loads(pickle.dumps(design))
    assert again.problem.objective(some_plan()) == design.problem.objective(some_plan())
    assert again.to_json() == design.to_json()


def test_what_is_called_optimal_says_by_what() -> None:
    """Two links, criterion A, a box that does not bind: the bound comes from a search, and the plan reaches it."""
    box = WorkspaceBox((-1000.0, 1000.0), (-1000.0, 1000.0))
    boxed = solve(problem(Arm([300.0, 200.0], constraints=(box,)), criterion=A()), 4, seed=1)
    assert (boxed.bound.source, boxed.bound.rigorous) == ("continuous", False)
    assert (boxed.certified_optimal, boxed.to_json()["optimality"]) == (True, "numerical")
    assert "optimal up to a numerical bound" in str(boxed)
    assert "proven" not in str(boxed)
    free = solve(problem(Arm([300.0, 200.0])), 4, seed=1)
    assert (free.optimality, free.bound.rigorous, free.bound.source) == ("proven", True, "closed_form")
    assert "proven optimal" in str(free)
    best = solve(problem(FOUR), 5, seed=1, starts=1)
    assert (best.certified_optimal, best.optimality) == (False, "best known")
    assert score(best.problem, best.plan, best.bound).optimality is None  # a plan that was given
    assert solve(best.problem, 8, "random").optimality is None
    choices = np.random.default_rng(0).uniform(-3.0, 3.0, (3, 2))
    listed = solve(problem(Arm([300.0, 200.0]), choices=choices), 3, seed=1)
    judged = replace(listed, bound=Bound(listed.value, "grid", rigorous=True, candidates=3))
    assert "proven optimal among the list of 3 postures" in str(judged)
