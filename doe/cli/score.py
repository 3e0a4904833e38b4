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
    from identification import Detectability


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
    from doe.design import score_plan
    from doe.plan.accuracy import criterion_values, error_at_poses, observability
    from doe.plan.plan import load_plan
    from doe.problem.problem import DesignProblem
    from doe.problem.uncertain import average_error, with_choices
    from doe.report.design import criteria_lines, design_document
    from identification import Model, detectability, load_arm, without_prior

    loaded, criterion = load_arm(arm), CriterionOptions(robust=robust, missing=missing)
    loaded_plan = load_plan(plan, loaded.joint_types)
    bounded = design_problem(loaded, criterion)
    if criterion.robust or bounded.choices is not None:
        bounded = with_choices(bounded, loaded_plan.postures)
    if len(loaded_plan) < bounded.fewest_runs:
        need = f"allowed: at least {bounded.fewest_runs} for {bounded.parameters} parameters"
        raise InputError(f"{plan}: {len(loaded_plan)} runs, {need}")
    design = score_plan(bounded, loaded_plan, seconds=seconds)
    if outside := design.outside:
        counted = f"{len(outside)} of {len(loaded_plan)} runs are outside joint limits or constraints"
        sentence = f"{plan}: {counted}, the first is run {outside[0]}: the bound does not apply"
        warnings.warn(sentence, UserWarning, stacklevel=2)
    sees: Detectability | None = None
    try:
        sees = detectability(without_prior(loaded), loaded_plan.postures)
        tables: list[Any] = [*sees.document().parts]
    except InputError as reason:  # too few runs to test for effects: a property of the plan, not bad input
        if aliases is not None:
            raise InputError(f"--aliases: {plan}: {reason}") from reason
        tables = [f"missing effects: {reason}"]
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
