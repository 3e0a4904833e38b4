"""`armcal design`: choose the postures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from doe.cli.common import FILE, Answer, Seconds, Session, force_option, out_option, verb

if TYPE_CHECKING:
    from identification.arm import Arm


@verb("armcal design arm.toml --runs 20 --out plan.csv")
@click.argument("arm", type=FILE)
@click.option("--runs", type=click.IntRange(1, 100_000), required=True, help="Number of (new) measurements m.")
@click.option("--criterion", default="D", show_default=True, help="D, A, E, I, Ds or Dstar.")
@click.option("--test-poses", type=FILE, metavar="FILE", help="CSV of postures that matter, for criterion I.")
@click.option("--subset", help="Parameters that matter, for Ds: length_error:1,joint_offset:2")
@click.option("--solver", help="Method; left out: the best for the problem.")
@click.option("--starts", type=click.IntRange(min=1), help="Number of starts.")
@click.option("--seconds", type=Seconds(), help="Time budget [s]; left out: none up to 100 runs, 30 for more.")
@click.option("--discriminating", is_flag=True, help="A plan that shows missing effects, too, and tells them apart.")
@click.option("--loss", default=0.05, show_default=True, help="D-efficiency that --discriminating may give up.")
@click.option("--keep", type=FILE, metavar="FILE", help="Postures measured already; the new ones go around them.")
@click.option("--candidates", type=FILE, metavar="FILE", help="CSV of allowed postures to choose from.")
@click.option("--repeats", is_flag=True, help="A posture may be measured more than once.")
@click.option("--minimum-distance-deg", type=float, help="Postures differ by this in some joint (1 deg).")
@click.option("--uncertain", help="average or worst: a plan for an arm known only up to a prior (or its covariance).")
@click.option("--draws", type=click.IntRange(1, 50), default=5, show_default=True, help="Arms drawn for --uncertain.")
@click.option("--order", help="given, travel (least joint travel) or random.")
@click.option("--picture", type=FILE, metavar="FILE", help="Draw the postures (.png, .svg, .pdf).")
@out_option
@force_option
def command(
    session: Session,
    arm: Path,
    runs: int,
    criterion: str,
    test_poses: Path | None,
    subset: str | None,
    solver: str | None,
    starts: int | None,
    seconds: float | None,
    discriminating: bool,
    loss: float,
    keep: Path | None,
    candidates: Path | None,
    repeats: bool,
    minimum_distance_deg: float | None,
    uncertain: str | None,
    draws: int,
    order: str | None,
    picture: Path | None,
    out: Path | None,
    force: bool,
) -> Answer:
    """Choose the RUNS postures that calibrate the arm best, with a certificate of how good they are."""
    from dataclasses import replace

    from doe.cli.problems import problem_of
    from doe.plan.file import plan_text
    from doe.plan.order import check_order, ordered
    from doe.report.tables import design_tables, order_line
    from doe.solvers import solve
    from identification.files.arm import load_arm
    from identification.files.io import check_writable, write_whole

    check_used(click.get_current_context())
    loaded = load_arm(arm)
    check_writable(out, force)
    check_writable(picture, force)
    check_order(order)
    problem = problem_of(
        loaded,
        criterion,
        test_poses=test_poses,
        subset=subset,
        keep=keep,
        candidates=candidates,
        repeats=repeats,
        minimum_distance_deg=minimum_distance_deg,
        uncertain=uncertain,
        draws=draws,
        seed=session.seed,
    )
    effort: dict[str, Any] = {"solver": solver, "seed": session.seed, "starts": starts, "seconds": seconds}
    data: dict[str, Any] = {}
    extra: list[Any] = []
    with session.progress("design") as progress:
        if discriminating:
            from doe.discrimination.design import discrimination_design as search
            from doe.report.detectability_tables import discriminating_data, discriminating_tables

            found = search(problem, loaded, runs, loss=loss, progress=progress, **effort)
            design, data, extra = found.design, discriminating_data(found), discriminating_tables(found)
        else:
            design = solve(problem, runs, progress=progress, **effort)
    if order is not None:
        sequence = ordered(design.plan, order, seed=session.seed)
        data["travel_deg"] = sequence.to_json()
        extra.append(order_line(sequence))
        design = replace(design, plan=sequence.plan)
    if out is not None:
        write_whole(out, plan_text(design.plan), force=force)
        extra.append(f"plan written to {out}")
    draw(loaded, design.plan.postures, picture, force)
    return Answer(design.to_json() | data, [*design_tables(loaded, design), *extra])


def check_used(context: click.Context) -> None:
    """Raises `InputError` for a number that is given without the option it belongs to."""
    from identification.errors import InputError

    for name, needed in (("loss", "discriminating"), ("draws", "uncertain")):
        given = context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
        if given and not context.params[needed]:
            raise InputError(f"--{name}: has no use here, allowed: with --{needed}")


def draw(arm: Arm, postures: Any, picture: Path | None, force: bool) -> None:
    """The plan as a picture, if one is asked for."""
    if picture is None:
        return
    from doe.report.pictures import plan_figure, save

    save(plan_figure(arm, postures), picture, force)
