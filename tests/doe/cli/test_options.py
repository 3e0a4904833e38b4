"""Options from the signature of a verb, groups of them, and the files that a verb writes."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import pytest
from click.testing import CliRunner

from doe.cli import main
from doe.cli.plans import written
from doe.cli.verb import FOLDER, FilePath, WholeNumbers, check_outputs, verb
from identification.document import Answer
from identification.errors import InputError
from identification.workflow import Names


@dataclass(frozen=True)
class Size:
    """A group.

    width : How wide.
    depth : How deep,
        in all.
    """

    width: int
    depth: Annotated[int, click.IntRange(max=9)] = 3


def test_a_signature_and_its_docstring_declare_a_command() -> None:
    got: dict[str, Any] = {}

    @verb("armcal paint wall.toml")
    def command(
        arm: Path,
        data: tuple[Path, ...],
        *,
        runs: WholeNumbers,
        color: Literal["red", "blue"] = "red",
        only: tuple[Names, ...] = (),
        check: Annotated[bool, "--check/--no-check"] = True,
        size: Size,
        in_all: float | None = None,
        seed: int = 0,
    ) -> Answer:
        """Paint a wall.

        More of it.

        runs : How often.
        color : Which.
        only : These.
        check : Look.
        in_all : Sum.
        """
        got.update(arm=arm, data=data, runs=runs, color=color, only=only, check=check, size=size, in_all=in_all)
        got["seed"] = seed
        return Answer({"here": arm}, [])

    line = "a.toml b.csv c.csv --runs 3,4 --width 5 --only x --only y,z --no-check --seed 7 --json"
    done = CliRunner().invoke(command, line.split())
    assert (done.exit_code, done.stdout) == (0, '{"here": "a.toml"}\n')
    assert got == {
        "arm": Path("a.toml"), "data": (Path("b.csv"), Path("c.csv")), "runs": [3, 4], "color": "red",
        "only": ("x", "y,z"), "check": False, "size": Size(5, 3), "in_all": None, "seed": 7,
    }  # fmt: skip
    names = ["arm", "data", "runs", "color", "only", "check", "width", "depth", "in_all", "as_json", "seed", "quiet"]
    assert [parameter.name for parameter in command.params] == names  # the order of the help
    page = " ".join(CliRunner().invoke(command, ["--help"]).stdout.split())
    assert command.short_help == "Paint a wall."
    for text in (
        "Paint a wall. More of it.",
        "--only NAMES These.",
        "How deep, in all. [default: 3; x<=9]",
        "armcal paint",
    ):
        assert text in page
    for wrong in (
        "a.toml --runs 3 --width 5",
        "a.toml b.csv --width 5",
        "a.toml b.csv --runs 3",
        "a b --runs 0 --width 5",
    ):
        assert CliRunner().invoke(command, wrong.split()).exit_code == 2


def test_files_are_written_once_and_replaced_by_force_only(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    assert written({None: "text"}, force=False, what="plan") == []
    assert written({path: "one", None: b""}, force=False, what="plan") == [f"plan written to {path}"]
    with pytest.raises(InputError, match="exists"):
        written({path: "two"}, force=False)
    written({path: "two"}, force=True)
    assert path.read_text() == "two"


WRITTEN = [
    (verb, parameter.name)
    for verb in main.commands.values()
    for parameter in verb.params
    if isinstance(parameter.type, FilePath) and parameter.type.written and parameter.type is not FOLDER
]


@pytest.mark.parametrize(("verb", "name"), WRITTEN, ids=lambda value: getattr(value, "name", value))
def test_every_output_file_is_checked_before_the_work(verb: click.Command, name: str, tmp_path: Path) -> None:
    there = tmp_path / "there.png"
    there.write_text("mine")
    for force, path, found in ((False, there, "exists"), (True, tmp_path, "directory"), (True, there, None)):
        context = click.Context(verb)
        context.params = {p.name or "": None for p in verb.params} | {name: path, "force": force}
        with nullcontext() if found is None else pytest.raises(InputError, match=found):
            check_outputs(context)
    assert there.read_text() == "mine"


def test_every_file_of_a_verb_is_read_or_written() -> None:
    """By its name, so that no new option stands on the wrong side."""
    names = {True: set[str](), False: set[str]()}
    for command in main.commands.values():
        for parameter in command.params:
            if isinstance(parameter.type, click.Path):
                assert isinstance(parameter.type, FilePath), (command.name, parameter.name)
                names[parameter.type.written].add(str(parameter.name))
    assert names[True] == {"out", "picture", "aliases", "report", "curves", "urdf"}
    assert not names[True] & names[False]
