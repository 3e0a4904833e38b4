"""`armcal score`: judge any plan."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from doe.cli.common import Answer, Session, verb
from doe.cli.options import FILE, Output, output_options
from doe.cli.problems import CriterionOptions, design_problem, robust_options
from identification.errors import InputError

if TYPE_CHECKING:
    from doe.design import Design
    from doe.plan.plan import Plan
    from identification.arm import Arm


@verb(
    "armcal score arm.toml plan.csv --picture plan.png --aliases aliases.png",
    "Judge a plan of your own against the bound.",
)
@click.argument("arm", type=FILE)
@click.argument("plan", type=FILE)
@click.option("--aliases", type=FILE, metavar="FILE", help="Draw which effects this plan can hardly distinguish.")
@robust_options
@output_options(picture="Draw the postures (.png, .svg, .pdf).")
def command(
    session: Session, arm: Path, plan: Path, aliases: Path | None, criterion: CriterionOptions, output: Output
) -> Answer:
    """Score a PLAN of your own: efficiency against the bound, expected standard deviations, effects it could show."""
    from doe.plan.file import load_plan
    from doe.plan.observability import observability
    from doe.problem.problem import DesignProblem
    from doe.report.design_tables import design_tables, observability_line
    from identification.files.arm import load_arm
    from identification.model import Model

    loaded = load_arm(arm)
    given = load_plan(plan, loaded.joint_types)
    design = _scored(loaded, given, plan, criterion)
    preflight, tables = _preflight(loaded, given, plan, aliases, output.force)
    output.draw_plan(loaded, given.postures)
    indices = observability(DesignProblem.of(Model(loaded)), given.postures)
    data = design.to_json() | {"observability": indices.to_json(), "preflight": preflight}
    return Answer(data, [*design_tables(design), observability_line(indices), *tables])


def _scored(arm: Arm, given: Plan, path: Path, criterion: CriterionOptions) -> Design:
    """The plan judged. Raises `InputError` if it has too few runs; warns of runs that the arm cannot do."""
    from doe.design import score_plan
    from doe.problem.robust import with_choices

    problem = design_problem(arm, criterion)
    if criterion.robust:
        problem = with_choices(problem, given.postures)
    if len(given) < problem.fewest_runs:
        need = f"allowed: at least {problem.fewest_runs} for {problem.parameters} parameters"
        raise InputError(f"{path}: {len(given)} runs, {need}")
    design = score_plan(problem, given)
    if design.outside:
        found = f"{len(design.outside)} of {len(given)} runs are outside joint limits or constraints, the first is run"
        warnings.warn(f"{path}: {found} {design.outside[0]}: the bound does not apply", UserWarning, stacklevel=2)
    return design


def _preflight(
    arm: Arm, given: Plan, path: Path, aliases: Path | None, force: bool
) -> tuple[dict[str, Any] | None, list[Any]]:
    """Which effects the plan could show, as JSON and as tables; draws those that are hard to distinguish if asked."""
    from doe.problem.spatial import without_prior
    from doe.report.detectability_tables import preflight_tables
    from identification.gap.detectability import detectability

    try:
        sees = detectability(without_prior(arm), given.postures)
    except InputError as error:  # too few runs to test for effects: a property of the plan, not bad input
        if aliases is not None:
            raise InputError(f"--aliases: {path}: {error}") from error
        return None, [f"missing effects: {error}"]
    if aliases is not None:
        from doe.report.gap_figures import alias_figure
        from doe.report.pictures import save

        save(alias_figure(sees), aliases, force)
    return sees.to_json(), preflight_tables(sees)
