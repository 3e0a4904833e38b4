"""`armcal relax`: approximate weights."""

from __future__ import annotations

from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, out_option, verb


@verb("armcal relax arm.toml --grid 9 --solver clarabel")
@click.argument("arm", type=FILE)
@click.option("--grid", type=click.IntRange(min=2), help="Levels per joint; left out: about 10,000 in all.")
@click.option("--candidates", type=FILE, metavar="FILE", help="CSV of allowed postures instead of a grid.")
@click.option("--solver", default="column_generation", show_default=True, help="clarabel, scs or column_generation.")
@click.option("--criterion", default="D", show_default=True, help="D, A, I, E or Ds.")
@click.option("--test-poses", type=FILE, metavar="FILE", help="CSV of postures that matter, for I.")
@click.option("--subset", help="Parameters that matter, for Ds: length_error:1,joint_offset:2")
@click.option("--check/--no-check", default=True, show_default=True, help="Cross-check by independent methods.")
@out_option
@force_option
def command(
    session: Session,
    arm: Path,
    grid: int | None,
    candidates: Path | None,
    solver: str,
    criterion: str,
    test_poses: Path | None,
    subset: str | None,
    check: bool,
    out: Path | None,
    force: bool,
) -> Answer:
    """Optimal weights over candidate postures, with a certificate recomputed from the weights and a cross-check."""
    from doe.bounds.relaxation import relax
    from doe.cli.problems import problem_of
    from doe.cross_check import cross_check
    from doe.plan.file import load_plan, plan_text
    from doe.report.approximate import cross_check_table, relax_tables
    from identification.files.arm import load_arm
    from identification.files.io import check_writable, write_whole

    loaded = load_arm(arm)
    check_writable(out, force)
    problem = problem_of(loaded, criterion, test_poses=test_poses, subset=subset)
    levels = grid or default_levels(len(problem.active_joints))
    with session.progress("relax") as progress:
        progress(0, 2, "weights")
        allowed = levels if candidates is None else load_plan(candidates, loaded.links).postures
        found = relax(problem, allowed, solver)
        data, shown = found.to_json(), relax_tables(found)
        if check:
            progress(1, 2, "cross-check")
            compared = cross_check(problem, found, max(2 * loaded.links, problem.fewest_runs), seed=session.seed)
            data["cross_check"] = compared.rows()
            shown.append(cross_check_table(compared))
    if out is not None:
        write_whole(out, plan_text(found.plan), force=force)
        shown.append(f"plan with weights written to {out}")
    return Answer(data, shown)


def default_levels(joints: int) -> int:
    """Levels per joint that give about ten thousand candidates."""
    return max(2, min(181, round(10_000 ** (1.0 / max(joints, 1)))))
