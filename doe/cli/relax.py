"""`armcal relax`: approximate weights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import click

from doe.cli.common import Answer, Session, verb
from doe.cli.options import FILE, Output, grouped, output_options
from doe.cli.problems import CriterionOptions, criterion_options, design_problem


@dataclass(frozen=True)
class RelaxationOptions:
    """Which postures may get weight, and by which solver."""

    grid: int | None
    candidates: Path | None
    solver: str
    check: bool


relaxation_options = grouped(
    RelaxationOptions,
    "chosen",
    click.option("--grid", type=click.IntRange(min=2), help="Levels per joint; left out: about 10,000 in all."),
    click.option("--candidates", type=FILE, metavar="FILE", help="CSV of allowed postures instead of a grid."),
    click.option(
        "--solver", default="column_generation", show_default=True, help="clarabel, scs or column_generation."
    ),
    click.option("--check/--no-check", default=True, show_default=True, help="Cross-check by independent methods."),
)


@verb("armcal relax arm.toml --grid 9 --solver clarabel", "Optimal weights over candidate postures.")
@click.argument("arm", type=FILE)
@relaxation_options
@criterion_options("D, A, E, I, Ds or Dstar.")
@output_options(out="Write the plan with weights (CSV).")
def command(
    session: Session, arm: Path, chosen: RelaxationOptions, criterion: CriterionOptions, output: Output
) -> Answer:
    """Optimal weights over candidate postures, with a certificate recomputed from the weights and a cross-check."""
    from doe.bounds.relaxation import relax
    from doe.cross_check import cross_check
    from doe.plan.file import load_plan, plan_text
    from doe.report.approximate import cross_check_table, relax_tables
    from identification.files.arm import load_arm

    loaded = load_arm(arm)
    problem = design_problem(loaded, criterion)
    levels = chosen.grid or default_levels(len(problem.active_joints))
    with session.progress("relax") as progress:
        progress(0, 2, "weights")
        listed = chosen.candidates
        found = relax(problem, levels if listed is None else load_plan(listed, loaded.links).postures, chosen.solver)
        data, shown = found.to_json(), relax_tables(found)
        if chosen.check:
            progress(1, 2, "cross-check")
            compared = cross_check(problem, found, max(2 * loaded.links, problem.fewest_runs), seed=session.seed)
            data["cross_check"] = compared.rows()
            shown.append(cross_check_table(compared))
    return Answer(data, [*shown, *output.write(plan_text(found.plan), "plan with weights")])


def default_levels(joints: int) -> int:
    """Levels per joint that give about ten thousand candidates."""
    return max(2, min(181, round(10_000 ** (1.0 / max(joints, 1)))))
