"""Common to the verbs with long, resumable work: where they run, where rows go, what Ctrl-C says."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from doe.cli.options import FOLDER, Decorator, force_option, grouped
from doe.cli.stopping import stopped_by
from identification.errors import JobError

if TYPE_CHECKING:
    from doe.jobs.workers import Workers


@dataclass(frozen=True)
class JobOptions:
    """Where tasks run, where their rows go, and whether earlier rows are kept or replaced."""

    workers: int | None
    cluster: str | None
    out: Path | None
    resume: bool
    force: bool

    def where(self) -> Workers:
        """The workers asked for. Raises `InputError` if the cluster does not answer."""
        from doe.jobs.workers import chosen_workers

        return chosen_workers(self.workers, self.cluster)


def job_options(*, workers: int | None, out: str) -> Decorator:
    """--workers (all cores if `workers` is None), --cluster, --out (its help), --resume and --force, as `job`."""
    shown = "all cores" if workers is None else True
    kind = click.IntRange(1, 4096)  # each is a process of about 100 MB
    return grouped(
        JobOptions,
        "job",
        click.option("--workers", type=kind, default=workers, show_default=shown, help="Tasks at the same time."),
        click.option("--cluster", metavar="ADDRESS", help="Scheduler of a dask cluster, tcp://host:port."),
        click.option("--out", type=FOLDER, metavar="DIR", help=out),
        click.option("--resume", is_flag=True, help="Go on with an interrupted or extended run."),
        force_option,
    )


def one_thread_each() -> None:
    """Limit BLAS to one thread per process, unless the user has set a number. Call it before numpy is imported.

    The matrices are small: more threads made it five times slower (measured), and the tasks use all cores already.
    """
    from doe.jobs.isolated import SINGLE_THREAD

    for name, number in SINGLE_THREAD.items():
        os.environ.setdefault(name, number)


@contextmanager
def interruptible(out: Path | None) -> Iterator[None]:
    """Report Ctrl-C or SIGTERM in one sentence: what was kept, and how to resume."""
    try:
        yield
    except KeyboardInterrupt as error:
        kept = f"finished rows are kept in {out}, go on with --resume" if out else "without --out nothing is kept"
        raise JobError(f"{stopped_by(error)}; {kept}") from None
