"""The group of verbs. Importing this imports no solver, so that `armcal --help` answers at once."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from errno import ENOSPC
from importlib import import_module
from typing import Any

import click

from doe.cli.common import WORDS, PriorOrFile, no_output, verb
from identification import SINGLE_THREAD, in_one_line, nearest
from identification.workflow import VERBS as IDENTIFICATION

VERBS = (  # in the order of the work; each has a module here or is a function of identification
    *("demo", "init", "design", "score", "advise", "compare", "relax", "study", "simulate", "check", "identify"),
    *("diagnose", "discriminate", "validate", "compensate", "report", "effects", "help"),
)
OTHER_VERBS = {  # words for the same -> verb
    **dict.fromkeys(("calibrate", "fit", "estimate", "regress"), "identify"),
    **dict.fromkeys(("plan", "optimize", "optimise"), "design"),
    **dict.fromkeys(("inspect", "verify"), "check"),
    **dict.fromkeys(("new", "start", "create"), "init"),
    **dict.fromkeys(("correct", "inverse"), "compensate"),
    **dict.fromkeys(("predict", "test"), "validate"),
    **dict.fromkeys(("page", "html"), "report"),
    "recommend": "advise",
    "library": "effects",
    "evaluate": "score",
}
OTHER_OPTIONS = {
    **dict.fromkeys(("output", "save"), "out"),
    **dict.fromkeys(("time", "timeout", "budget"), "seconds"),
    **dict.fromkeys(("n", "m", "measurements", "postures", "poses"), "runs"),
    **dict.fromkeys(("dof", "joints", "axes"), "dh"),
    **dict.fromkeys(("plot", "figure", "image"), "picture"),
    "overwrite": "force",
    "silent": "quiet",
    "threads": "workers",
}


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Usage errors, and a full disk while help is printed, as one line like every other error."""
    try:
        yield
    except click.exceptions.NoArgsIsHelpError:  # the whole help, on purpose
        raise
    except click.NoSuchOption as error:
        raise click.UsageError(in_one_line(unknown_option(error))) from None
    except click.UsageError as error:
        raise click.UsageError(in_one_line(error.format_message())) from None
    except OSError as error:
        if error.errno != ENOSPC or error.filename is not None:
            raise
        no_output(error)


def unknown_option(error: click.NoSuchOption) -> str:
    """What to say of an option that a verb does not have."""
    parameters = [] if error.ctx is None else error.ctx.command.params
    options = (option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts))
    names = [option.removeprefix("--") for option in options if option.startswith("--")]
    close, question, _ = nearest(error.option_name.removeprefix("--"), names, OTHER_OPTIONS).partition("? ")
    meant = re.sub("'(.+?)'", r"'--\1'", close)
    return f"{error.message.rstrip('.')}, {meant}?" if question else error.message.rstrip(".")


class Verbs(click.Group):
    """Verbs in the order of the work, and the nearest one suggested for an unknown one."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)

    def make_context(self, info_name: str | None, args: list[str], *arguments: Any, **options: Any) -> click.Context:
        """As in click, but usage errors take one line; the words of the command line are kept."""
        words = tuple(args)
        with one_line_errors():
            if any("\0" in word for word in words):  # no shell can pass one on; a program that calls this can
                raise click.UsageError("a word with a null character, allowed: text")
            context = super().make_context(info_name, args, *arguments, **options)
        context.meta[WORDS] = words
        return context

    def invoke(self, ctx: click.Context) -> Any:
        """As in click, but usage errors take one line."""
        with one_line_errors():
            return super().invoke(ctx)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As in click, with a suggestion."""
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            ctx.fail(f"unknown verb {args[0]!r}, {nearest(args[0], self.commands, OTHER_VERBS)}")
        return super().resolve_command(ctx, args)


def versions(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    """Show the version of armcal, and those of the solvers that its numbers come from."""
    if not wanted or context.resilient_parsing:
        return
    from importlib.metadata import version

    solvers = ", ".join(f"{name} {version(name)}" for name in ("casadi", "cvxpy", "clarabel", "numpy", "scipy"))
    click.echo(f"armcal {version('armcal')} ({solvers})")
    context.exit()


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Every verb takes --json, --seed and --quiet, and `armcal VERB --help` shows an example. "
    "A calibration starts with `armcal init`; file formats: `armcal help formats`.",
)
@click.option("--version", is_flag=True, is_eager=True, expose_value=False, callback=versions, help="Show versions.")
def main() -> None:
    """Certified experiment design and calibration for robot arms.

    Which postures to measure, what the measurements say about the arm, and which physical effect is missing.
    """
    # The matrices are small: more threads made it five times slower (measured), and the tasks use all cores already.
    for variable, number in SINGLE_THREAD.items():  # before numpy is imported; what the user has set stays
        os.environ.setdefault(variable, number)


for name in VERBS:
    if name in IDENTIFICATION:
        function, example = IDENTIFICATION[name]
        kind = PriorOrFile if name == "identify" else click.Command
        main.add_command(verb(example, kind, name)(function))
    else:
        main.add_command(import_module(f"doe.cli.{name}").command)
