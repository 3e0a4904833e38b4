"""`armcal compare`: solvers side by side."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

from doe.cli.common import verb
from doe.cli.options import Count, JobOptions, Seconds, WholeNumbers, Workers, interruptible, words
from identification import InputError, Progress, silent
from identification.document import Answer


@dataclass(frozen=True)
class OneJob(JobOptions):
    """Where tasks run, where their rows go, and whether earlier rows are kept or replaced.

    workers : Tasks at the same time.
    cluster : Scheduler of a dask cluster, tcp://host:port.
    out : Rows, summary and pictures go here; NAME.parquet: the rows only.
    resume : Go on with an interrupted or extended run.
    force : Overwrite an existing file.
    """

    workers: Workers | None = 1


@verb("armcal compare arm.toml --runs 10,20 --solvers exchange,ipopt --out runs")
def command(
    arms: Annotated[tuple[Path, ...], "ARM..."],
    *,
    runs: WholeNumbers,
    solvers: str | None = None,
    criteria: Annotated[str, "--criterion"] = "D",
    starts: WholeNumbers | None = None,
    repeats: Count = 5,
    seconds: Seconds = 60.0,
    job: OneJob,
    seed: int = 0,
    progress: Progress = silent,
) -> Answer:
    """Compare design solvers side by side.

    Each run, on the problems ARM x RUNS, is a process of its own. Every plan is evaluated on the stored problem,
    independently of its solver. Hit rate: fraction of the runs that found the best known value; with --repeats 10
    --starts 1, the fraction of good starts.

    runs : Numbers of measurements m, as in 10,20.
    solvers : Names, as in a,b; left out: all.
    criteria : D, A, E or Dstar; several as in D,A.
    starts : Starts of one run, as in 1,10; left out: the solver's own.
    repeats : Repetitions of each search, with different seeds.
    seconds : Limit of one run [s].
    """
    from doe.jobs.rows import RowTable, made, parquet
    from doe.report.studies import comparison_parts
    from doe.solvers import available_solvers
    from doe.solvers.solving import check_runs
    from doe.studies.comparison import Comparison, compare, compared_problem, summary
    from identification import load_arm

    if job.resume and job.out is None:
        raise InputError("--resume: needs --out, allowed: the folder of an earlier comparison")
    names = list(available_solvers()) if solvers is None else words(solvers)
    loaded, chosen = [load_arm(arm) for arm in arms], words(criteria)
    comparison = Comparison(loaded, runs, names, starts or [None], repeats, seconds, chosen)
    for arm, number in product(loaded, runs):
        check_runs(compared_problem(arm, chosen[0]), number)
    where = job.where()  # before the folder is made
    table_file: Path | None = job.out
    if table_file is not None and table_file.suffix != ".parquet":
        table_file = made(table_file) / "rows.parquet"
    with (
        interruptible(table_file),
        RowTable.open(table_file, resume=job.resume, force=job.force) as table,
    ):
        rows = compare(comparison, table, where, seed=seed, progress=progress)
    shown = comparison_parts(rows)
    if job.out is not None and table_file != job.out:
        from doe.report.page import svg
        from doe.report.studies import profile_figure, time_figure
        from identification.files.io import write_together

        files: dict[Path, str | bytes] = {
            job.out / "summary.parquet": parquet(summary(rows)),
            job.out / "profile.svg": svg(profile_figure(rows)),
            job.out / "time.svg": svg(time_figure(rows)),
        }
        write_together(files, force=True)
        shown.append(f"rows, summary and pictures written to {job.out}")
    return Answer({"rows": rows.drop("key").to_dicts(), "summary": summary(rows).to_dicts()}, shown)
