"""What is common to all verbs: options from the signature of a function, one-line errors, JSON or tables."""

from __future__ import annotations

import inspect
import json
import logging
import math
import os
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

import click

from doe.cli.options import FOLDER, FilePath
from doe.cli.progress import shown_progress
from doe.cli.stopping import stoppable, stopped_by
from identification.errors import ArmcalError, InputError, JobError, in_one_line
from identification.files.io import check_writable, provide_temporary_folder
from identification.progress import Progress

if TYPE_CHECKING:
    from doe.report.page import Origin
    from identification.arm import Arm
    from identification.measurements import Measurements

SHARED_MEMORY = Path("/dev/shm")  # of Linux; may be written to where nothing else may
PIPE = 110  # characters of a line where no terminal says how many it has
WORDS = "armcal.words"  # in the context's `meta`: what was typed after `armcal`
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
    """The common options of one call; report : a bar or, where standard error is no terminal, a line every ten
    seconds."""

    as_json: bool
    quiet: bool
    seed: int
    report: Progress


# -- from a signature to a command -------------------------------------------------------------------------------------
def verb(example: str, kind: type[click.Command] = click.Command) -> Callable[[Callable[..., Answer]], click.Command]:
    """Turn `function(common, argument, .., *, option, ..) -> Answer` into a click command of its module's name.

    Positional parameters are arguments, the others options, those of a dataclass a group of them. Their types are those
    of Python or `Annotated` with a type of click, words of the option (`--name`) or what it stands for in the help
    (`NAMES`). The docstring's first line stands in `armcal --help`; lines `name : ..` say what an option is for.

    Adds --json, --seed, --quiet and the example; errors become one line on standard error and an exit code.
    """

    def decorate(function: Callable[..., Answer]) -> click.Command:
        name = function.__module__.rpartition(".")[2]
        text, helps = _documented(function)
        hints, parameters = get_type_hints(function, include_extras=True), list[click.Parameter]()
        groups: dict[str, Any] = {}
        for parameter in list(inspect.signature(function).parameters.values())[1:]:
            hint, default = hints[parameter.name], parameter.default
            if is_dataclass(hint):
                groups[parameter.name] = hint
                inner, of_group = get_type_hints(hint, include_extras=True), _documented(hint)[1]
                for each in fields(hint):
                    value = inspect.Parameter.empty if each.default is MISSING else each.default
                    parameters.append(_option(each.name, inner[each.name], value, of_group[each.name]))
            elif parameter.kind is inspect.Parameter.KEYWORD_ONLY:
                parameters.append(_option(parameter.name, hint, default, helps[parameter.name]))
            else:
                parameters.append(_argument(parameter.name, hint, default))
        parameters += [
            click.Option(["--json", "as_json"], is_flag=True, help="One JSON object on standard output."),
            _option("seed", Annotated[int, click.IntRange(min=0)], 0, "Random seed."),
            _option("quiet", bool, False, "No progress and no warnings on standard error."),
        ]

        def run(as_json: bool, quiet: bool, seed: int, **values: Any) -> None:
            for group, type_ in groups.items():
                values[group] = type_(**{each.name: values.pop(each.name) for each in fields(type_)})
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it keeps its fonts is no news
            with _warnings_as_lines(quiet), shown_progress(name, quiet) as report:
                answer = _guarded(function, CommonOptions(as_json, quiet, seed, report), values)
            _deliver(answer, as_json)
            sys.exit(answer.exit_code)

        epilog = f"\b\nExample:\n  {example}"
        return kind(name, callback=run, params=parameters, help=text, short_help=text.split("\n")[0], epilog=epilog)

    return decorate


def _documented(thing: Any) -> tuple[str, dict[str, str]]:
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
    return "\n\n".join(paragraphs), helps


def _unwrapped(hint: Any) -> tuple[Any, list[Any]]:
    """A type without None and `Annotated`, and what it was annotated with."""
    if get_origin(hint) is Annotated:
        inner, extras = _unwrapped(get_args(hint)[0])
        return inner, [*extras, *get_args(hint)[1:]]
    if get_origin(hint) in (Union, UnionType):
        return _unwrapped(next(part for part in get_args(hint) if part is not NoneType))
    return hint, []


def _typed(hint: Any, default: Any) -> tuple[dict[str, Any], list[str], bool]:
    """Arguments of a click parameter for a type; words of the option; whether there may be several values."""
    inner, extras = _unwrapped(hint)
    several = get_origin(inner) is tuple
    if several:
        inner, inner_extras = _unwrapped(get_args(inner)[0])
        extras = [*inner_extras, *extras]
    texts = [extra for extra in extras if isinstance(extra, str)]
    kind = click.Choice(get_args(inner)) if get_origin(inner) is Literal else inner
    settings: dict[str, Any] = {
        "type": next((extra for extra in extras if isinstance(extra, click.ParamType)), kind),
        "metavar": next((text for text in texts if not text.startswith("--")), None),
        "required": default is inspect.Parameter.empty,
    }
    if default is not inspect.Parameter.empty:
        settings["default"] = None if default == () else default
    return settings, [text for text in texts if text.startswith("--")], several


def _option(name: str, hint: Any, default: Any, help_text: str) -> click.Option:
    settings, declared, several = _typed(hint, default)
    words = [*(declared or [f"--{name.replace('_', '-')}"]), name]
    if settings["type"] is bool:
        return click.Option(words, is_flag=True, default=default, show_default=bool(default), help=help_text)
    shown = settings.get("default") is not None
    return click.Option(words, multiple=several, show_default=shown, help=help_text, **settings)


def _argument(name: str, hint: Any, default: Any) -> click.Argument:
    settings, _, several = _typed(hint, default)
    return click.Argument([name], nargs=-1 if several else 1, **settings)


# -- what verbs share --------------------------------------------------------------------------------------------------
def origin(seed: int, files: Iterable[Path | None]) -> Origin:
    """The command line as it was typed and its input files, for a page that the running command makes."""
    from doe.report.page import Origin

    typed = click.get_current_context().meta.get(WORDS, ())
    return Origin(shlex.join(("armcal", *typed)), seed, [path for path in files if path is not None])


def stated(option: str) -> bool:
    """Whether an option stands on the command line of the running verb."""
    source = click.get_current_context().get_parameter_source(option)
    return source is click.core.ParameterSource.COMMANDLINE


def warn_beside_json(sentences: Iterable[str]) -> None:
    """Warnings about a result, which its tables contain: with --json on standard error besides the key `warnings`."""
    for sentence in sentences if click.get_current_context().params["as_json"] else ():
        warnings.warn(sentence, UserWarning, stacklevel=2)


def with_collisions(answer: Answer, arm: Arm) -> Answer:
    """The answer that has a plan of this arm, which in space says that collisions were not looked at."""
    if not arm.chain.planar:
        from doe.problem.constraints import COLLISIONS

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
    for path, target in zip(paths, real, strict=True):
        if real.count(target) > 1:
            raise InputError(f"{path}: is given {real.count(target)} times, allowed: each session once")
    stems = [path.stem for path in paths]
    names = [stem if stems.count(stem) == 1 else str(path) for path, stem in zip(paths, stems, strict=True)]
    return pooled_sessions({name: read_measurements(path, arm) for name, path in zip(names, paths, strict=True)})


# -- errors ------------------------------------------------------------------------------------------------------------
def say(sentence: str) -> None:
    """One line on standard error."""
    click.echo(f"armcal: {in_one_line(sentence)}", err=True)


def check_outputs(context: click.Context) -> None:
    """Raises `InputError`, before any work, for an output file that cannot be written, or that is also an input or
    another output: one would overwrite the other."""
    paths = [
        (parameter.opts[0] if isinstance(parameter, click.Option) else parameter.human_readable_name, kind, path)
        for parameter in context.command.params
        if isinstance(kind := parameter.type, FilePath)
        for value in [context.params[parameter.name or ""]]
        for path in (value if isinstance(value, tuple) else (value,))
        if isinstance(path, Path)
    ]
    outputs = [(name, kind, path) for name, kind, path in paths if kind.written]
    taken = {os.path.realpath(path): name for name, kind, path in paths if not kind.written}
    for name, kind, path in outputs:
        other = taken.setdefault(os.path.realpath(path), name)
        if other != name and (context.command.name, name, other) not in UPDATES:
            raise InputError(f"{name}: {path} is the file of {other} too, allowed: another name")
        if kind is not FOLDER:
            check_writable(path, context.params["force"])
    for path in (path for _, kind, path in outputs if kind.picture):
        from doe.report.page import check_picture

        check_picture(path)
    provide_temporary_folder(*(path if kind is FOLDER else path.parent for _, kind, path in outputs), SHARED_MEMORY)


def _guarded(function: Callable[..., Answer], common: CommonOptions, options: dict[str, Any]) -> Answer:
    try:
        with stoppable():
            if sys.stdout is None:
                raise JobError("standard output is closed; send it to a file or to /dev/null")
            try:
                os.getcwd()
            except FileNotFoundError:
                raise JobError("the working directory is no longer there; change into another one") from None
            check_outputs(click.get_current_context())
            return function(common, **options)
    except ArmcalError as error:
        say(str(error))
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, click.Abort) as error:
        say(f"{stopped_by(error)}, nothing was written")
    except MemoryError:
        say("there is not enough memory, allowed: smaller input, or more memory")
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


# -- output ------------------------------------------------------------------------------------------------------------
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

    columns = os.environ.get("COLUMNS", "")
    width = int(columns) if columns.isdecimal() and int(columns) else None if sys.stdout.isatty() else PIPE
    console = Console(width=width, highlight=False, markup=False)  # brackets of effects are no markup
    for part in answer.shown:
        for one in [part] if hasattr(part, "__rich_console__") else rendered(part, console.width):
            # names in files may have control characters, which a terminal would obey
            segments = (Segment(re.sub(r"[^\n]", _visible, s.text), s.style) for s in console.render(one))
            console.print(Segments(segments), end="")


def _visible(match: re.Match[str]) -> str:
    """A question mark for a character that is not printable."""
    return match[0] if match[0].isprintable() else "?"


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
