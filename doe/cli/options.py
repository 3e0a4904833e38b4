"""Options that several verbs share, and groups of options that a verb gets as one object."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from identification.errors import InputError
from identification.files.io import PathLike, write_together

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from identification.arm import Arm
    from identification.arrays import Array

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]
FILE, FOLDER = click.Path(path_type=Path), click.Path(path_type=Path)  # `check_outputs` looks at files only
# options that write a file; every other one is read
OUTPUTS = frozenset({"out", "picture", "aliases", "report", "curves", "urdf"})
PICTURES = frozenset({"picture", "aliases"})  # of them


class Seconds(click.FloatRange):
    """A time budget [s] above zero; `nan` would be one that never ends."""

    def __init__(self) -> None:
        super().__init__(min=0, min_open=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """As in click, without `nan`."""
        number = float(super().convert(value, param, ctx))
        if math.isnan(number):
            self.fail("nan is not in the range x>0.", param, ctx)
        return number


class FileOrShare(click.Path):
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


def grouped(kind: type, name: str, *options: Decorator) -> Decorator:
    """A decorator that adds click options and passes their values as one object, the argument `name`.

    kind : a dataclass with a field for each option; fields of options that are not there keep their defaults
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(function)
        def run(*arguments: Any, **values: Any) -> Any:
            group = {field.name: values.pop(field.name) for field in fields(kind) if field.name in values}
            return function(*arguments, **values, **{name: kind(**group)})

        decorated: Callable[..., Any] = run
        for option in reversed(options):
            decorated = option(decorated)
        return decorated

    return decorate


@dataclass(frozen=True)
class Output:
    """The files that a verb writes. An existing file is replaced with `force` only."""

    out: Path | None = None
    picture: Path | None = None
    force: bool = False

    def write(self, text: str, what: str) -> list[str]:
        """Write `out` if requested, and return the lines that report it."""
        return self.write_all(text, what, {})

    def draw(self, figure: Callable[[], Figure]) -> None:
        """Save the figure if a picture was requested."""
        self.write_all("", "", {self.picture: figure})

    def write_all(self, text: str, what: str, figures: Mapping[Path | None, Callable[[], Figure]]) -> list[str]:
        """Write `out` and the pictures (file -> figure) if requested, all or none, and return the lines on them.

        what : describes the content of `out`; empty: `out` is not written by this call
        """
        files: dict[PathLike, str | bytes] = {self.out: text} if what and self.out is not None else {}
        for path, figure in figures.items():
            if path is not None:
                from doe.report.figures import picture_bytes

                files[path] = picture_bytes(figure(), path)
        write_together(files, force=self.force)
        return [f"{what} written to {self.out}"] if what and self.out is not None else []


def plan_drawing(arm: Arm, postures: Array) -> Figure:
    """An arm at the postures (m, n) [rad]."""
    from doe.report.figures import plan_figure  # deferred: matplotlib takes longer to load than a small design

    return plan_figure(arm, postures)


@dataclass(frozen=True)
class LibraryEffects:
    """Whether the model of a fit includes effects of the library, with priors of their typical sizes, and which."""

    prior: bool | None = None  # None: neither asked for nor refused
    missing: str | None = None

    @property
    def held(self) -> bool:
        """As `prior`. Raises `InputError` for --missing alone."""
        if self.missing is not None and not self.prior:
            raise InputError("--missing: found without --prior, allowed: with --prior")
        return bool(self.prior)

    @property
    def names(self) -> list[str] | None:
        """Names of the effects; None: all that this arm and these rows can show."""
        return None if self.missing is None else [word.strip() for word in self.missing.split(",")]


prior_options = grouped(
    LibraryEffects,
    "prior",
    click.option(
        "--prior/--no-prior",
        "--library-prior/--no-library-prior",
        "prior",
        default=None,
        help="Fit the library's effects too, each held by a prior of its typical size, or not.",
    ),
    click.option("--missing", metavar="NAMES", help="Only these effects, for --library-prior: backlash,gear_ratio"),
)
only_option = click.option(
    "--only",
    multiple=True,
    metavar="NAMES",
    help="Estimate only these, with commas: lengths, joint_offsets, base, tool, effects, names such as joint_offset:2.",
)
force_option = click.option("--force", is_flag=True, help="Overwrite an existing file.")


def output_options(*, picture: str | None = None, out: str | None = None) -> Decorator:
    """--picture and --out, each where its help is given, and --force, as the argument `output`."""
    options = [click.option("--picture", type=FILE, metavar="FILE", help=picture)] if picture else []
    options += [click.option("--out", type=FILE, metavar="FILE", help=out)] if out else []
    return grouped(Output, "output", *options, force_option)
