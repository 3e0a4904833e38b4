"""`armcal help` as a user runs it."""

from __future__ import annotations

import tomllib
from importlib.metadata import version

from doe.cli import main
from doe.studies.monte_carlo import StudyFile
from tests.doe.cli.conftest import Folder


def test_formats_and_verbs(folder: Folder) -> None:
    formats = folder.armcal("help", "--json")
    assert formats.code == 0, formats.err
    assert "links_mm" in formats.data["text"]
    assert "**`design`, `score`**" in formats.data["text"]
    shown = folder.armcal("help", "formats").out
    assert "temperature_C" in shown
    assert folder.armcal("help", "design").out.strip() == folder.armcal("design", "--help").out.strip()


def test_versions_of_armcal_and_of_the_solvers(folder: Folder) -> None:
    shown = folder.armcal("--version")
    assert shown.code == 0
    for name in ("armcal", "casadi", "clarabel"):
        assert f"{name} {version(name)}" in shown.out


def test_examples_fit_a_terminal(folder: Folder) -> None:
    for verb, command in main.commands.items():
        example = str(command.epilog).partition("Example:\n")[2].partition("\n")[0]
        assert example.startswith("  armcal "), verb
        shown = folder.armcal(verb, "--help").out
        assert max(map(len, shown.splitlines())) <= 80, verb
        assert shown.replace("\n", "").isprintable(), verb


def test_the_study_of_the_help_is_one(folder: Folder) -> None:
    example = folder.armcal("study", "--help").out.partition("(names of files are beside it):\n")[2]
    study = StudyFile.model_validate(tomllib.loads(example))
    assert study.replications == 10_000
    assert [truth.name for truth in study.truths] == ["eccentric"]
