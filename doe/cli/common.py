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
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

import click

from doe.cli.options import FOLDER, FileOrShare, FilePath
from doe.cli.progress import shown_progress
from doe.cli.stopping import stoppable, stopped_by
from identification import ArmcalError, InputError, JobError, in_one_line
from identification.document import Answer, check_picture
from identification.files.io import check_writable, provide_temporary_folder
from identification.workflow import Folder, Picture, Written

if TYPE_CHECKING:
    from identification import Arm
    from identification.document import Document

SHARED_MEMORY = Path("/dev/shm")  # of Linux; may be written to where nothing else may
WORDS = "armcal.words"  # in the context's `meta`: what was typed after `armcal`
# the arm file with a table added to it; --force may overwrite the old one
PROVIDED = ("seed", "progress", "page", "constraints")  # parameters that are no options of their own
UPDATES = frozenset((verb, "--out", "ARM") for verb in ("identify", "diagnose"))


FILES: dict[Any, click.ParamType] = {
    Path: FilePath(),
    Written: FilePath(written=True),
    Picture: FilePath(written=True, picture=True),
    Folder: FOLDER,
}


# -- from a signature to a command -------------------------------------------------------------------------------------
def verb(
    example: str, kind: type[click.Command] = click.Command, name: str = ""
) -> Callable[[Callable[..., Answer]], click.Command]:
    """Turn `function(argument, .., *, option, ..) -> Answer` into a click command of its module's name, or another.

    Positional parameters are arguments, the others options, those of a dataclass a group of them. Their types are those
    of Python, with `Written` and `Picture` for files to write and `Folder` for where, or `Annotated` with a type of
    click, words of the option (`--name`), a range of whole numbers, or what it stands for in the help (`NAMES`). The
    docstring's first line stands in `armcal --help`; lines `name : ..` say what an option is for.

    Adds --json, --seed, --quiet and the example; errors become one line on standard error and an exit code. A function
    with a parameter `seed`, `progress`, `page` or `constraints` is given the seed, a callback for its progress, what
    makes a page of a document and of files that were read, and what makes the constraints of a model.
    """

    def decorate(function: Callable[..., Answer]) -> click.Command:
        called = name or function.__module__.rpartition(".")[2]
        text, helps = _documented(function)
        hints, parameters = get_type_hints(function, include_extras=True), list[click.Parameter]()
        groups: dict[str, Any] = {}
        signature = inspect.signature(function).parameters
        for parameter in (each for each in signature.values() if each.name not in PROVIDED):
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
                settings, _, several = _typed(hint, default)
                parameters.append(click.Argument([parameter.name], nargs=-1 if several else 1, **settings))
        parameters += [
            click.Option(["--json", "as_json"], is_flag=True, help="One JSON object on standard output."),
            _option("seed", Annotated[int, click.IntRange(min=0)], 0, "Random seed."),
            _option("quiet", bool, False, "No progress and no warnings on standard error."),
        ]

        def run(as_json: bool, quiet: bool, seed: int, **values: Any) -> None:
            for group, type_ in groups.items():
                values[group] = type_(**{each.name: values.pop(each.name) for each in fields(type_)})
            logging.getLogger("matplotlib").setLevel(logging.ERROR)  # where it keeps its fonts is no news
            with _warnings_as_lines(quiet), shown_progress(called, quiet) as progress:
                provided = dict(zip(PROVIDED, (seed, progress, _page, _constraints), strict=True))
                values |= {key: value for key, value in provided.items() if key in signature}
                answer = _guarded(function, values)
                for sentence in answer.warnings if as_json else ():
                    warnings.warn(sentence, UserWarning, stacklevel=2)
            if answer.failure is not None:
                say(str(answer.failure))
                answer.exit_code = answer.failure.exit_code
            try:
                _print(answer, as_json)
                sys.stdout.flush()
            except BrokenPipeError:  # `| head`: click ends quietly
                raise
            except OSError as error:  # a full disk
                no_output(error)
            sys.exit(answer.exit_code)

        epilog = f"\b\nExample:\n  {example}"
        return kind(called, callback=run, params=parameters, help=text, short_help=text.split("\n")[0], epilog=epilog)

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
    share = {Path, float} <= set(get_args(get_args(hint)[0] if get_origin(hint) is Annotated else hint))
    several = get_origin(inner) is tuple
    if several:
        inner, inner_extras = _unwrapped(get_args(inner)[0])
        extras = [*inner_extras, *extras]
    extras += [click.IntRange(extra.start, extra.stop - 1) for extra in extras if isinstance(extra, range)]
    texts = [extra for extra in extras if isinstance(extra, str)]
    kind = click.Choice(get_args(inner)) if get_origin(inner) is Literal else FILES.get(inner, inner)
    kind = FileOrShare() if share else kind
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


class PriorOrFile(click.Command):
    """A command that reads `--prior FILE` as `--prior-from FILE`, since the flag --prior leaves a word too many."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """As in click; if that fails, parse again with --prior-from in the place of --prior."""
        words = list(args)
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            places = [k for k, word in enumerate(words) if word.partition("=")[0] == "--prior"]
            if len(places) != 1:
                raise
            words[places[0]] = words[places[0]].replace("--prior", "--prior-from", 1)
            ctx.params.clear()
            try:
                return super().parse_args(ctx, words)
            except click.UsageError:
                raise error from None


# -- what verbs share --------------------------------------------------------------------------------------------------
def _page(document: Document, read: Iterable[Path]) -> str:
    """A page that the running command makes, with the command line as it was typed and the files that were read."""
    from doe.report.page import Origin, page

    context = click.get_current_context()
    typed = shlex.join(("armcal", *context.meta.get(WORDS, ())))
    return page(document, Origin(typed, context.params["seed"], [*read]))


def _constraints(model: Any) -> Any:
    """What keeps the postures of a model's arm, as its file says it."""
    from doe.problem.constraints import constraints_of

    return constraints_of(model)


def stated(option: str) -> bool:
    """Whether an option stands on the command line of the running verb."""
    source = click.get_current_context().get_parameter_source(option)
    return source is click.core.ParameterSource.COMMANDLINE


def with_collisions(answer: Answer, arm: Arm) -> Answer:
    """The answer that has a plan of this arm, which in space says that collisions were not looked at."""
    if not arm.chain.planar:
        from doe.problem.constraints import COLLISIONS

        answer.data["collisions_checked"] = False
        answer.shown.append(COLLISIONS)
    return answer


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
        check_picture(path)
    provide_temporary_folder(*(path if kind is FOLDER else path.parent for _, kind, path in outputs), SHARED_MEMORY)


def _guarded(function: Callable[..., Answer], options: dict[str, Any]) -> Answer:
    try:
        with stoppable():
            if sys.stdout is None:
                raise JobError("standard output is closed; send it to a file or to /dev/null")
            try:
                os.getcwd()
            except FileNotFoundError:
                raise JobError("the working directory is no longer there; change into another one") from None
            check_outputs(click.get_current_context())
            return function(**options)
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
    width = None if sys.stdout.isatty() else 110
    if columns.isdecimal() and int(columns):
        width = int(columns)
    console = Console(width=width, highlight=False, markup=False)  # brackets of effects are no markup
    for part in answer.shown:
        for one in [part] if hasattr(part, "__rich_console__") else rendered(part, console.width):
            # names in files may have control characters, which a terminal would obey
            segments = (
                Segment(re.sub(r"[^\n]", lambda c: c[0] if c[0].isprintable() else "?", s.text), s.style)
                for s in console.render(one)
            )
            console.print(Segments(segments), end="")


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
