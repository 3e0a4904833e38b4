"""`armcal compare`: solvers side by side."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import click

from doe.cli.common import Answer, CommonOptions, verb
from doe.cli.jobs import JobOptions, interruptible, job_options
from doe.cli.options import FILE, Seconds, grouped
from identification.errors import InputError

if TYPE_CHECKING:
    import polars

    from doe.studies.comparison import Comparison
    from identification.arm import Arm


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


@dataclass(frozen=True)
class ComparisonOptions:
    """The options that define the comparison."""

    runs: list[int]
    solvers: str | None
    criteria: str
    starts: list[int] | None
    repeats: int
    seconds: float

    def of(self, arms: list[Arm]) -> Comparison:
        """The comparison. Raises `InputError` for unknown names and for too few runs."""
        from doe.solvers import available_solvers
        from doe.solvers.solvability import check_runs
        from doe.studies.comparison import Comparison, compared_problem

        solvers = list(available_solvers()) if self.solvers is None else _words(self.solvers)
        criteria = _words(self.criteria)
        found = Comparison(arms, self.runs, solvers, self.starts or [None], self.repeats, self.seconds, criteria)
        for arm, number in product(arms, self.runs):
            check_runs(compared_problem(arm, criteria[0]), number)
        return found


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",")]


comparison_options = grouped(
    ComparisonOptions,
    "compared",
    click.option("--runs", callback=whole_numbers, required=True, help="Numbers of measurements m, as in 10,20."),
    click.option("--solvers", help="Names, as in a,b; left out: all."),
    click.option(
        "--criterion", "criteria", default="D", show_default=True, help="D, A, E or Dstar; several as in D,A."
    ),
    click.option("--starts", callback=whole_numbers, help="Starts of one run, as in 1,10; left out: the solver's own."),
    click.option(
        "--repeats",
        type=click.IntRange(min=1),
        default=5,
        show_default=True,
        help="Repetitions of each search, with different seeds.",
    ),
    click.option("--seconds", type=Seconds(), default=60.0, show_default=True, help="Limit of one run [s]."),
)


@verb(
    "armcal compare arm.toml --runs 10,20 --solvers exchange,ipopt --out runs",
    "Compare design solvers side by side.",
)
@click.argument("arms", type=FILE, nargs=-1, required=True, metavar="ARM...")
@comparison_options
@job_options(workers=1, out="Rows, summary and pictures go here; NAME.parquet: the rows only.")
def command(common: CommonOptions, arms: tuple[Path, ...], compared: ComparisonOptions, job: JobOptions) -> Answer:
    """Run design solvers side by side on the problems ARM x RUNS, each run in a separate process.

    Every plan is evaluated on the stored problem, independently of its solver. Hit rate: fraction of the runs that
    found the best known value; with --repeats 10 --starts 1, the fraction of good starts.
    """
    from doe.jobs.row_table import RowTable
    from doe.report.studies import comparison_parts
    from doe.studies.comparison import compare, summary
    from identification.files.arm import load_arm

    if job.resume and job.out is None:
        raise InputError("--resume: needs --out, allowed: the folder of an earlier comparison")
    comparison = compared.of([load_arm(arm) for arm in arms])
    where = job.where()  # before the folder is made
    table_file = rows_file(job.out)
    with (
        interruptible(table_file),
        common.progress() as progress,
        RowTable.open(table_file, resume=job.resume, force=job.force) as table,
    ):
        rows = compare(comparison, table, where, seed=common.seed, progress=progress)
    shown = comparison_parts(rows)
    if job.out is not None and table_file != job.out:
        write_results(job.out, rows)
        shown.append(f"rows, summary and pictures written to {job.out}")
    return Answer({"rows": rows.drop("key").to_dicts(), "summary": summary(rows).to_dicts()}, shown)


def rows_file(out: Path | None) -> Path | None:
    """The Parquet file of the rows: `out` itself if it names one, else a file in the folder `out`, which is created."""

    from doe.jobs.row_table import made

    return out if out is None or out.suffix == ".parquet" else made(out) / "rows.parquet"


def write_results(out: Path, rows: polars.DataFrame) -> None:
    """Summary and pictures beside the rows."""
    from doe.jobs.row_table import parquet
    from doe.report.page import svg
    from doe.report.studies import profile_figure, time_figure
    from doe.studies.comparison import summary
    from identification.files.io import PathLike, write_together

    files: dict[PathLike, str | bytes] = {
        out / "summary.parquet": parquet(summary(rows)),
        out / "profile.svg": svg(profile_figure(rows)),
        out / "time.svg": svg(time_figure(rows)),
    }
    write_together(files, force=True)
