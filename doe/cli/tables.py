"""What the verbs with long, resumable work share: where they run, where rows go, and what Ctrl-C says."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

cluster_option = click.option("--cluster", metavar="ADDRESS", help="Scheduler of a dask cluster, tcp://host:port.")
resume_option = click.option("--resume", is_flag=True, help="Go on with an interrupted or extended run.")


def workers_option(default: int | None) -> Decorator:
    """--workers, all cores if `default` is None."""
    shown = "all cores" if default is None else True
    kind = click.IntRange(min=1)
    return click.option("--workers", type=kind, default=default, show_default=shown, help="Tasks at the same time.")


def one_thread_each() -> None:
    """One thread of linear algebra per process, unless the user says otherwise: before numpy is imported.

    Matrices here are small: more threads cost time (five times, measured), and the tasks use the cores already.
    """
    for name in THREADS:
        os.environ.setdefault(name, "1")


@contextmanager
def interruptible(out: Path | None) -> Iterator[None]:
    """Ctrl-C as a sentence that says what is kept, and how to go on."""
    from identification.errors import JobError

    try:
        yield
    except KeyboardInterrupt:
        kept = f"finished rows are kept in {out}, go on with --resume" if out else "without --out nothing is kept"
        raise JobError(f"stopped by Ctrl-C; {kept}") from None
