"""`armcal design`: choose the postures."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Seconds, Session, force_option, out_option, verb


@verb("armcal design arm.toml --runs 20 --out plan.csv")
@click.argument("arm", type=FILE)
@click.option("--runs", type=click.IntRange(min=1), required=True, help="Number of measurements m.")
@click.option("--solver", help="Method; left out: the best for the problem.")
@click.option("--starts", type=click.IntRange(min=1), help="Number of starts.")
@click.option("--seconds", type=Seconds(), help="Time budget [s].")
@out_option
@force_option
def command(
    session: Session,
    arm: Path,
    runs: int,
    solver: str | None,
    starts: int | None,
    seconds: float | None,
    out: Path | None,
    force: bool,
) -> Answer:
    """Choose the RUNS postures that calibrate the arm best, with a certificate of how good they are."""
    from doe.plan_file import plan_text
    from doe.problem import DesignProblem
    from doe.report.tables import design_tables
    from doe.solvers import solve
    from identification.arm_file import load_arm
    from identification.files import check_writable, write_whole
    from identification.model import Model

    loaded = load_arm(arm)
    check_writable(out, force)
    problem = DesignProblem.of(Model(loaded))
    with session.progress("design") as progress:
        design = solve(problem, runs, solver, seed=session.seed, starts=starts, seconds=seconds, progress=progress)
    if out is not None:
        write_whole(out, plan_text(design.plan), force=force)
    return Answer(design.to_json(), [*design_tables(loaded, design), *([f"plan written to {out}"] if out else [])])
