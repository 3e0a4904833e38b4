"""`armcal score`: judge any plan."""

from __future__ import annotations

import warnings
from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, verb


@verb("armcal score arm.toml plan.csv --picture plan.png --aliases aliases.png")
@click.argument("arm", type=FILE)
@click.argument("plan", type=FILE)
@click.option("--picture", type=FILE, metavar="FILE", help="Draw the postures (.png, .svg, .pdf).")
@click.option("--aliases", type=FILE, metavar="FILE", help="Draw which effects look alike on this plan.")
@force_option
def command(session: Session, arm: Path, plan: Path, picture: Path | None, aliases: Path | None, force: bool) -> Answer:
    """Score a PLAN of your own: efficiency against the bound, expected deviations, and which effects it could show."""
    from doe.plan.file import load_plan
    from doe.problem.problem import DesignProblem
    from doe.report.detectability_tables import preflight_tables
    from doe.report.tables import design_tables
    from doe.solvers import score_plan
    from identification.errors import InputError
    from identification.files.arm import load_arm
    from identification.files.io import check_writable
    from identification.gap.detectability import detectability
    from identification.model import Model

    loaded = load_arm(arm)
    check_writable(picture, force)
    check_writable(aliases, force)
    given = load_plan(plan, loaded.links)
    problem = DesignProblem.of(Model(loaded))
    if len(given) < problem.fewest_runs:
        need = f"allowed: at least {problem.fewest_runs} for {problem.parameters} parameters"
        raise InputError(f"{plan}: {len(given)} runs, {need}")
    design = score_plan(problem, given)
    data, shown = design.to_json(), design_tables(loaded, design)
    if design.outside:
        found = f"{len(design.outside)} of {len(given)} runs are outside joint limits or constraints, the first is run"
        warnings.warn(f"{plan}: {found} {design.outside[0]}: no bound holds for this plan", UserWarning, stacklevel=2)
    try:
        sees = detectability(loaded, given.postures)
    except InputError as error:  # too few runs to test for effects is a fact about the plan, not bad input
        if aliases is not None:
            raise InputError(f"--aliases: {plan}: {error}") from error
        data["preflight"] = None
        shown.append(f"missing effects: {error}")
    else:
        data["preflight"] = sees.to_json()
        shown += preflight_tables(sees)
        if aliases is not None:
            from doe.report.gap_figures import alias_figure
            from doe.report.pictures import save

            save(alias_figure(sees), aliases, force)
    if picture is not None:
        from doe.report.pictures import plan_figure, save

        save(plan_figure(loaded, given.postures), picture, force)
    return Answer(data, shown)
