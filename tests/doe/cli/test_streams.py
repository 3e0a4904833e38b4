"""Standard streams that cannot be written to: one line, exit 1, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from doe.cli.verb import verb
from identification.document import Answer
from tests.doe.cli.conftest import Folder, without_progress

FULL = Path("/dev/full")
ROOT = Path(__file__).parents[3]


def shell(folder: Folder, words: str, redirection: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, as a shell starts it."""
    line = ["sh", "-c", f'"$0" -m doe {words} {redirection}', sys.executable]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(line, cwd=folder.path, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("said", "width"), [("60", 60), ("80", 80), ("100", 100), ("0", 110), ("wide", 110), ("", 110)]
)
def test_a_pipe_is_as_wide_as_columns_says(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, said: str, width: int
) -> None:
    """A long sentence fills the lines; what is no width is as nothing said."""
    monkeypatch.setenv("COLUMNS", said)
    lines = folder.armcal("effects", "gravity").out.splitlines()
    assert width - 20 < max(len(line.rstrip()) for line in lines) <= width  # 20: the next word, which did not fit


def test_the_command_is_a_module_too(folder: Folder) -> None:
    assert shell(folder, "--help", "").stdout.startswith("Usage: armcal")


@pytest.mark.skipif(not FULL.exists(), reason="no full device here")
@pytest.mark.parametrize("words", ["effects backlash", "effects backlash --json", "--help", "score --help"])
def test_a_full_device(folder: Folder, words: str) -> None:
    done = shell(folder, words, f"> {FULL}")
    assert done.returncode == 1, done.stderr
    assert without_progress(done.stderr) == "armcal: standard output cannot be written (No space left on device)\n"


@pytest.mark.skipif(not Path("/dev/stdout").exists(), reason="no such device here")
@pytest.mark.parametrize("out", ["/dev/stdout", "/dev/null", "pipe"])
def test_an_output_that_is_no_file_is_refused_before_the_work(folder: Folder, out: str) -> None:
    """The work would fail: the measurements are no table. Standard output is a pipe here."""
    folder.write("data.csv", "")
    os.mkfifo(folder.path / "pipe")
    done = shell(folder, f"identify arm.toml data.csv --out {out} --force", "| cat")
    assert done.stderr == f"armcal: {out}: is not a regular file, allowed: a new file name\n"


def test_a_closed_output(folder: Folder) -> None:
    done = shell(folder, "score arm.toml plan.csv --picture plan.png", ">&-")
    assert done.returncode == 1, done.stderr
    assert without_progress(done.stderr) == "armcal: standard output is closed; send it to a file or to /dev/null\n"
    assert not (folder.path / "plan.png").exists()


def test_closed_errors_and_a_pipe_that_ends_early(folder: Folder) -> None:
    done = shell(folder, "effects backlash --json", "2>&-")
    assert done.returncode == 0
    assert done.stdout.startswith("{")
    done = shell(folder, "effects --json", "| true")
    assert without_progress(done.stderr) == ""


def test_brackets_are_no_markup() -> None:
    @verb("armcal effects")
    def command() -> Answer:
        """A line."""
        return Answer({}, ["transmission_ripple:1[k=20] and [red]"])

    assert CliRunner().invoke(command, []).stdout == "transmission_ripple:1[k=20] and [red]\n"
