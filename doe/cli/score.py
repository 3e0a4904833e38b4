"""`armcal score`: judge any plan."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from doe.cli.common import verb, with_collisions
from doe.cli.options import Content, Names, Seconds, plan_drawing, written
from doe.cli.problems import CriterionOptions, design_problem
from identification import InputError
from identification.document import Answer
from identification.workflow import Picture

if TYPE_CHECKING:
    from doe.design import Design
    from doe.plan.plan import Plan
    from identification import Arm, Detectability


ROBUST = "score --robust judges it so, this is of a fit by the model of the arm file alone"


@verb("armcal score arm.toml plan.csv --picture plan.png --aliases aliases.png")
def command(
    arm: Path,
    plan: Path,
    *,
    aliases: Picture | None = None,
    seconds: Seconds = 20.0,
    robust: bool = False,
    missing: Names | None = None,
    picture: Picture | None = None,
    force: bool = False,
) -> Answer:
    """Judge a plan of your own against the bound.

    Efficiency against the bound, expected standard deviations, effects that the PLAN could show.

    aliases : Draw which effects this plan can hardly distinguish.
    seconds : Time budget of the bound [s], which may be cut.
    robust : The arm may have effects of the library that its file does not name.
    missing : Only these effects, for --robust: backlash,gear_ratio
    picture : Draw the postures (.png, .svg, .pdf).
    force : Overwrite an existing file.
    """
    from doe.plan.accuracy import criterion_values, error_at_poses, observability
    from doe.plan.plan import load_plan
    from doe.problem.problem import DesignProblem
    from doe.problem.uncertain import average_error
    from doe.report.design import criteria_lines, design_document
    from identification import Model, load_arm

    loaded, criterion = load_arm(arm), CriterionOptions(robust=robust, missing=missing)
    loaded_plan = load_plan(plan, loaded.joint_types)
    design = _scored(loaded, loaded_plan, plan, criterion, seconds)
    sees, tables = _preflight(loaded, loaded_plan, plan, aliases)
    pictures: dict[Path | None, Content] = {picture: lambda: plan_drawing(loaded, loaded_plan.postures)}
    problem = DesignProblem.of(Model(loaded))
    indices, values = observability(problem, loaded_plan.postures), criterion_values(problem, loaded_plan.postures)
    tip = replace(problem, criterion=average_error(problem))
    error = None if values["I"] is None else error_at_poses(tip, values["I"], len(loaded_plan))
    meant = f"{plan} is to be fitted by armcal identify --{loaded_plan.fit}: {ROBUST}"
    lines = [meant] if loaded_plan.fit and not criterion.robust else []
    data = design.to_json() | {
        "workspace_error_mm": error,
        "observability": indices,
        "criteria": values,
        "preflight": None if sees is None else sees.to_json(),
    }
    written(pictures if sees is None else pictures | {aliases: sees.figure}, force)
    document = design_document(design).plus(*lines, *criteria_lines(data), *tables)
    return with_collisions(Answer(data, [document]), loaded)


def _scored(arm: Arm, plan: Plan, path: Path, criterion: CriterionOptions, seconds: float) -> Design:
    """The plan as a `Design`. Raises `InputError` for too few runs; warns of runs that the arm cannot reach."""
    from doe.design import score_plan
    from doe.problem.uncertain import with_choices

    problem = design_problem(arm, criterion)
    if criterion.robust or problem.choices is not None:
        problem = with_choices(problem, plan.postures)
    if len(plan) < problem.fewest_runs:
        need = f"allowed: at least {problem.fewest_runs} for {problem.parameters} parameters"
        raise InputError(f"{path}: {len(plan)} runs, {need}")
    design = score_plan(problem, plan, seconds=seconds)
    if design.outside:
        outside = f"{len(design.outside)} of {len(plan)} runs are outside joint limits or constraints, the first is run"
        warnings.warn(f"{path}: {outside} {design.outside[0]}: the bound does not apply", UserWarning, stacklevel=2)
    return design


def _preflight(arm: Arm, plan: Plan, path: Path, aliases: Path | None) -> tuple[Detectability | None, list[Any]]:
    """Which effects the plan could show, with tables; None if it has too few runs and no picture was requested."""
    from identification import detectability, without_prior

    try:
        sees = detectability(without_prior(arm), plan.postures)
    except InputError as error:  # too few runs to test for effects: a property of the plan, not bad input
        if aliases is not None:
            raise InputError(f"--aliases: {path}: {error}") from error
        return None, [f"missing effects: {error}"]
    return sees, [*sees.document().parts]
