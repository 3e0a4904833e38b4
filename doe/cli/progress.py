"""Progress of a verb on standard error: a bar on a terminal, an occasional line elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import click

from identification import Progress, silent

if TYPE_CHECKING:  # deferred: it takes long to load
    from rich.progress import ProgressColumn

INTERVAL = 10.0  # seconds between lines in a log
BAR, TIME = 8, len("0:00:00")  # characters


@contextmanager
def shown_progress(title: str, quiet: bool) -> Iterator[Progress]:
    """The callback for a job (see `identification.progress`). Nothing is shown in the first half second."""
    if quiet or sys.stderr is None:  # None: closed, as by 2>&-
        yield silent
    elif sys.stderr.isatty():
        with bar(title) as report:
            yield report
    else:
        with lines(title) as report:
            yield report


@contextmanager
def bar(title: str) -> Iterator[Progress]:
    """A progress bar with the elapsed time and, if the total is known, the remaining time."""
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(*bar_columns(), console=Console(stderr=True), transient=True, expand=True) as shown:
        task = shown.add_task(title, total=None, visible=False)
        started = time.monotonic()

        def report(done: float, total: float | None, message: str) -> None:
            visible = time.monotonic() - started > 0.5
            shown.update(task, completed=done, total=total, description=message or title, visible=visible)

        yield report


def bar_columns() -> tuple[ProgressColumn, ...]:
    """Text, bar, time elapsed and left; a terminal too narrow for all of it cuts the text, never the times."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Column

    text = Column(ratio=1, no_wrap=True, overflow="ellipsis")
    times = (Column(no_wrap=True, min_width=TIME) for _ in range(2))
    return (
        TextColumn("{task.description}", markup=False, table_column=text),
        BarColumn(bar_width=BAR),
        TimeElapsedColumn(table_column=next(times)),
        TimeRemainingColumn(table_column=next(times)),
    )


@dataclass
class Lines:
    """The latest report of a job, formatted as a line of a log."""

    title: str
    started: float = field(default_factory=time.monotonic)
    done: float = 0.0
    total: float | None = None
    message: str = ""
    advanced: float = field(default_factory=time.monotonic)  # when `done` last grew

    def tell(self, done: float, total: float | None, message: str) -> None:
        """Store a report of the job."""
        if done != self.done:
            self.advanced = time.monotonic()
        self.done, self.total, self.message = done, total, message

    def text(self) -> str:
        """'armcal design: 20 s, best -1.35, 40 % done, about 30 s left'."""
        used = time.monotonic() - self.started
        parts = [f"armcal {self.title}: {used:.0f} s", *filter(None, [self.message])]
        if self.total and 0 < self.done < self.total:
            since = time.monotonic() - self.advanced
            left = max((used - since) * (self.total / self.done - 1.0) - since, 0.0)
            parts.append(f"{self.done / self.total:.0%} done, about {left:.0f} s left".replace("%", " %"))
        return ", ".join(parts)


@contextmanager
def lines(title: str, interval: float = INTERVAL) -> Iterator[Progress]:
    """Print a line every `interval` seconds, even while the job reports nothing."""
    shown, ended = Lines(title), threading.Event()

    def speak() -> None:
        while not ended.wait(interval):
            click.echo(shown.text(), err=True)

    speaker = threading.Thread(target=speak, daemon=True)
    speaker.start()
    try:
        yield shown.tell
    finally:
        ended.set()
        speaker.join()
