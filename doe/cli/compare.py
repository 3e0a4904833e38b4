"""`armcal compare`: solvers side by side."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import click

from doe.cli.common import FILE, Answer, Session, force_option, verb
from doe.cli.tables import cluster_option, interruptible, one_thread_each, resume_option, workers_option


def whole_numbers(context: click.Context, parameter: click.Parameter, value: str | None) -> list[int] | None:
    """`10,20` as [10, 20]; every number at least 1."""
    if value is None:
        return None
    try:
        numbers = [int(part) for part in value.split(",")]
    except ValueError:
        numbers = [0]
    if min(numbers) < 1:
        raise click.BadParameter(f"found {value!r}, allowed: whole numbers >= 1, as in 10,20")
    return numbers


@verb("armcal compare arm.toml --runs 10,20 --solvers exchange,ipopt --repeats 10 --out comparison")
@click.argument("arms", type=FILE, nargs=-1, required=True, metavar="ARM...")
@click.option("--runs", callback=whole_numbers, required=True, help="Numbers of measurements m, as in 10,20.")
@click.option("--solvers", help="Names, as in a,b; left out: all.")
@click.option("--criterion", "criteria", default="D", show_default=True, help="D, A, E or Dstar; more as in D,A.")
@click.option("--starts", callback=whole_numbers, help="Starts of one run, as in 1,10; left out: each solver's own.")
@click.option("--repeats", type=click.IntRange(min=1), default=5, show_default=True, help="Runs of each, other seeds.")
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True),
    default=60.0,
    show_default=True,
    help="Limit of one run [s].",
)
@workers_option(default=1)
@cluster_option
@click.option(
    "--out", type=FILE, metavar="DIR", help="Rows, summary and pictures go here; NAME.parquet: the rows only."
)
@resume_option
@force_option
def command(
    session: Session,
    arms: tuple[Path, ...],
    runs: list[int],
    solvers: str | None,
    criteria: str,
    starts: list[int] | None,
    repeats: int,
    seconds: float,
    workers: int,
    cluster: str | None,
    out: Path | None,
    resume: bool,
    force: bool,
) -> Answer:
    """Run design solvers side by side on the problems ARM x RUNS, each run in a process of its own.

    Every plan is judged on the stored problem, whatever its solver says. Hit rate: share of the runs that found the
    best value known. With --repeats 10 --starts 1 that is the share of good starts.
    """
    one_thread_each()
    from doe.jobs.row_table import RowTable
    from doe.jobs.workers import choose
    from doe.report.comparison import comparison_tables
    from doe.solvers import library
    from doe.solvers.driver import check_runs
    from doe.studies.comparison import Comparison, compare, problem_of, summary
    from identification.errors import InputError
    from identification.files.arm import load_arm

    if resume and out is None:
        raise InputError("--resume: needs --out, allowed: the folder of an earlier comparison")
    names = list(library()) if solvers is None else [name.strip() for name in solvers.split(",")]
    kinds = [name.strip() for name in criteria.split(",")]
    loaded = [load_arm(arm) for arm in arms]
    comparison = Comparison(loaded, runs, names, starts or [None], repeats, seconds, kinds)
    for arm, number in product(loaded, runs):
        check_runs(problem_of(arm, kinds[0]), number)
    where = choose(workers, cluster)  # before the folder is made
    table_file = rows_file(out)
    with (
        interruptible(table_file),
        session.progress("compare") as progress,
        RowTable.open(table_file, resume=resume, force=force) as table,
    ):
        rows = compare(comparison, table, where, seed=session.seed, progress=progress)
    found = summary(rows)
    shown = comparison_tables(rows)
    if out is not None and table_file != out:
        write_results(out, rows)
        shown.append(f"rows, summary and pictures written to {out}")
    return Answer({"rows": rows.drop("key").to_dicts(), "summary": found.to_dicts()}, shown)


def rows_file(out: Path | None) -> Path | None:
    """Where the rows stand: in the folder `out`, which is made, or `out` itself if it is a Parquet file."""
    from identification.errors import InputError

    if out is None or out.suffix == ".parquet":
        return out
    try:
        out.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}), allowed: a folder in an existing one") from None
    return out / "rows.parquet"


def write_results(out: Path, rows) -> None:  # type: ignore[no-untyped-def]  # polars is imported by those who have it
    """Summary and pictures beside the rows."""
    import io

    from doe.report.comparison import profile_figure, time_figure
    from doe.report.page import svg
    from doe.studies.comparison import summary
    from identification.files.io import PathLike, write_together

    buffer = io.BytesIO()
    summary(rows).write_parquet(buffer)
    pictures: dict[PathLike, str | bytes] = {
        out / "profile.svg": svg(profile_figure(rows)),
        out / "time.svg": svg(time_figure(rows)),
    }
    write_together({out / "summary.parquet": buffer.getvalue(), **pictures}, force=True)
