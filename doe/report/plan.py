"""A plan as a part of a page, in which it is stepped through, reordered and cut."""

import csv
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from doe.plan.moves import clearance_of, distance_in_words, said_of_collisions, unproven
from doe.problem.problem import DesignProblem
from doe.report.page import PlanSteps
from identification import Arm, Array, Plan
from identification.document import Pictures, Section

STEPS = (
    "Step through the runs, move them, or strike them out: what is left is computed in this page, and the edited plan "
    "is a file that armcal score reads. The figures are of criterion D for the model of the arm file alone, even if "
    "the plan was chosen by another criterion or with missing effects in mind (--robust)."
)


def plan_section(
    arm: Arm, plan: Plan, name: str = "", lead: str = "", tests: Mapping[str, Any] = MappingProxyType({})
) -> Section:
    """A part of a page in which the plan is stepped through, reordered and cut; a long one or one of weights is drawn.

    name : of the plan's file, if it has one;  tests : measurements -> what a calibrated arm in space leaves of them
    """
    from doe.report.figures import plan_figure  # deferred: tables need no pictures

    problem, postures = DesignProblem.of(arm), plan.measured
    near = said_of_collisions(problem.constraints, problem.model, postures)[1]
    if plan.weights is None and (moves := unproven(problem.constraints, plan.postures)):
        near.append(f"Moves: {len(moves)} of {len(plan) - 1} may collide on the way; armcal score names them.")
    title = f"The plan {name}".rstrip()
    if (steps := plan_steps(problem, plan, Path(name or "plan.csv").stem, tests)) is not None:
        short = [one.replace("each other:", "each other; step to a run to see which.") for one in near if one[0] != " "]
        return Section(title, [PlanSteps(lambda: [f"{lead} {STEPS}".strip(), *short], steps)])
    sentence = f"{lead} {len(postures)} runs, too many to step through or weighted: only drawn.".strip()
    return Section(title, [Pictures(lambda: [sentence, *near, plan_figure(arm, postures)])])


def plan_steps(
    problem: DesignProblem, plan: Plan, name: str = "plan", tests: Mapping[str, Any] = MappingProxyType({})
) -> dict[str, Any] | None:
    """What page.js computes log det M' of edited plans from, as `armcal score` does: rows of the file, all columns of
    which an edited plan keeps, and which rows are runs; of these lines to draw, Jacobians to 12 digits, and which
    bodies are too near to each other. None for a plan too long for it, or of weights.

    problem : of an arm;  name : of the edited file, without its ending
    """
    from doe.report.figures import outlines, scene

    def rounded(values: Array, digits: int) -> Any:
        return np.vectorize(lambda value: float(f"{value:.{digits}g}"), otypes=[float])(values).tolist()

    model: Any = problem.model
    runs, cells = plan.measured, plan.cells
    # more runs than a person steps through, or too many numbers of the Jacobians, some 12 characters each
    if plan.weights is not None or len(runs) > 200 or len(runs) * model.dimension * problem.parameters > 150_000:
        return None
    near: list[list[dict[str, Any]]] = [[] for _ in range(len(runs))]
    clearance = clearance_of(problem.constraints)
    for each in clearance.too_near(runs) if clearance else ():
        near[each["run"] - 1].append({"bodies": each["bodies"], "text": distance_in_words(each)})
    if not cells:  # those of the file that it would have
        head, *lines = csv.reader(plan.text().splitlines()[bool(plan.fit) :])
        cells = {name: texts for name, *texts in zip(head, *lines, strict=True) if name != "run"}
    steps = {
        "file": f"{name}-edited.csv",
        "comment": f"# fit: {plan.fit}" if plan.fit else "",
        "columns": list(cells),
        "rows": [list(row) for row in zip(*cells.values(), strict=True)],
        "runs": np.flatnonzero(plan.is_run).tolist(),
        "joints": plan.headings,
        "postures": rounded(plan.displayed, 6),
        "jacobians": rounded(problem.scaled_jacobians(runs).reshape(len(runs), -1), 12),
        "parameters": problem.parameters,
        "precisions": rounded(problem.precisions, 12),
        "points": rounded(model.points(runs), 5),
        "near": near,
        "outlines": [{"line": rounded(line, 5), "forbidden": forbidden} for line, forbidden in outlines(model.arm)],
    }
    return steps if model.arm.chain.projection is None else steps | {"scene": scene(model, plan.postures, tests)}
