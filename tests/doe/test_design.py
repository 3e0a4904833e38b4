"""A design's figures and its JSON, recomputed from the stored problem."""

import json
import pickle
from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest

from doe import Design, DesignProblem, score, score_plan, solve
from doe.advise import BOUND_CUT, advise, with_scatter
from doe.bounds.certificate import Bound
from doe.bounds.column_generation import relax
from doe.bounds.planar_theorem import closed_form_bound
from doe.criteria import A
from doe.solvers.solving import cross_check
from identification import Arm, Calibration, EffectSpec, InputError, Plan, Status
from identification.document import Sheet
from identification.reuse import only
from identification.workspace import WorkspaceBox
from tests.doe.arms import ECCENTRICITY, FIVE, FOUR, problem
from tests.doe.bounds.test_planar_theorem import complex_log_det
from tests.doe.plan.test_plan import whole_information


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
    assert "nothing depends on thermal_growth.a" in str(still)
    assert "not estimable from the plan" in str(score(case, np.repeat(some_plan(2), 4, axis=0)))
    told = score(case, plan)
    assert told.to_json()["not_identifiable"] == []
    assert "no log det" not in str(told)
    walls = problem(replace(FOUR, constraints=(WorkspaceBox((-660.0, 660.0), (-660.0, 660.0)),)))
    assert not score(walls, np.repeat(plan, 2, axis=0))._remarks()  # nobody kept its postures apart


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
    assert ([*design.missed], design.to_json()["outside_limits"]) == ([2, 3, 4, 5], [2, 3, 4, 5])
    assert f"run 2: outside joint 3 by {72 - np.degrees(FOUR.upper[2]):.1f} deg" in str(design)
    closed = closed_form_bound(problem(FOUR))
    assert design.value > closed.value
    said = "runs 2, 3, 4, 5 are outside joint limits or constraints, where no bound applies"
    for judged in (design, replace(design, bound=closed)):  # none is looked for, and none that is known applies
        assert judged.efficiency is judged.optimality is None
        assert not judged.certified_optimal
        assert judged.to_json()["no_efficiency"] == said
    assert score_plan(problem(Arm(FOUR.lengths, *np.radians([[-360] * 4, [360] * 4]))), fourier).certified_optimal


def test_whole_turns_are_no_violation_where_a_joint_may_take_every_angle_and_the_model_sees_none() -> None:
    free, plan = Arm(FOUR.lengths), some_plan()
    turned = plan + 2 * np.pi * np.random.default_rng(1).integers(-1, 2, plan.shape)
    assert score_plan(problem(free), turned).missed == {}
    assert score_plan(problem(free), turned).value == pytest.approx(score_plan(problem(free), plan).value, abs=1e-9)
    assert len(score_plan(problem(FOUR), turned).missed) == len(plan)
    assert len(score_plan(problem(free, EffectSpec("gear_ratio", 1)), turned).missed) > 0  # it sees the turns


def test_travels_to_workers_and_caches() -> None:
    """Also after use, when CasADi functions hang on the problem, and with effects, whose values are read-only."""
    design = score_plan(problem(FOUR, ECCENTRICITY), some_plan(), seconds=0.0)
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
    listed = solve(problem(Arm([300.0, 200.0]), choices=np.random.default_rng(0).uniform(-3.0, 3.0, (3, 2))), 3, seed=1)
    judged = replace(listed, bound=Bound(listed.value, "grid", rigorous=True, candidates=3))
    assert "proven optimal among the list of 3 postures" in str(judged)


# -- how many runs -----------------------------------------------------------------------------------------------------
FREE = problem(Arm([260.0, 180.0, 120.0], sigma=0.1))


def test_lengths_are_known_to_sigma_over_the_root_of_the_runs() -> None:
    """M' = I (doe/README.md, "Planar theorem"): a length has the deviation 0.1 mm / sqrt(m), 7 runs for 0.04 mm."""
    found = advise(FREE, range(4, 10), target=0.04)
    assert found.runs == (4, 5, 6, 7, 8, 9)
    for design in found.designs:
        assert found.accuracy(design) == pytest.approx(0.1 / np.sqrt(len(design.plan)), rel=1e-6)
    assert (len(found.smallest.plan), found.efficient_runs()) == (7, found.runs)
    assert replace(found, target=1e-3).smallest is None
    said = found.verdict
    assert said.startswith("7 runs suffice for 0.04 mm in each length, if the model is right; at the tip ")
    assert said.endswith(
        f" {found.tip_errors[7]['effects_missing']:.2f} mm if effects of typical size are missing. "
        "Plans within 0.1 % of the bound exist for m = 4 to 9."
    )
    data = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert data["smallest_runs"] == 7
    assert [row["runs"] for row in data["rows"]] == list(found.runs)
    for wrong, problem_given, runs, target in (
        ("sigma", problem(Arm([260.0, 180.0])), [4], 0.04),
        ("runs: 2", FREE, [2, 3], None),
    ):
        with pytest.raises(InputError, match=wrong):
            advise(problem_given, runs, target=target)


def test_one_joint_alone_by_its_lever() -> None:
    """One offset needs one posture: the arm stretched behind the joint, and sigma over that lever."""
    arm = Arm([260.0, 180.0, 120.0, 100.0], sigma=0.1)
    advice = advise(DesignProblem.of(only(arm, ["joint_offset:3"])), [1, 2], target=0.08)
    for design, m in zip(advice.designs, (1, 2), strict=True):
        assert design.certified_optimal
        assert design.deviations.joint_offset[2] == pytest.approx(0.1 / 220.0 / np.sqrt(m))
        assert design.deviations.joint_offset[[0, 1, 3]].tolist() == [0.0, 0.0, 0.0]
    # nothing but joint 3 is uncertain: its lever to the tip, of links 3 and 4, times that
    assert advice.of_tip
    lever = np.hypot(120.0, 100.0)  # root mean square over angles of joint 4
    assert advice.tip_errors[1]["model_right"] == pytest.approx(0.1 / 220.0 * lever, rel=0.02)
    assert advice.tip_errors[1]["model_right_worst"] == pytest.approx(0.1, rel=1e-3)
    assert np.isfinite(advice.tip_errors[1]["effects_missing"])
    assert advice.smallest is advice.designs[0]


@pytest.mark.parametrize("arm", [FOUR, replace(FIVE, sigma=0.1)], ids=["four", "five"])
def test_more_runs_never_tell_less(arm: Arm) -> None:
    """Whole information and its inverse from complex numbers; no posture added to a plan beats the plan of one more."""
    lengths, n = np.array(arm.lengths), arm.links
    plans = [d.plan.postures for d in advise(problem(arm), range(n, n + 3), seconds=0.4).designs]
    corners = np.array(list(product(*zip(arm.lower, arm.upper, strict=True))))
    places = np.concatenate([corners, np.random.default_rng(0).uniform(arm.lower, arm.upper, (300, n))])
    for fewer, more in pairwise(plans):
        after, before = whole_information(lengths, more), whole_information(lengths, fewer)
        added = max(np.linalg.slogdet(before + whole_information(lengths, q[None]))[1] for q in places)
        assert np.linalg.slogdet(after)[1] >= added - 1e-9
        now, then = (np.sqrt(np.diag(np.linalg.inv(each))) for each in (after, before))
        assert now[:n].max() <= then[:n].max() * (1.0 + 1e-8)  # largest deviation of a length
        assert (now[n:] / lengths).max() <= (then[n:] / lengths).max() * (1.0 + 1e-8)  # and of an angle
    hasty = advise(problem(arm), range(n + 1, n + 4), seconds=1e-6)  # no time at all
    accuracies = [hasty.accuracy(design) or np.inf for design in hasty.designs]
    assert accuracies == sorted(accuracies, reverse=True)


def test_without_a_sigma_the_scatter_of_the_calibration_stands_in() -> None:
    arm = Arm([260.0, 180.0, 120.0])
    assert with_scatter(replace(arm, sigma=0.1)) == (replace(arm, sigma=0.1), "")
    same, said = with_scatter(arm)
    assert same.sigma is None
    assert "add the line [measurement] to the arm file and below it sigma_mm = " in said
    lengths = {f"length_error:{k}": 0.0 for k in (1, 2, 3)}
    found, said = with_scatter(replace(arm, calibration=Calibration(lengths, provenance={"scatter_mm": 0.254})))
    assert found.sigma == 0.254
    assert "sigma_mm = 0.254, the residual scatter" in said
    shown = advise(problem(arm), [4]).document()
    assert not any(isinstance(part, Sheet) and len(part.headings) != 2 for part in shown.parts)


def test_a_bound_that_time_cut_is_said_to_be() -> None:
    advice = advise(FREE, range(4, 6))
    assert BOUND_CUT not in advice.document().parts
    cut = replace(advice, designs=tuple(replace(d, bound=replace(d.bound, cut=True)) for d in advice.designs))
    assert BOUND_CUT in cut.document().parts


def test_ctrl_c_in_the_search_for_a_plan_ends_the_rest_too(monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*args: Any, **options: Any) -> Design:
        return replace(solve(*args, **options), status=Status.interrupted)

    monkeypatch.setattr("doe.advise.solve", stopped)
    advice = advise(FREE, range(4, 7))
    assert advice.runs == (4,)
    assert Status.interrupted.value in advice.document().parts


# -- three answers -----------------------------------------------------------------------------------------------------
# doe/README.md, "Planar theorem": only joint 3 with 160 deg is too narrow, 2 log(sin 80 deg) for each of its two links
EXPECTED = 4.0 * np.log(np.sin(np.radians(80.0)))


def test_three_answers_agree() -> None:
    case = problem(FOUR)
    found = cross_check(case, relax(case, 5, "clarabel"), 8)
    methods = ["relaxation, clarabel", "column generation, column_generation", "exact plan, exchange", "closed form"]
    assert [row["method"] for row in found] == methods
    for row, tolerance in zip(found, (1e-4, 1e-8, 1e-7, 1e-12), strict=True):
        assert row["value"] == pytest.approx(EXPECTED, abs=tolerance)


def test_what_time_cut_is_said_to_be() -> None:
    """Bounds as well as plans."""
    case = problem(FIVE, ECCENTRICITY, EffectSpec("gear_ratio", 3))
    found = cross_check(case, relax(case, 3, stop=lambda: True), 12, seconds=0.05)
    assert all(", bound cut" in row["method"] for row in found)
