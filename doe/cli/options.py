"""Types of options that several verbs share, groups of options that a verb gets as one object, and what writes files.

A verb's parameter of one of these types is an option of it (`common.verb`); a dataclass is a group, whose fields are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from doe.cli.stopping import stopped_by
from identification import JobError
from identification.document import picture_bytes
from identification.files.io import write_together
from identification.workflow import Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from doe.jobs.running import Workers as Pool
    from identification import Arm, Array

Content = str | bytes | Callable[[], "Figure"]


class FilePath(click.Path):
    """The name of a file that is read or written, of a picture, or of a folder, which is the verb's own to check."""

    def __init__(self, name: str = "file", *, written: bool = False, picture: bool = False) -> None:
        super().__init__(path_type=Path)
        self.name, self.written, self.picture = name, written, picture


class FileOrShare(FilePath):
    """The name of a file, or a number between 0 and 1."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """A path or a float."""
        try:
            share = float(value)
        except (TypeError, ValueError):
            return super().convert(value, param, ctx)
        if not 0.0 < share < 1.0:
            self.fail(f"{value} is not in the range 0<x<1 (a file of this name: ./{value}).", param, ctx)
        return share


class SecondsRange(click.FloatRange):
    """A time budget [s] above zero; `nan` would be one that never ends."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As in click, without `nan`."""
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail("nan is not in the range x>0.", param, ctx)
        return number


class WholeNumbersType(click.ParamType):
    """`10,20` as [10, 20]; every number at least 1."""

    name = "m,.."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[int]:
        """The numbers."""
        numbers = [int(part) if part.strip().isdecimal() else 0 for part in str(value).split(",")]
        if min(numbers) < 1:
            self.fail(f"found {value!r}, allowed: whole numbers >= 1, as in 10,20", param, ctx)
        return numbers


FOLDER = FilePath("dir", written=True)
Seconds = Annotated[float, SecondsRange(min=0, min_open=True)]
Workers = Annotated[int, click.IntRange(1, 4096)]  # each is a process of about 100 MB
Names = Annotated[str, "NAMES"]
Count = Annotated[int, click.IntRange(min=1)]
WholeNumbers = Annotated[list[int], WholeNumbersType()]


# -- files -------------------------------------------------------------------------------------------------------------
def written(contents: Mapping[Path | None, Content], force: bool, what: str = "") -> list[str]:
    """Write the files that were asked for, all or none, pictures among them; the lines that report the texts.

    contents : file -> its content, or what draws a picture; None: not asked for;  what : the text is
    """
    wanted = {path: content for path, content in contents.items() if path is not None}
    files: dict[Path, str | bytes] = {}
    for path, content in wanted.items():
        if isinstance(content, str | bytes):
            files[path] = content
        else:
            files[path] = picture_bytes(content(), path)
    write_together(files, force=force)
    return [f"{what} written to {path}" for path, content in wanted.items() if isinstance(content, str)]


def plan_drawing(arm: Arm, postures: Array) -> Figure:
    """An arm at the postures (m, n) [rad]."""
    from doe.report.figures import plan_figure  # deferred: matplotlib takes longer to load than a small design

    return plan_figure(arm, postures)


def words(text: str) -> list[str]:
    """`a, b` as ["a", "b"]."""
    return [word.strip() for word in text.split(",")]


# -- long work ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class JobOptions:
    """Where tasks run, where their rows go, and whether earlier rows are kept or replaced.

    workers : Tasks at the same time; left out: on all cores.
    cluster : Scheduler of a dask cluster, tcp://host:port.
    out : Folder; left out: STUDY.results
    resume : Go on with an interrupted or extended run.
    force : Overwrite an existing file.
    """

    workers: Workers | None = None
    cluster: Annotated[str, "ADDRESS"] | None = None
    out: Folder | None = None
    resume: bool = False
    force: bool = False

    def where(self) -> Pool:
        """The workers asked for. Raises `InputError` if the cluster does not answer."""
        from doe.jobs.running import chosen_workers

        return chosen_workers(self.workers, self.cluster)


@contextmanager
def interruptible(out: Path | None) -> Iterator[None]:
    """Report Ctrl-C or SIGTERM in one sentence: what was kept, and how to resume."""
    try:
        yield
    except KeyboardInterrupt as error:
        kept = f"finished rows are kept in {out}, go on with --resume" if out else "without --out nothing is kept"
        raise JobError(f"{stopped_by(error)}; {kept}") from None
