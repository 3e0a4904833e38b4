"""A design's figures and its JSON, recomputed from the stored problem."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

from doe.bounds.bound import Bound
from doe.design import score, score_plan
from doe.plan.plan import Plan
from doe.report.design_tables import not_estimable_line
from identification.arm import Arm, EffectSpec
from tests.doe.arms import ECCENTRICITY, FOUR, SIX, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det

KEYS = {
    "criterion", "runs", "links", "log_det", "bound", "efficiency", "certified_optimal", "postures_deg",
    "table_1_max_residual", "std", "solver", "status", "starts", "seconds",
}  # fmt: skip


def some_plan(runs: int = 8) -> np.ndarray:
    return np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (runs, 4))


def test_figures() -> None:
    plan = some_plan()
    found = score_plan(problem(FOUR), plan)
    data = found.to_json()
    assert data.keys() >= KEYS
    assert data["log_det"] == pytest.approx(complex_log_det(plan))
    assert data["bound"]["source"] == "closed_form"
    assert data["efficiency"] == pytest.approx(np.exp((data["log_det"] + 0.0612353259) / 8))
    assert data["certified_optimal"] is False
    assert data["status"] == "scored"
    assert [len(data["std"][k]) for k in ("length_mm", "orientation_deg", "joint_offset_deg")] == [4, 4, 4]
    np.testing.assert_allclose(np.radians(data["postures_deg"]), plan)
    json.dumps(data, allow_nan=False)


def test_a_plan_that_identifies_nothing_has_null_figures() -> None:
    data = score_plan(problem(FOUR), np.zeros((6, 4))).to_json()
    assert data["log_det"] is None
    assert data["efficiency"] == 0.0
    assert data["std"]["length_mm"] is None
    assert data["table_1_max_residual"] == pytest.approx(1.0)
    json.dumps(data, allow_nan=False)


def test_no_sigma_no_bound() -> None:
    found = score(problem(Arm(FOUR.lengths), ECCENTRICITY), some_plan())
    data = found.to_json()
    assert data["bound"] is None
    assert data["efficiency"] is None
    assert data["certified_optimal"] is False
    assert data["std"] == {"length_mm": None, "orientation_deg": None, "joint_offset_deg": None}


def test_weights_count() -> None:
    plan = Plan(some_plan(), np.r_[np.full(7, 0.1), 0.3])
    repeated = np.vstack([np.repeat(plan.postures[:7], 1, axis=0), np.repeat(plan.postures[7:], 3, axis=0)])
    assert score(problem(FOUR), plan).log_det == pytest.approx(complex_log_det(repeated))


def test_certified_from_one_millionth() -> None:
    case = problem(FOUR)
    plan = some_plan()
    value = case.objective(plan)
    assert score(case, plan, Bound(value + 8 * 0.9e-6, "continuous")).certified_optimal
    assert not score(case, plan, Bound(value + 8 * 1.1e-6, "continuous")).certified_optimal


def test_prints_well() -> None:
    found = score_plan(problem(SIX), np.random.default_rng(0).uniform(SIX.lower, SIX.upper, (9, 6)))
    assert "9 runs of a 6-link arm" in repr(found)
    assert found._repr_html_().count("<tr>") == 10


def test_a_plan_outside_the_limits_is_never_certified() -> None:
    runs = np.arange(5)
    fourier = np.outer(2 * np.pi * runs / 5, np.ones(4))  # orthogonal columns, log det M' = 0: above the bound
    found = score_plan(problem(FOUR), fourier)
    assert found.value > found.bound.value
    assert found.outside == (2, 3, 4, 5)
    assert not found.certified_optimal
    assert found.to_json()["outside_limits"] == [2, 3, 4, 5]
    assert score_plan(problem(Arm(FOUR.lengths, *np.radians([[-360] * 4, [360] * 4]))), fourier).certified_optimal


def test_a_plan_that_tells_a_combination_only_is_worth_nothing() -> None:
    rotation = EffectSpec("base_rotation")  # an alias of joint_offset:1, whatever the plan
    for seed in range(5):
        plan = np.random.default_rng(seed).uniform(FOUR.lower, FOUR.upper, (12, 4))
        data = score_plan(problem(FOUR, rotation), plan).to_json()
        assert data["log_det"] is None
        assert data["std"]["length_mm"] is None


def test_travels_to_workers_and_caches() -> None:
    """Also after use, when CasADi functions hang on the problem, and with effects, whose values are read-only."""
    found = score_plan(problem(FOUR, ECCENTRICITY), some_plan())
    again = pickle.loads(pickle.dumps(found))
    assert again.problem.objective(some_plan()) == found.problem.objective(some_plan())
    assert again.to_json() == found.to_json()


def test_efficiency_is_above_one_only_if_the_bound_is_none() -> None:
    case, plan = problem(FOUR), some_plan()
    value = score(case, plan).value
    for excess, expected in ((-1e-15, 1.0), (-8e-13, 1.0), (-8e-9, 1.000000001), (8e-9, 0.999999999)):
        found = score(case, plan, Bound(value + excess, "continuous")).efficiency
        assert found == pytest.approx(expected, abs=1e-15 if expected == 1.0 else 1e-12)
        assert found is not None
        assert (found > 1.0) == (expected > 1.0)


def test_what_the_plan_does_not_tell_is_said() -> None:
    still = score(problem(FOUR, EffectSpec("thermal_growth")), some_plan(12))
    assert still.log_det == -np.inf
    assert still.to_json()["not_identifiable"] == ["thermal_growth.a"]
    assert "nothing depends on thermal_growth.a" in str(not_estimable_line(still)[0])
    twice = score(problem(FOUR), np.repeat(some_plan(2), 4, axis=0))
    assert "not estimable from the plan" in str(not_estimable_line(twice)[0])
    told = score(problem(FOUR), some_plan())
    assert told.to_json()["not_identifiable"] == []
    assert not_estimable_line(told) == []


def test_whole_turns_are_no_violation_where_a_joint_may_take_every_angle_and_the_model_sees_none() -> None:
    free = Arm(FOUR.lengths)
    plan = some_plan()
    turned = plan + 2 * np.pi * np.random.default_rng(1).integers(-1, 2, plan.shape)
    assert score_plan(problem(free), turned).outside == ()
    assert score_plan(problem(free), turned).value == pytest.approx(score_plan(problem(free), plan).value, abs=1e-9)
    assert len(score_plan(problem(FOUR), turned).outside) == len(plan)
    assert len(score_plan(problem(free, EffectSpec("gear_ratio", 1)), turned).outside) > 0  # it sees the turns
