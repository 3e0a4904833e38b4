"""What a page needs to step through a plan: lines to draw, cells for the file, and Jacobians for log det.

The page strikes out and reorders runs and computes log det M' of what is left by itself (page.js), as `armcal score`
computes it of the file that the page hands out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from doe.plan.plan import Plan
from doe.problem.problem import DesignProblem
from doe.problem.spatial import COLLISIONS
from doe.report.page import Section
from doe.report.pictures import plan_figure, planar_outlines
from doe.report.spatial_pictures import FORBIDDEN, outlines
from identification.arm import Arm
from identification.arrays import Array
from identification.files.csv import Table
from identification.files.measurement_columns import posture_columns
from identification.model import Model

MOST_RUNS = 200  # that a person steps through
MOST = 150_000  # numbers of the Jacobians in a page, some 12 characters each
STEPS = (
    "Step through the runs, move them, or strike them out: what is left is computed in this page, and the edited plan "
    "is a file that armcal score reads. The figures are of criterion D for the model of the arm file alone, also where "
    "the plan was chosen by another criterion or with missing effects in mind (--robust)."
)
NUMBER = re.compile(r"\s*[-+]?[\d.,]+([eE][-+]?\d+)?\s*")
DIGITS = 12  # of each: log det agrees with that of `armcal score` to 1e-9


def plan_steps(arm: Arm, plan: Plan, table: Table | None = None, name: str = "plan") -> dict[str, Any] | None:
    """JSON for the page, None for a plan that is too long for it, or one of weights.

    table : the file of the plan, whose columns the edited plan keeps;  name : of the edited file, without its ending
    """
    problem = DesignProblem.of(Model(arm))
    numbers = len(plan) * problem.model.dimension * problem.parameters
    if plan.weights is not None or len(plan) > MOST_RUNS or numbers > MOST:
        return None
    jacobians = problem.scaled_jacobians(plan.postures)
    cells, around = columns(plan, table), planar_outlines(arm) if arm.chain is None else outlines(arm)
    return {
        "file": f"{name}-edited.csv",
        "comment": f"# fit: {plan.fit}" if plan.fit else "",
        "columns": list(cells),
        "rows": [list(row) for row in zip(*cells.values(), strict=True)],
        "joints": [f"q{j} [{unit}]" for j, unit in enumerate(plan.units, start=1)],
        "postures": to_digits(plan.displayed, 6),
        "jacobians": to_digits(jacobians.reshape(len(plan), -1), DIGITS),
        "parameters": problem.parameters,
        "known": to_digits(problem.precisions, DIGITS),
        "points": to_digits(Model(arm).points(plan.postures), 5),
        "outlines": [{"line": to_digits(line, 5), "forbidden": color == FORBIDDEN} for line, color in around],
    }


def plan_section(arm: Arm, plan: Plan, table: Table | None = None, name: str = "plan.csv", lead: str = "") -> Section:
    """A part of a page in which the plan is stepped through; a long one is drawn."""
    steps = plan_steps(arm, plan, table, Path(name).stem)
    lead = lead if arm.chain is None else f"{lead} {COLLISIONS}".strip()
    title = f"The plan {name}" if table is not None else "The plan"
    if steps is None:
        return Section(
            title, f"{lead} {len(plan)} runs, too many or weighted: drawn only.", (), [plan_figure(arm, plan.postures)]
        )
    return Section(title, f"{lead} {STEPS}".strip(), steps=steps)


def columns(plan: Plan, table: Table | None) -> Mapping[str, list[str]]:
    """Column -> cells of the edited plan's file: those of the table, or the postures to the last digit."""
    if table is not None:
        own = {name: table.frame[name].fill_null("").to_list() for name in table.columns if name != "run"}
        return {name: [_pointed(cell, table) for cell in cells] for name, cells in own.items()}
    found = posture_columns(plan.postures, plan.joint_types or None)
    return {name: [repr(float(cell)) for cell in cells] for name, cells in found.items()}


def _pointed(cell: str, table: Table) -> str:
    """A cell with a decimal point where the file has commas: the edited file separates columns by commas."""
    return cell.replace(",", ".") if table.decimal_commas and NUMBER.fullmatch(cell) else cell


def to_digits(values: Array, digits: int) -> Any:
    """Nested lists of numbers rounded to this many significant digits."""
    array = np.asarray(values, dtype=float)
    flat = [float(f"{value:.{digits}g}") for value in array.ravel()]
    return np.array(flat).reshape(array.shape).tolist()
