"""What a plan's tables show, and leave out."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from rich.console import Console
from rich.table import Table

from doe.bounds.bound import Bound
from doe.design import score
from doe.problem.robust import missing_effects, robust_problem
from doe.report.design_tables import (
    accuracy_table,
    expected_error,
    held_by_machining,
    held_lines,
    missing_lines,
    repeats_line,
    summary_table,
)
from identification.arm import Arm
from tests.doe.arms import problem
from tests.doe.six_axis import six_axis


def test_effects_that_may_be_missing_are_counted_not_listed() -> None:
    plain = six_axis()
    wide = robust_problem(plain, missing_effects(plain, ["gear_ratio"]))
    design = score(wide, np.random.default_rng(3).uniform(-2.0, 2.0, (16, 6)))
    found = accuracy_table(design)
    assert isinstance(found, Table)
    weak = held_by_machining(wide, design.deviations)
    assert found.row_count == len(plain.model.parameters) - len(weak)
    known = {p.name: std for p, std in zip(design.deviations.parameters, design.deviations.values, strict=True)}
    assert 0 < len(weak) == sum(known[name] > 0.5 * size for name, size in plain.deviations.items())
    assert held_lines(design)[0].plain.startswith(f"and {len(weak)} more that these postures hardly determine")
    console = Console(width=100, file=io.StringIO())
    with console.capture() as capture:
        console.print(found)
    assert "rotation_x:2 [deg]" in capture.get()
    assert "gear_ratio" not in capture.get()
    assert "if effects of typical size may be missing" in str(found.title)
    assert "if the model is complete" in str(getattr(accuracy_table(score(plain, design.plan.postures)), "title", ""))
    assert any("6 parameters of gear_ratio" in line.plain for line in missing_lines(design))


def test_a_random_plan_of_very_many_runs_is_called_so() -> None:
    """It is what is left where postures of a better plan would be too near each other."""
    plan = np.random.default_rng(4).uniform(-1.0, 1.0, (101, 3))
    found = score(problem(Arm([260.0, 180.0, 120.0])), plan)
    (line,) = repeats_line(replace(found, solver="random"))
    assert line.plain.startswith("the plan is random: none was found that is better with 101 postures")
    assert "--repeats" in line.plain
    assert not any("random" in said.plain for said in repeats_line(replace(found, solver="fedorov")))


def test_a_robust_plan_is_judged_by_millimetres() -> None:
    """The values of criterion I, which mean nothing to a reader, give way; what the bound allows stands beside it."""
    plain = problem(Arm([260.0, 180.0, 120.0], sigma=0.1))
    wide = robust_problem(plain, missing_effects(plain, ["gear_ratio"]))
    data = score(wide, np.random.default_rng(3).uniform(-1.0, 1.0, (8, 3))).to_json()
    data |= {"bound": Bound(-1.0, "grid", True, candidates=2000).as_dict(), "efficiency": 0.3, "outside_limits": []}
    data["no_efficiency"] = None
    console = Console(width=100, file=io.StringIO())
    with console.capture() as capture:
        console.print(summary_table(data, ""))
    said = " ".join(capture.get().split())
    assert data["expected_error_mm"] is not None
    assert "efficiency 0.300000 of the bound (the list of 2,000 postures, proven). Do not expect it near 1:" in said
    assert "value of I" not in said
    assert "upper bound" not in said


def test_criterion_i_is_said_in_mm() -> None:
    bound = Bound(-1.0, "grid", True, candidates=2000).as_dict()
    data = {"expected_error_mm": {"plan": 0.1723, "bound": 0.1391}, "outside_limits": [], "bound": bound}
    said = "0.172 mm at the tip, RMS over the workspace or --test-poses"
    assert expected_error(data) == f"{said}; no plan from the list of 2,000 postures is below 0.139 mm"
    everywhere = {**data, "bound": Bound(-1.0, "continuous").as_dict()}
    assert expected_error(everywhere) == f"{said}; no plan from all postures is below 0.139 mm (a numerical bound)"
    assert expected_error({**data, "outside_limits": [3]}) == said  # no bound applies
    assert expected_error({"expected_error_mm": None}) is None
