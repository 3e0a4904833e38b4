"""What is common to all verbs: the common options, one-line errors, JSON or tables."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from doe.cli.options import FILE, FOLDER, OUTPUTS, PICTURES
from doe.cli.progress import shown_progress
from doe.cli.stopping import stoppable, stopped_by
from identification.errors import ArmcalError, InputError, JobError, in_one_line
from identification.files.io import check_writable, provide_temporary_folder
from identification.progress import Progress

if TYPE_CHECKING:
    from identification.arm import Arm
    from identification.measurements import Measurements

SHARED_MEMORY = Path("/dev/shm")  # of Linux; may be written to where nothing else may
PIPE = 110  # characters of a line where no terminal says how many it has
# the arm file with a table added to it; --force may overwrite the old one
UPDATES = frozenset((verb, "--out", "ARM") for verb in ("identify", "diagnose"))


@dataclass
class Answer:
    """The result of a verb: `data` for --json, `shown` (parts of a document, or Markdown) for the terminal."""

    data: dict[str, Any]
    shown: list[Any] = field(default_factory=list)
    exit_code: int = 0


@dataclass(frozen=True)
class CommonOptions:
    """The common options of one call."""

    as_json: bool
    quiet: bool
    seed: int

    report: Progress

    def progress(self) -> AbstractContextManager[Progress]:
        """A bar or, where standard error is no terminal, a line every ten seconds."""
        return nullcontext(self.report)


def warn_beside_json(sentences: Iterable[str]) -> None:
    """Warnings about a result, which its tables contain: with --json on standard error besides the key `warnings`."""
    for sentence in sentences if click.get_current_context().params["as_json"] else ():
        warnings.warn(sentence, UserWarning, stacklevel=2)


def with_collisions(answer: Answer, arm: Arm) -> Answer:
    """The answer that has a plan of this arm, which in space says that collisions were not looked at."""
    if arm.chain is not None:
        from doe.problem.spatial import COLLISIONS

        answer.data["collisions_checked"] = False
        answer.shown.append(COLLISIONS)
    return answer


def read_measurements(path: Path, arm: Arm) -> Measurements:
    """The measurements of an arm; warns where the units look wrong. Raises `InputError` where they certainly are."""
    from identification.files.measurement import load_measurements
    from identification.inspection.data_checks import certainly_wrong_units, data_warnings

    measurements = load_measurements(path, arm)
    if wrong := certainly_wrong_units(measurements, arm):
        raise InputError(f"{path}: {wrong}")
    for sentence in data_warnings(measurements, arm):
        warnings.warn(f"{path}: {sentence}", UserWarning, stacklevel=2)
    return measurements


def read_sessions(paths: tuple[Path, ...], arm: Arm) -> Measurements:
    """The measurements of an arm from one file or several, each of which is a session of its file's name."""
    if len(paths) == 1:
        return read_measurements(paths[0], arm)
    from identification.sessions import pooled_sessions

    real = [os.path.realpath(path) for path in paths]
    for path, there in zip(paths, real, strict=True):
        if real.count(there) > 1:
            raise InputError(f"{path}: is given {real.count(there)} times, allowed: each session once")
    stems = [path.stem for path in paths]
    names = [stem if stems.count(stem) == 1 else str(path) for path, stem in zip(paths, stems, strict=True)]
    return pooled_sessions({name: read_measurements(path, arm) for name, path in zip(names, paths, strict=True)})


def verb(
    example: str, summary: str, kind: type[click.Command] = click.Command
) -> Callable[[Callable[..., Answer]], click.Command]:
    """Turn `function(common, **options) -> Answer` into a click command of its module's name.

    summary : its line in `armcal --help`;  kind : of command

    Adds --json, --seed, --quiet and the example; errors become one line on standard error and an exit code.
    """

    def decorate(function: Callable[..., Answer]) -> click.Command:
        name = function.__module__.rpartition(".")[2]

        @wraps(function)
        def run(as_json: bool, quiet: bool, seed: int, **options: Any) -> None:
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it keeps its fonts is no news
            with _warnings_as_lines(quiet), shown_progress(name, quiet) as report:
                answer = _guarded(function, CommonOptions(as_json, quiet, seed, report), options)
            _deliver(answer, as_json)
            sys.exit(answer.exit_code)

        run = click.option("--quiet", is_flag=True, help="No progress and no warnings on standard error.")(run)
        run = click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Random seed.")(run)
        run = click.option("--json", "as_json", is_flag=True, help="One JSON object on standard output.")(run)
        return click.command(name, kind, short_help=summary, epilog=f"\b\nExample:\n  {example}")(run)

    return decorate


def say(sentence: str) -> None:
    """One line on standard error."""
    click.echo(f"armcal: {in_one_line(sentence)}", err=True)


def check_folder() -> None:
    """Raises `JobError` where the working directory has been deleted."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise JobError("the working directory is no longer there; change into another one") from None


def check_outputs(context: click.Context) -> None:
    """Raises `InputError`, before any work, for an output file that cannot be written, or that is also an input or
    another output: one would overwrite the other."""
    outputs = [*_paths(context, written=True)]
    taken = {os.path.realpath(path): name for name, _, path in _paths(context, written=False)}
    for name, kind, path in outputs:
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name and (context.command.name, name, other) not in UPDATES:
            raise InputError(f"{name}: {path} is the file of {other} too, allowed: another name")
        if kind is FILE:
            check_writable(path, context.params["force"])
    for name in PICTURES:
        if isinstance(picture := context.params.get(name), Path):
            from doe.report.page import check_picture

            check_picture(picture)
    provide_temporary_folder(*(path if kind is FOLDER else path.parent for _, kind, path in outputs), SHARED_MEMORY)


def _paths(context: click.Context, *, written: bool) -> Iterator[tuple[str, click.ParamType, Path]]:
    """Name and type of the option or argument, and path, of the files that a call writes, or of those that it reads."""
    for parameter in context.command.params:
        if isinstance(parameter.type, click.Path) and (parameter.name in OUTPUTS) is written:
            name = parameter.opts[0] if isinstance(parameter, click.Option) else parameter.human_readable_name
            given = context.params[parameter.name or ""]
            paths = given if isinstance(given, tuple) else (given,)
            yield from ((name, parameter.type, path) for path in paths if isinstance(path, Path))


def _guarded(function: Callable[..., Answer], common: CommonOptions, options: dict[str, Any]) -> Answer:
    try:
        with stoppable():
            if sys.stdout is None:
                raise JobError("standard output is closed; send it to a file or to /dev/null")
            check_folder()
            check_outputs(click.get_current_context())
            return function(common, **options)
    except ArmcalError as error:
        say(str(error))
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort) as error:
        say(f"{stopped_by(error)}, nothing was written")
        sys.exit(1)
    except MemoryError:
        say("there is not enough memory for this, allowed: less of it at once, or more memory")
        sys.exit(1)
    except ImportError as error:  # of a library in C: memory, or an installation that is not whole
        say(f"a library cannot be loaded ({error}), allowed: enough memory, and a whole installation")
        sys.exit(1)


@contextmanager
def _warnings_as_lines(quiet: bool) -> Iterator[None]:
    """Warnings to standard error, one line each, each once."""
    seen: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in seen and not quiet:
            say(f"warning: {text}")
        seen.add(text)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


def _deliver(answer: Answer, as_json: bool) -> None:
    """Print the answer; a full disk is one line. A closed pipe (`| head`) ends quietly, by click."""
    try:
        _print(answer, as_json)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        no_output(error)


def no_output(error: OSError) -> NoReturn:
    """Exit with one line on standard error: standard output cannot be written."""
    say(f"standard output cannot be written ({error.strerror})")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python tries again when it ends
    sys.exit(1)


def _print(answer: Answer, as_json: bool) -> None:
    if as_json:
        click.echo(json.dumps(plain(answer.data), allow_nan=False))
        return
    from rich.console import Console
    from rich.segment import Segment, Segments

    from identification.document import rendered

    console = Console(width=width_of_output(), highlight=False, markup=False)  # brackets of effects are no markup
    for part in answer.shown:
        for one in [part] if hasattr(part, "__rich_console__") else rendered(part, console.width):
            # names in files may have control characters, which a terminal would obey
            console.print(Segments(Segment(shown(s.text), s.style) for s in console.render(one)), end="")


def width_of_output() -> int | None:
    """Characters of a line: what COLUMNS says; else None, the terminal's own, or those of a pipe or a file."""
    said = os.environ.get("COLUMNS", "")
    if said.isdecimal() and int(said):
        return int(said)
    return None if sys.stdout.isatty() else PIPE


def shown(text: str) -> str:
    """`text` with every unprintable character except line feeds replaced by a question mark."""
    return "".join(char if char.isprintable() or char == "\n" else "?" for char in text)


def plain(value: Any) -> Any:
    """The value in JSON types: arrays as lists, paths as strings, infinities and NaN as null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value
