"""`armcal design`: choose the postures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from doe.cli.common import Answer, CommonOptions, verb, with_collisions
from doe.cli.options import FILE, Output, Seconds, grouped, output_options, plan_drawing
from doe.cli.problems import CriterionOptions, PostureOptions, criterion_options, design_problem, posture_options
from identification.errors import InputError

if TYPE_CHECKING:
    from doe.design import Design
    from doe.problem.problem import DesignProblem
    from identification.arm import Arm


@dataclass(frozen=True)
class SearchOptions:
    """Settings of the search, and the order of measurement."""

    runs: int
    solver: str | None
    starts: int | None
    seconds: float | None
    discriminating: bool
    loss: float
    order: str | None

    @property
    def effort(self) -> dict[str, Any]:
        """Arguments of `solve`."""
        return {"solver": self.solver, "starts": self.starts, "seconds": self.seconds}


search_options = grouped(
    SearchOptions,
    "search",
    click.option("--runs", type=click.IntRange(1, 100_000), required=True, help="Number of (new) measurements m."),
    click.option("--solver", help="Method; left out: the best for the problem."),
    click.option("--starts", type=click.IntRange(min=1), help="Number of starts."),
    click.option("--seconds", type=Seconds(), help="Time budget [s]; left out: none up to 100 runs, 30 for more."),
    click.option(
        "--discriminating", is_flag=True, help="Also make missing effects distinguishable (costs some D-efficiency)."
    ),
    click.option(
        "--loss", default=0.05, show_default=True, help="Largest loss of D-efficiency that --discriminating accepts."
    ),
    click.option("--order", help="given, travel (least joint travel) or random."),
)


@verb("armcal design arm.toml --runs 20 --out plan.csv", "Choose the postures to measure, with a certificate.")
@click.argument("arm", type=FILE)
@search_options
@criterion_options("D, A, E, I, Ds or Dstar.")
@posture_options
@output_options(picture="Draw the postures (.png, .svg, .pdf).", out="Write the plan (CSV).")
def command(
    common: CommonOptions,
    arm: Path,
    search: SearchOptions,
    criterion: CriterionOptions,
    postures: PostureOptions,
    output: Output,
) -> Answer:
    """Choose the RUNS postures that calibrate the arm best, with a certificate of how good they are."""
    from doe.plan.file import plan_text
    from doe.plan.order import check_order
    from doe.plan.tip_error import tip_beside_random
    from doe.problem.robust import with_choices
    from doe.report.design import design_document, missing_lines
    from doe.report.identification import identify_command
    from identification.files.arm import load_arm

    check_used(click.get_current_context())
    loaded = load_arm(arm)
    check_order(search.order)
    if criterion.robust and search.discriminating:
        raise InputError("--discriminating: found with --robust, allowed: one of them")
    problem = design_problem(loaded, criterion, postures, common.seed)
    if criterion.robust and search.solver in (None, "fedorov"):
        problem = with_choices(problem)
    design, data, extra = _searched(common, problem, loaded, search)
    extra += missing_lines(design) if not search.discriminating else []
    expected = tip_beside_random(design.problem, design.plan.postures, common.seed)
    data["expected_tip"] = None if expected is None else expected.to_json()
    extra += [] if expected is None else [str(expected)]
    if search.order is not None:
        design = _ordered(design, search.order, common.seed, data, extra)
    extra += output.write_all(
        plan_text(design.plan, loaded.joint_types),
        "plan",
        {output.picture: lambda: plan_drawing(loaded, design.plan.postures)},
    )
    first = "--out plan.csv writes this plan; " if output.out is None else ""
    then = f"; then {identify_command(str(arm), 'DATA', problem.fit)}" if problem.fit else ""
    extra.append(f"Next: {first}measure the tip at these postures, then armcal check {arm} DATA{then}")
    return with_collisions(Answer(design.to_json() | data, [design_document(design).plus(*extra)]), loaded)


def _searched(
    common: CommonOptions, problem: DesignProblem, arm: Arm, search: SearchOptions
) -> tuple[Design, dict[str, Any], list[Any]]:
    """The design, with the JSON keys and tables that a discriminating design adds."""
    from doe.solvers import solve

    effort = search.effort | {"seed": common.seed}
    with common.progress() as progress:
        if not search.discriminating:
            return solve(problem, search.runs, progress=progress, **effort), {}, []
        from doe.discrimination.design import discrimination_design
        from doe.report.design import discriminating_parts

        found = discrimination_design(problem, arm, search.runs, loss=search.loss, progress=progress, **effort)
        return found.design, found.to_json(), discriminating_parts(found)


def _ordered(design: Design, order: str, seed: int, data: dict[str, Any], extra: list[Any]) -> Design:
    """The same runs in the requested order; adds the travel to `data` and `extra`."""
    from doe.plan.order import ordered

    sequence = ordered(design.plan, order, seed=seed)
    data["travel_deg"] = sequence.to_json()
    before, after = (math.degrees(travel) for travel in (sequence.before, sequence.after))
    extra.append(f"order {order}: joint travel {before:.0f} -> {after:.0f} deg ({sequence.saved:.0%} saved)")
    return replace(design, plan=sequence.plan)


def check_used(context: click.Context) -> None:
    """Raises `InputError` for a number that is given without the option it belongs to."""
    for name, needed in (("loss", "discriminating"), ("draws", "uncertain")):
        given = context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if given and not context.params[needed]:
            raise InputError(f"--{name}: found without --{needed}, allowed: with --{needed}")
