"""A verb of `armcal`: a function whose signature and docstring declare arguments, options and help.

Errors are one line on standard error and an exit code, answers one JSON object or what a terminal shows of a document.
"""

from __future__ import annotations

import inspect
import json
import logging
import os
import re
import shlex
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from io import TextIOWrapper
from pathlib import Path
from shutil import get_terminal_size
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NewType, Union, get_args, get_origin, get_type_hints

import click

from identification import InputError, JobError, Progress
from identification.document import Answer
from identification.files.io import check_writable
from identification.workflow import Folder, Written

if TYPE_CHECKING:
    from identification.document import Document

# parameters that are no options: a verb that names one is given it, as a test is given a fixture by pytest
PROVIDED = ("seed", "progress", "page", "allowed")
UPDATES = frozenset((verb, "--out", "ARM") for verb in ("identify", "diagnose"))  # --force may overwrite the arm file
EVERYWHERE = {  # options that mean the same wherever they are
    "force": "Overwrite existing files.",
    "package_dir": "Folder in which packages of the URDF's meshes are; may be repeated.",
}
STANDS_FOR = {"package_dir": "DIR"}  # in the help, as these do
LONGEST_LINE = 1000  # characters of a message


Picture = NewType("Picture", Written)  # .png, .svg, .pdf


# -- types of options --------------------------------------------------------------------------------------------------
class FilePath(click.Path):
    """The name of a file that is read or written, of a picture, or of a folder, which is the verb's own to check."""

    def __init__(self, name: str = "file", *, written: bool = False, picture: bool = False) -> None:
        super().__init__(path_type=Path)
        self.name, self.written, self.picture = name, written, picture


def seconds_above_zero(text: str) -> float:
    """A time budget [s]; `nan` would be one that never ends."""
    if (seconds := float(text)) > 0.0:
        return seconds
    raise click.BadParameter(f"{text} is not in the range x>0.")


def whole_numbers(text: str) -> list[int]:
    """`10,20` as [10, 20]; every number at least 1."""
    numbers = [int(part) if part.strip().isdecimal() else 0 for part in text.split(",")]
    if min(numbers) < 1:
        raise click.BadParameter(f"found {text!r}, allowed: whole numbers >= 1, as in 10,20")
    return numbers


FOLDER = FilePath("dir", written=True)
FILES: dict[Any, click.ParamType] = {
    Path: FilePath(),
    Written: FilePath(written=True),
    Picture: FilePath(written=True, picture=True),
    Folder: FOLDER,
}
Seconds = Annotated[float, seconds_above_zero, "SECONDS"]
Workers = Annotated[int, range(1, 4097)]  # each is a process of about 100 MB
Count = Annotated[int, click.IntRange(min=1)]
WholeNumbers = Annotated[list[int], whole_numbers, "M,.."]


@dataclass(frozen=True)
class JobOptions:
    """Where tasks run, where their rows go, and whether earlier rows are kept or replaced.

    workers : Tasks at a time; left out: one per core (compare: one).
    cluster : Scheduler of a dask cluster, tcp://host:port.
    out : Folder of the tables; left out: STUDY.results (compare: none).
    resume : Continue an interrupted or extended run.
    """

    workers: Workers | None = None
    cluster: Annotated[str, "ADDRESS"] | None = None
    out: Folder | None = None
    resume: bool = False
    force: bool = False

    def how(self, seed: int, progress: Progress, workers: int | None = None) -> dict[str, Any]:
        """Arguments of `doe.jobs.run_tasks`;  workers : where none are asked for, None: as many as there are cores"""
        where = self.workers or workers or os.cpu_count() or 1 if self.cluster is None else self.cluster
        return {"workers": where, "seed": seed, "progress": progress, "resume": self.resume, "force": self.force}


# -- from a signature to a command -------------------------------------------------------------------------------------
def command(function: Callable[..., Answer], example: str) -> click.Command:
    """Turn `function(argument, .., *, option, ..) -> Answer` into the click command of its example, `armcal NAME ...`.

    Positional parameters are arguments, the others options, those of a dataclass a group of them. Their types are those
    of Python, with `Written` and `Picture` for files to write and `Folder` for where, or `Annotated` with a type of
    click or what makes the value of a word, words of the option (`--name`), a range of whole numbers, or what it stands
    for in the help (`NAMES`). The docstring's first line stands in `armcal --help`; lines `name : ..` say what an
    option is for, but for those of `EVERYWHERE`.

    Adds --json, --seed, --quiet and the example. Of `PROVIDED` are the seed, a callback for the verb's progress, what
    makes a page of a document and of files that were read, and what `identification` has of `doe`, which it does not
    know: the constraints of a model, with keys of JSON and lines on what collides at postures, and on moves along
    others.
    """
    name, (text, _), groups = example.split()[1], documented(function), dict[str, Any]()

    def parameters_of(thing: Any) -> Iterator[click.Parameter]:
        hints, (_, helps) = get_type_hints(thing, include_extras=True), documented(thing)
        for each in inspect.signature(thing).parameters.values():
            if each.name in PROVIDED:
                continue
            if is_dataclass(hint := hints[each.name]):
                groups[each.name] = hint
                yield from parameters_of(hint)
            else:
                option = thing is not function or each.kind is inspect.Parameter.KEYWORD_ONLY
                yield declared(each.name, hint, each.default, helps[each.name] if option else None)

    parameters = [
        *parameters_of(function),
        click.Option(["--json", "as_json"], is_flag=True, help="One JSON object on standard output."),
        declared("seed", Annotated[int, click.IntRange(min=0)], 0, "Random seed."),
        declared("quiet", bool, False, "No progress and no warnings on standard error."),
    ]

    def page(document: Document, read: Sequence[Path]) -> str:
        from doe.report import page

        context = click.get_current_context()
        typed = shlex.join(("armcal", *(context.find_root().obj or ())))
        return page.page(document.plus(page.origin(typed, context.params["seed"], read)))

    def allowed(model: Any, postures: Any = None, moves: Any = None) -> tuple[Any, dict[str, Any], list[str]]:
        from doe.plan.moves import said_of_collisions
        from doe.problem.constraints import constraints_of
        from identification import design_model

        kept = constraints_of(model) if model.arm.cell or model.arm.constraints else ()
        return kept, *said_of_collisions(kept, design_model(model), postures, moves)

    def run(as_json: bool, quiet: bool, seed: int, **values: Any) -> None:
        for group, type_ in groups.items():
            values[group] = type_(**{one.name: values.pop(one.name) for one in fields(type_)})
        logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it keeps its fonts is no news
        with warnings_as_lines(quiet), shown_progress(name, quiet) as progress:
            provided = {"seed": seed, "progress": progress, "page": page, "allowed": allowed}
            values |= {key: provided[key] for key in inspect.signature(function).parameters if key in provided}
            with errors_as_lines(), interruptible(", nothing was written"), stoppable():
                check_outputs(click.get_current_context())
                answer = function(**values)
            for sentence in answer.warnings if as_json else ():
                warnings.warn(sentence, UserWarning, stacklevel=2)
        shown(answer, as_json)
        sys.stdout.flush()
        sys.exit(answer.exit_code)

    texts: dict[str, Any] = {"short_help": text.split("\n")[0], "epilog": f"\b\nExample:\n  {example}"}
    return click.Command(name, callback=run, params=parameters, help=text, **texts)


def documented(thing: Any) -> tuple[str, dict[str, str]]:
    """What a docstring says without its lines `name : ..`, and these."""
    paragraphs, helps = [], dict[str, str]()
    for paragraph in (inspect.getdoc(thing) or "").split("\n\n"):
        if not re.match(r"\w+ : ", paragraph):
            paragraphs.append(paragraph)
            continue
        for line in paragraph.split("\n"):
            if match := re.match(r"(\w+) : (.*)", line):
                name, helps[match[1]] = match[1], match[2]
            else:
                helps[name] += f" {line.strip()}"
    return "\n\n".join(paragraphs), {**EVERYWHERE, **helps}


def declared(name: str, hint: Any, default: Any, help_text: str | None) -> click.Parameter:
    """A parameter of a command: an option, or an argument, which has no help."""
    extras, several = list[Any](), False
    while (origin := get_origin(hint)) in (Annotated, Union, UnionType, tuple):
        parts = get_args(hint)
        extras += parts[1:] if origin is Annotated else []
        several |= origin is tuple
        hint = next(part for part in parts if part is not NoneType)
    texts = [extra for extra in extras if isinstance(extra, str)]
    kinds = [click.IntRange(e.start, e.stop - 1) if isinstance(e, range) else e for e in extras if e not in texts]
    kind = click.Choice(get_args(hint)) if origin is Literal else FILES.get(hint, hint)
    settings: dict[str, Any] = {
        "type": next(iter(kinds), kind),
        "metavar": next((text for text in texts if not text.startswith("--")), STANDS_FOR.get(name)),
        "required": default is inspect.Parameter.empty,
    }
    if default is not inspect.Parameter.empty:
        settings["default"] = None if default == () else default
    if help_text is None:
        return click.Argument([name], nargs=-1 if several else 1, **settings)
    words = [*([text for text in texts if text.startswith("--")] or [f"--{name.replace('_', '-')}"]), name]
    if hint is bool:
        return click.Option(words, is_flag=True, default=default, show_default=bool(default), help=help_text)
    shown_default = settings.get("default") is not None
    return click.Option(words, multiple=several, show_default=shown_default, help=help_text, **settings)


# -- errors and signals ------------------------------------------------------------------------------------------------
def in_one_line(text: str) -> str:
    """A message as one line of printable characters, whatever names and cells of files it repeats: control characters
    are written as in Python; of a very long line the middle is left out.

    >>> in_one_line("arm\\nfile.toml: no such file")
    'arm\\\\nfile.toml: no such file'
    """
    text = "".join(char if char.isprintable() else repr(char)[1:-1] for char in text)
    return text if len(text) <= LONGEST_LINE else f"{text[: LONGEST_LINE * 2 // 3]} .. {text[-LONGEST_LINE // 4 :]}"


def say(sentence: str) -> None:
    """One line on standard error."""
    click.echo(f"armcal: {in_one_line(sentence)}", err=True)


def check_outputs(context: click.Context) -> None:
    """Raises `InputError`, before any work, for a file to write that cannot be written, or that is also an input or
    another output: one would overwrite the other."""
    kinds = [(kind, each) for each in context.command.params if isinstance(kind := each.type, FilePath)]
    names = dict[str, str]()  # of options and arguments, by the file
    for kind, each in sorted(kinds, key=lambda pair: pair[0].written):  # first what is read
        name = each.opts[0] if isinstance(each, click.Option) else each.human_readable_name
        given = context.params[each.name or ""]
        for path in (path for path in (given if isinstance(given, tuple) else (given,)) if isinstance(path, Path)):
            other = names.setdefault(os.path.realpath(path), name)
            if kind.written and other != name and (context.command.name, name, other) not in UPDATES:
                raise InputError(f"{name}: {path} is the file of {other} too, allowed: another name")
            if kind.written and kind is not FOLDER:
                check_writable(path, context.params["force"], picture=kind.picture)


@contextmanager
def errors_as_lines() -> Generator[None, None, None]:
    """Where there is no answer, one line says why and the command ends."""
    try:
        if sys.stdout is None:
            raise JobError("standard output is closed; send it to a file or to /dev/null")
        yield
        return
    except (InputError, JobError) as error:
        say(str(error))
        sys.exit(error.exit_code)
    except MemoryError:
        say("there is not enough memory, allowed: smaller input, or more memory")
    except ImportError as error:  # of a library in C: memory, or an installation that is not whole
        say(f"a library cannot be loaded ({error}), allowed: enough memory, and a whole installation")
    except OSError as error:  # no folder for temporary files, too many open files
        say(f"the system refuses: {error}")
    sys.exit(1)


@contextmanager
def stoppable() -> Generator[None, None, None]:
    """SIGTERM ends a verb as Ctrl-C does: finished rows stay, no process and no half-written file does. Whoever catches
    it may answer with the best so far."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stops, hooks = list[KeyboardInterrupt](), (threading.excepthook, sys.unraisablehook)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def stop(number: int, _: object) -> None:
        stops.append(KeyboardInterrupt(*([] if number == signal.SIGINT else [signal.Signals(number).name])))
        threading.excepthook = lambda _: None  # of threads whose processes are killed next
        raise stops[-1]

    def lost(unraisable: sys.UnraisableHookArgs) -> None:
        """It met the end of an object, where nothing can be raised: it comes again when this is over."""
        if (error := unraisable.exc_value) in stops:
            threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM if error.args else signal.SIGINT)).start()
        else:
            hooks[1](unraisable)

    try:
        sys.unraisablehook = lost
        for number, handler in handlers.items():
            if handler in (signal.SIG_DFL, signal.default_int_handler):
                signal.signal(number, stop)
        yield
    except (InputError, JobError):
        raise
    except Exception:  # what a library in C makes of the signal while it is loaded
        if stops:
            raise stops[0] from None
        raise
    finally:
        threading.excepthook, sys.unraisablehook = hooks
        for number, handler in handlers.items():
            signal.signal(number, handler)


@contextmanager
def interruptible(kept: str, rows: Path | None = None) -> Generator[None, None, None]:
    """Ctrl-C or SIGTERM in one sentence, whose end says what is kept, or in which folder finished rows are."""
    try:
        yield
    except (KeyboardInterrupt, click.Abort) as error:
        if rows is not None:
            there = any(rows.glob("*.parquet"))
            kept = f"; finished rows are kept in {rows}, go on with --resume" if there else "; no row was finished"
        raise JobError(f"stopped by {next(iter(error.args), 'Ctrl-C')}{kept}") from None


@contextmanager
def warnings_as_lines(quiet: bool) -> Generator[None, None, None]:
    """Warnings to standard error, one line each, each once."""
    seen: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        if (text := str(message)) not in seen and not quiet:
            say(f"warning: {text}")
        seen.add(text)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


# -- progress on standard error ----------------------------------------------------------------------------------------
@contextmanager
def shown_progress(title: str, quiet: bool, interval: float = 10.0) -> Generator[Progress, None, None]:
    """The callback for a job: a bar on a terminal, which is hidden in the first half second, else a line when it is
    called, at most every `interval` seconds."""
    started = written = time.monotonic()
    if quiet or sys.stderr is None:  # None: closed, as by 2>&-
        yield Progress()
    elif sys.stderr.isatty():
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        # first the times, so that a narrow terminal cuts the text and not them
        text = TextColumn("{task.description}", markup=False)
        columns = TimeElapsedColumn(), TimeRemainingColumn(), BarColumn(bar_width=8), text
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(title, total=None, visible=False)

            def report(done: float, total: float | None, message: str) -> None:
                visible = time.monotonic() - started > 0.5
                bar.update(task, completed=done, total=total, description=message or title, visible=visible)

            yield Progress(report)
    else:

        def tell(done: float, total: float | None, message: str) -> None:
            nonlocal written
            if time.monotonic() - written > interval:
                written = time.monotonic()
                share = f"{100.0 * done / total:.0f} % done" if total and 0 < done < total else ""
                parts = ", ".join(part for part in (f"{written - started:.0f} s", message, share) if part)
                click.echo(f"armcal {title}: {parts}", err=True)

        yield Progress(tell)


# -- output ------------------------------------------------------------------------------------------------------------
def shown(answer: Answer, as_json: bool) -> None:
    """The answer on standard output."""
    if as_json:
        from pydantic_core import to_jsonable_python

        # infinities and NaN are null
        plain = to_jsonable_python(answer.data, inf_nan_mode="null", fallback=lambda array: array.tolist())
        click.echo(json.dumps(plain, allow_nan=False))
        return
    from rich.console import Console

    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # dashes and lines of tables that its encoding does not have
    # a pipe has no width; brackets of effects are no markup
    Console(width=get_terminal_size((110, 0)).columns, highlight=False, markup=False).print(answer.document)
