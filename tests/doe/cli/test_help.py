"""`armcal help` as a user runs it."""

from __future__ import annotations

import tomllib
from importlib.metadata import version

import pytest

from doe.cli import main
from doe.studies.monte_carlo.specification import parse_study
from tests.doe.cli.conftest import Folder


def test_formats_and_verbs(folder: Folder) -> None:
    formats = folder.armcal("help", "--json")
    assert formats.code == 0, formats.err
    assert "links_mm" in formats.data["text"]
    assert "**`design`, `score`**" in formats.data["text"]
    shown = folder.armcal("help", "formats").out
    assert "temperature_C" in shown
    assert folder.armcal("help", "design").out.strip() == folder.armcal("design", "--help").out.strip()


def test_an_unknown_topic_is_one_line(folder: Folder) -> None:
    done = folder.armcal("help", "desing")
    assert done.code == 2
    assert "did you mean 'design'" in done.err
    assert len(done.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["idenitfy"], "unknown verb 'idenitfy', did you mean 'identify'?"),
        (["calibrate"], "did you mean 'identify'?"),
        (["fit"], "did you mean 'identify'?"),
        (["correct"], "did you mean 'compensate'?"),
        (["diag"], "did you mean 'diagnose'?"),
        (["inspect"], "did you mean 'check'?"),
        (["com"], "did you mean 'compare' or 'compensate'?"),
        (["list"], ""),  # and not `validate`
        (["version"], ""),  # and not `design`
        (["help", "units"], "did you mean 'formats'?"),
        (["help", "files"], "did you mean 'formats'?"),
        (["design", "arm.toml", "--output", "x"], "No such option '--output', did you mean '--out'?"),
        (["design", "arm.toml", "--run", "8"], "did you mean '--runs'?"),
        (["design", "arm.toml", "--time", "8"], "did you mean '--seconds'?"),
        (["identify", "arm.toml", "data.csv", "--outliers"], "did you mean '--without-outliers'?"),
        (["init", "--joints", "6"], "did you mean '--dh'?"),
        (["design", "arm.toml", "--verbose"], ""),
        (["effects", "friction"], "did you mean 'joint_hysteresis'?"),
        (["effects", "elasticity"], "did you mean 'joint_compliance'?"),
        (["effects", "foo"], ""),
    ],
)
def test_what_may_be_meant(folder: Folder, words: list[str], meant: str) -> None:
    done = folder.armcal(*words)
    assert done.code == 2
    assert meant in done.err
    assert ("did you mean" in done.err) == bool(meant)
    assert len(done.err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("sigma_mm = 0.1", "sigma_mm: found outside of a table, allowed: under [measurement]"),
        (
            "[instrument]",
            'instrument: found in the file of an arm that is not spatial (kind = "spatial")',
        ),
        ("[base]", 'base: found in the file of an arm that is not spatial (kind = "spatial"), allowed: in one'),
        ("lengths_mm = [1.0]", "lengths_mm: unknown key, did you mean 'links_mm'? allowed: "),
        ("[limits]", "limits: unknown key, did you mean 'joint_limits_deg'? allowed: "),
        ("[joint_limits_deg]\nmin = [0.0]", "joint_limits_deg.min: unknown key, did you mean 'lower'? allowed: "),
        ("[gravity]\ng = [0.0]", "gravity.g: unknown key, did you mean 'acceleration_m_s2'? allowed: "),
        ("description = 'x'", "description: unknown key, allowed: "),
    ],
)
def test_keys_that_are_not_in_an_arm_file(folder: Folder, line: str, sentence: str) -> None:
    folder.write("odd.toml", f"links_mm = [300.0, 200.0]\n{line}\n")
    done = folder.armcal("design", "odd.toml", "--runs", "8")
    assert done.code == 2
    assert f"odd.toml: {sentence}" in done.err


def test_versions_of_armcal_and_of_the_solvers(folder: Folder) -> None:
    shown = folder.armcal("--version")
    assert shown.code == 0
    for name in ("armcal", "casadi", "clarabel"):
        assert f"{name} {version(name)}" in shown.out


def test_examples_fit_a_terminal(folder: Folder) -> None:
    for verb, command in main.commands.items():
        example = str(command.epilog).partition("Example:\n")[2].partition("\n")[0]
        assert example.startswith("  armcal "), verb
        assert max(map(len, folder.armcal(verb, "--help").out.splitlines())) <= 80, verb


def test_the_study_of_the_help_is_one(folder: Folder) -> None:
    example = folder.armcal("study", "--help").out.partition("(names of files are beside it):\n")[2]
    study = parse_study(tomllib.loads(example))
    assert study.replications == 10_000
    assert [truth.name for truth in study.truths] == ["eccentric"]
