"""What a person reads of a plan, and what a page gets of it to compute log det and to write its file."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpl_toolkits.mplot3d import art3d

from doe import DesignProblem, score
from doe.bounds.certificate import Bound
from doe.bounds.column_generation import relax
from doe.design import Design
from doe.discrimination.t_optimal import NextPostures
from doe.plan.accuracy import missing_effects, robust_problem
from doe.report.figures import outlines, plan_figure, scene, side
from doe.report.plan import plan_section, plan_steps
from identification import Arm, Conditions, DHRow, Gravity, Model, Plan, chain_of, design_model
from identification.document import Pictures
from identification.kinematics.parameters import PRISMATIC
from identification.workspace import Body, Cell, KeepOut, LineOfSight, WorkspaceBox
from tests.doe.arms import problem
from tests.doe.problem.test_spatial_constraints import ARM as CROWDED
from tests.doe.problem.test_spatial_constraints import PILLAR, POSTURES, SIGHT, SPHERE
from tests.doe.six_axis import CHAIN, SIX_AXIS

AROUND = (WorkspaceBox((-500.0, 500.0), (-400.0, 600.0)), KeepOut((700.0, 0.0), 50.0))
ARM = Arm([300.0, 200.0], sigma=0.1, constraints=(*AROUND, LineOfSight((900.0, 0.0), 0.5, (0.0, 0.0))))


def test_a_robust_plan_is_judged_by_millimetres() -> None:
    """The values of criterion I, which mean nothing to a reader, give way; what the bound allows stands beside it."""
    plain = problem(Arm([260.0, 180.0, 120.0], sigma=0.1))
    wide = robust_problem(plain, missing_effects(plain, ["gear_ratio"]))
    bound = Bound(-1.0, "grid", True, candidates=2000)
    design = score(wide, np.random.default_rng(3).uniform(-1.0, 1.0, (8, 3)), bound)
    said = " ".join(str(design).split())
    assert re.search(r"efficiency 0.0\d+ of the bound \(the list of 2,000 postures, proven\)", said)
    assert "RMS over the workspace or --test-poses, if fitted by armcal identify --library" in design.verdict
    assert "RMS over the candidates" in replace(design, problem=replace(wide, choices=design.plan.postures)).verdict
    assert "value of I" not in said
    assert "upper bound" not in said


def test_a_plan_in_a_sentence() -> None:
    def verdict(criterion: str = "D", no_efficiency: str | None = None, **values: Any) -> str:
        usual = {"efficiency": None, "certified_optimal": False, "expected_error": None, "bound": None}
        stated = SimpleNamespace(criterion=SimpleNamespace(name=criterion), choices=None, fit="", beyond=0.05**2)
        plan = Plan(np.zeros((20, 2)))
        return Design.verdict.fget(  # type: ignore[attr-defined]
            SimpleNamespace(problem=stated, plan=plan, no_efficiency=no_efficiency, **(usual | values))
        )

    assert verdict(efficiency=0.98765) == "The plan of 20 runs has an efficiency of 0.9877 (D)."
    cut = Bound(-9.0, "continuous", False, cut=True)
    assert verdict(efficiency=0.44, bound=cut) == "The plan of 20 runs has an efficiency of at least 0.4400 (D)."
    assert verdict("D", "no bound is known") == "The plan of 20 runs has no efficiency: no bound is known (D)."
    listed = Bound(-9.0, "grid", True, candidates=2000)
    share = (0.0808**2 - 0.05**2) / (0.158**2 - 0.05**2)
    error = {"bound": listed, "efficiency": share, "expected_error": {"plan": 0.158, "bound": 0.0808}}
    said = verdict("I", **error)
    figures = f"Efficiency {share:.4f}. Do not expect", "No plan can reduce 0.0500 mm"
    for part in ("an expected tip error of 0.158 mm", "of 2,000 postures can be below 0.0808 mm", *figures):
        assert part in said
    assert "bound" not in verdict("I", **(error | {"efficiency": None}))  # none applies
    optimal = "optimal up to a numerical bound"
    assert verdict(efficiency=1.0, certified_optimal=True, optimality_in_words=optimal).endswith(f"(D, {optimal}).")


def test_rows_without_payload_are_completed_before_others_are_appended() -> None:
    arm = Arm([200.0, 100.0], gravity=Gravity(np.array([0.0, -9.81]), np.array([5.0, 3.0]), np.full(2, 0.5), 7.5))
    for measured, payload, noted in (
        (None, np.array([5.0]), True),
        (None, None, False),
        (np.ones(1), np.ones(1), False),
    ):
        rows = SimpleNamespace(conditions=Conditions(payload=measured))
        diagnosis: Any = SimpleNamespace(sentence="Two fit.", arm=arm, measurements=rows)
        result = NextPostures(Plan(np.zeros((1, 2)), conditions={"payload": payload}), 0.5, {}, diagnosis)
        shown = result.document().parts
        assert [part for part in shown if "need a column payload_kg too: 7.5" in str(part)] == shown[2:]
        assert len(shown) == 2 + noted


@pytest.mark.parametrize(("arm", "joints", "runs"), [(ARM, 2, 9), (SIX_AXIS, 6, 16)])
def test_the_log_det_of_a_plan_follows_from_what_the_page_has(arm: Arm, joints: int, runs: int) -> None:
    whole = Plan(np.random.default_rng(1).uniform(-2.0, 2.0, (runs + 1, joints)), via=np.arange(runs + 1) == 3)
    plan, steps = Plan(whole.measured), plan_steps(problem(arm), whole)
    rows = np.array(steps["jacobians"]).reshape(-1, steps["parameters"])
    log_det = np.linalg.slogdet((rows.T @ rows + np.diag(steps["precisions"])) / runs)[1]
    assert log_det == pytest.approx(score(DesignProblem.of(Model(arm)), plan).log_det, abs=1e-8)
    cells = np.array(steps["rows"])[steps["runs"], 1 : 1 + joints].astype(float)  # after its kind
    np.testing.assert_allclose(cells, np.degrees(plan.postures), atol=1e-11)
    np.testing.assert_allclose(steps["points"], Model(arm).points(plan.postures), rtol=1e-4, atol=1e-2)


def test_outlines_of_a_plane_lie_on_what_they_show() -> None:
    steps = plan_steps(problem(ARM), Plan(np.ones((4, 2))))
    box, circle, cone = (np.array(one["line"]) for one in steps["outlines"])
    assert [one["forbidden"] for one in steps["outlines"]] == [False, True, False]
    assert (box.min(axis=0).tolist(), box.max(axis=0).tolist()) == ([-500.0, -400.0], [500.0, 600.0])
    np.testing.assert_allclose(np.linalg.norm(circle - [700.0, 0.0], axis=1), 50.0, atol=0.02)
    np.testing.assert_allclose(cone[1], [900.0, 0.0])
    sides = cone[[0, 2]] - cone[1]
    np.testing.assert_allclose(np.abs(np.arctan2(sides[:, 1], -sides[:, 0])), 0.5, atol=1e-4)


def test_the_edited_plan_keeps_the_columns_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    path.write_text('run;q1_deg;q2_deg;payload_kg;note\n7;1,5;-20;2,5;a, b\n8;30;40;0;"c"\n')
    with pytest.warns(UserWarning, match="note"):
        file = Plan.load(path)
    steps = plan_steps(problem(ARM), file, "mine")
    assert steps["columns"] == ["q1_deg", "q2_deg", "payload_kg", "note"]
    assert steps["rows"] == [["1.5", "-20", "2.5", "a, b"], ["30", "40", "0", "c"]]
    assert steps["file"] == "mine-edited.csv"


def test_long_and_weighted_plans_are_drawn_only() -> None:
    for plan in (Plan(np.ones((201, 2))), Plan(np.ones((2, 2)), np.array([0.25, 0.75]))):
        assert plan_steps(problem(ARM), plan) is None
    (pictures,) = plan_section(ARM, plan).parts
    assert isinstance(pictures, Pictures)
    assert len(pictures.draw()) == 2


def test_no_weight_is_printed_as_zero() -> None:
    """Column generation may leave a posture with a weight of rounding."""
    shares = np.array([0.5, 0.5 - 1e-9, 1e-9])
    weights = relax(DesignProblem.of(Model(Arm([300.0, 200.0]))), 5)
    text = str(replace(weights, plan=Plan(np.eye(3, 2), shares)))
    assert re.findall(r"^ *(0.5|1e-09) ", text, re.MULTILINE) == ["0.5", "0.5", "1e-09"]
    assert "6e-05" in str(replace(weights, largest=weights.largest + 6e-5))  # and not 0.000


# -- pictures in space -------------------------------------------------------------------------------------------------
def test_outlines_lie_on_what_they_show() -> None:
    lines = [line for line, _ in outlines(CROWDED)]
    assert {line.shape[1] for line in lines} == {3}
    balls = [line for line in lines if np.allclose(np.linalg.norm(line - SPHERE.start, axis=1), SPHERE.radius)]
    assert len(balls) == 3
    start, along = np.array(PILLAR.start), np.subtract(PILLAR.end, PILLAR.start)
    away = [np.linalg.norm(np.cross(line - start, along), axis=1) / np.linalg.norm(along) for line in lines]
    assert sum(np.allclose(each, PILLAR.radius) for each in away) == 2 + 5
    tracker = np.array(SIGHT.tracker)
    axis = np.subtract(SIGHT.toward, tracker) / np.linalg.norm(np.subtract(SIGHT.toward, tracker))
    rim = [line - tracker for line in lines if np.allclose(np.linalg.norm(line - tracker, axis=1), 3000.0)]
    assert len(rim) == 1
    np.testing.assert_allclose(rim[0] @ axis, 3000.0 * np.cos(SIGHT.half_angle))


def test_the_bodies_of_a_cell_are_drawn_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the arm at the first posture and of the cell, seen from where the page shows them; the floor below."""
    start, end, radius = np.array([0.0, 0.0, 100.0]), np.array([0.0, 0.0, 400.0]), 50.0
    link = Body("link", 2, np.array([[*start, *end, radius]]))
    wall = Body("wall", 0, boxes=np.array([[700.0, 0.0, 300.0, *np.eye(3).ravel(), 20.0, 400.0, 300.0]]))
    arm = replace(CROWDED, cell=Cell((link, wall), floor=-100.0))
    drawn = []

    class Kept(art3d.Poly3DCollection):
        def __init__(self, polygons: Any, **style: Any) -> None:
            drawn.append(np.reshape(polygons, (-1, 3)))
            super().__init__(polygons, **style)

    monkeypatch.setattr(art3d, "Poly3DCollection", Kept)
    view, _ = (axes for axes in plan_figure(arm, POSTURES[:5]).axes if axes.name == "3d")
    corners = drawn[0]
    frame = design_model(Model(arm)).joint_frames(POSTURES[:1])[0, 2]
    local = (corners - frame[:3, 3]) @ frame[:3, :3]
    axial = np.clip(local[:, 2], start[2], end[2])
    on_link = np.isclose(np.linalg.norm(local - axial[:, None] * np.eye(3)[2], axis=1), radius, atol=1.0)
    on_wall = np.isclose(np.abs(corners - [700.0, 0.0, 300.0]), [20.0, 400.0, 300.0], atol=1.0)
    assert (on_link | on_wall.all(axis=1)).all()
    assert on_link.sum() > 100
    assert on_wall.all(axis=1).sum() >= 6
    assert any(np.allclose(line.get_data_3d()[2], -100.0) for line in view.lines)  # the edge of the floor
    assert view.get_zlim()[0] <= -100.0
    assert (view.elev, view.azim) == side(arm)


def test_a_floor_without_bodies_is_drawn() -> None:
    arm = replace(CROWDED, cell=Cell((Body("nothing"),), floor=-50.0))
    views = [axes for axes in plan_figure(arm, POSTURES[:2]).axes if axes.name == "3d"]
    assert all(view.get_zlim()[0] <= -50.0 for view in views)
    assert scene(design_model(Model(arm)), POSTURES[:2], {})["bodies"] == []


def test_bodies_of_the_plane_are_drawn_below_the_postures() -> None:
    wall = Body("wall", 0, boxes=np.array([[500.0, 90.0, 0.0, *np.eye(3).ravel(), 20.0, 40.0, 5.0]]))
    axes = plan_figure(replace(ARM, cell=Cell((wall,))), np.zeros((2, ARM.links))).axes[0]
    (drawn,) = (np.concatenate([path.vertices for path in each.get_paths()]) for each in axes.collections)
    np.testing.assert_allclose([drawn.min(axis=0), drawn.max(axis=0)], [[480.0, 50.0], [520.0, 130.0]], atol=1.0)


def test_a_short_axis_has_few_labels() -> None:
    """Those of a SCARA's heights, of which five overlapped."""
    table = [DHRow(325.0, 0.0, 300.0), DHRow(275.0, np.pi, 0.0), DHRow(0.0, 0.0, 20.0)]
    for view in (axes for axes in plan_figure(Arm(chain_of(table)), POSTURES[:20, :3]).axes if axes.name == "3d"):
        low, high = view.get_zlim()
        assert high - low < 0.5 * np.ptp(view.get_xlim())
        assert 2 <= sum(low <= tick <= high for tick in view.get_zticks()) <= 3


def test_slides_and_turning_joints_are_drawn_between_their_limits() -> None:
    """A slide of metres beside angles of degrees: each joint on its own scale, which the label says."""
    (first, *others), q = CHAIN.joints, np.array([[1000.0, *np.zeros(5)], [2000.0, *np.full(5, 1.5)]])
    arm = Arm(replace(CHAIN, joints=(replace(first, type=PRISMATIC, lower=1000.0, upper=3000.0), *others)))
    axes = next(each for each in plan_figure(arm, q).axes if "limit" in each.get_xlabel())
    assert axes.get_yticklabels()[0].get_text() == "$q_1$, 1000 to 3000 mm"
    shown = np.array([dots.get_offsets()[:, 0] for dots in axes.collections])
    np.testing.assert_allclose(shown[0], [0.0, 50.0])
    np.testing.assert_allclose(shown[1:], 100.0 * (q[:, 1:].T + np.pi) / (2.0 * np.pi))
