"""Groups of options: the values of several options as one object, and the files that a verb writes."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from doe.cli import main
from doe.cli.common import check_outputs
from doe.cli.options import FILE, OUTPUTS, Output, grouped, output_options
from identification.errors import InputError


@dataclass(frozen=True)
class Size:
    width: int = 1
    height: int = 2
    depth: int = 3


def test_grouped_options_come_as_one_object_and_those_left_out_keep_their_defaults() -> None:
    got: dict[str, Any] = {}

    @click.command()
    @click.option("--color")
    @grouped(Size, "size", click.option("--width", type=int), click.option("--height", type=int, default=7))
    def command(**values: Any) -> None:
        got.update(values)

    assert CliRunner().invoke(command, ["--width", "5", "--color", "red"]).exit_code == 0
    assert got == {"color": "red", "size": Size(5, 7, 3)}
    assert [parameter.name for parameter in command.params] == ["color", "width", "height"]  # the order of the help


def test_output_options_are_those_asked_for() -> None:
    def names(**chosen: Any) -> list[str | None]:
        return [p.name for p in click.command()(output_options(**chosen)(lambda output: None)).params]

    assert names(out="Write.") == ["out", "force"]
    assert names(picture="Draw.", out="Write.") == ["picture", "out", "force"]
    assert names(picture="Draw.") == ["picture", "force"]


def test_output_is_written_once_and_replaced_by_force_only(tmp_path: Path) -> None:
    path = tmp_path / "plan.csv"
    assert Output().write("text", "plan") == []
    assert Output(path).write("one", "plan") == [f"plan written to {path}"]
    with pytest.raises(InputError, match="exists"):
        Output(path).write("two", "plan")
    Output(path, force=True).write("two", "plan")
    assert path.read_text() == "two"


WRITTEN = [
    (verb, parameter.name)
    for verb in main.commands.values()
    for parameter in verb.params
    if parameter.type is FILE and parameter.name in OUTPUTS
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


def test_verbs_that_write_files_are_all_there() -> None:
    verbs = {verb.name for verb, _ in WRITTEN}
    assert verbs == {
        "design",
        "score",
        "advise",
        "relax",
        "simulate",
        "identify",
        "diagnose",
        "discriminate",
        "compensate",
        "validate",
        "report",
    }


def test_a_picture_is_made_only_when_asked_for() -> None:
    def never() -> Any:
        raise AssertionError

    Output().draw(never)
