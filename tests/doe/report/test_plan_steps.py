"""What a page gets of a plan: Jacobians that give its log det, and the cells of its file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from doe.design import score
from doe.plan.file import load_plan
from doe.plan.plan import Plan
from doe.problem.problem import DesignProblem
from doe.report.plan_steps import plan_section, plan_steps
from identification.arm import Arm
from identification.files.csv import read_table
from identification.model import Model
from identification.workspace import KeepOutCircle, LineOfSight, WorkspaceBox
from tests.doe.six_axis import SIX_AXIS

AROUND = (WorkspaceBox((-500.0, 500.0), (-400.0, 600.0)), KeepOutCircle((700.0, 0.0), 50.0))
ARM = Arm([300.0, 200.0], sigma=0.1, constraints=(*AROUND, LineOfSight((900.0, 0.0), 0.5, (0.0, 0.0))))


@pytest.mark.parametrize(("arm", "joints", "runs"), [(ARM, 2, 9), (SIX_AXIS, 6, 16)])
def test_the_log_det_of_a_plan_follows_from_what_the_page_has(arm: Arm, joints: int, runs: int) -> None:
    plan = Plan(np.random.default_rng(1).uniform(-2.0, 2.0, (runs, joints)))
    steps = plan_steps(arm, plan)
    assert steps is not None
    p = steps["parameters"]
    rows = np.array(steps["jacobians"]).reshape(-1, p)
    log_det = np.linalg.slogdet((rows.T @ rows + np.diag(steps["known"])) / runs)[1]
    assert log_det == pytest.approx(score(DesignProblem.of(Model(arm)), plan).log_det, abs=1e-8)
    np.testing.assert_allclose(np.array(steps["rows"], dtype=float), np.degrees(plan.postures), atol=1e-11)
    np.testing.assert_allclose(steps["points"], Model(arm).points(plan.postures), rtol=1e-4, atol=1e-2)


def test_outlines_of_a_plane_lie_on_what_they_show() -> None:
    steps = plan_steps(ARM, Plan(np.ones((4, 2))))
    assert steps is not None
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
        plan = load_plan(path)
    steps = plan_steps(ARM, plan, read_table(path), "mine")
    assert steps is not None
    assert steps["columns"] == ["q1_deg", "q2_deg", "payload_kg", "note"]
    assert steps["rows"] == [["1.5", "-20", "2.5", "a, b"], ["30", "40", "0", "c"]]
    assert steps["file"] == "mine-edited.csv"


def test_long_and_weighted_plans_are_drawn_only() -> None:
    for plan in (Plan(np.ones((201, 2))), Plan(np.ones((2, 2)), np.array([0.25, 0.75]))):
        assert plan_steps(ARM, plan) is None
    drawn = plan_section(ARM, plan)
    assert drawn.steps is None
    assert len(drawn.figures) == 1
