"""The command `armcal`, a group of verbs. Importing it imports no solver, so that `armcal --help` answers at once."""

import os
import sys
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import click

from doe import SINGLE_THREAD
from doe.cli import verbs  # noqa: F401 - it declares them
from doe.cli.verb import command, in_one_line, say
from identification import InputError
from identification.document import Answer, Document
from identification.workflow import VERBS

ORDER = (  # of the work
    *("demo", "init", "design", "score", "program", "advise", "compare", "relax", "study", "simulate", "check"),
    *("identify", "diagnose", "discriminate", "validate", "compensate", "report", "effects", "help"),
)


class Verbs(click.Group):
    """Verbs in the order of the work; usage errors take one line, with the nearest name."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """In the order in which they were added."""
        return list(self.commands)

    def main(self, args: Sequence[str] | None = None, prog_name: str | None = None, **_: Any) -> Any:  # type: ignore[override]
        """As in click, but usage errors, and a standard output that cannot be written, are one line like every other
        error.

        The words of the command line are the object of the context.
        """
        words = list(sys.argv[1:] if args is None else args)
        try:
            sys.exit(super().main(words, prog_name, obj=tuple(words), standalone_mode=False))
        except click.exceptions.NoArgsIsHelpError as error:  # the whole help, on purpose
            error.show()
        except click.UsageError as error:
            click.UsageError(in_one_line(error.format_message().replace("\n\t", " "))).show()
        except OSError as error:
            say(f"standard output cannot be written ({error.strerror})")
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python tries again when it ends
            sys.exit(1)
        sys.exit(2)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """As in click, with a suggestion."""
        if args and not args[0].startswith("-") and args[0] not in self.commands:
            ctx.fail(str(InputError.unknown("unknown verb", args[0], self.commands)))
        return super().resolve_command(ctx, args)


@click.group(
    cls=Verbs,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Every verb takes --json, --seed and --quiet, and `armcal VERB --help` shows an example. "
    "A calibration starts with `armcal init`; file formats: `armcal help formats`.",
)
@click.version_option(package_name="armcal", message="armcal %(version)s")
def main() -> None:
    """Certified experiment design and calibration for robot arms.

    Which postures to measure, what the measurements say about the arm, and which physical effect is missing.
    """
    # The matrices are small: more threads made it five times slower (measured), and the tasks use all cores already.
    for variable, number in SINGLE_THREAD.items():  # before numpy is imported; what the user has set stays
        os.environ.setdefault(variable, number)


@VERBS.declare("armcal help formats")
def help_of(topic: str = "formats") -> Answer:
    """The help of a verb, or the file formats.

    Show the help of the verb TOPIC, or with `formats` all file formats and JSON keys.
    """
    if topic == "formats":
        from rich.markdown import Markdown

        text = files("identification.files").joinpath("README.md").read_text(encoding="utf-8")
        shown: Any = Markdown(text)
        return Answer({"topic": topic, "text": text}, Document(parts=[shown]))
    if topic not in main.commands:
        raise InputError.unknown("unknown topic", topic, ["formats", *main.commands])
    parent = click.get_current_context().parent
    text = main.commands[topic].get_help(click.Context(main.commands[topic], info_name=topic, parent=parent))
    return Answer({"topic": topic, "text": text}, Document(parts=[text]))


for name in ORDER:
    main.add_command(command(*VERBS[name]))
