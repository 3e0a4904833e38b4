"""What all verbs share: options by a signature, help, files, streams, progress, signals, and a read-only system."""

import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import pytest
from click.testing import CliRunner

from doe.cli import main
from doe.cli.verb import (
    FOLDER,
    FilePath,
    WholeNumbers,
    check_outputs,
    command,
    interruptible,
    shown_progress,
    stoppable,
)
from identification import InputError, JobError, Progress
from identification.document import Answer, Document
from identification.workflow import Names
from tests.doe.cli.conftest import Folder, without_progress

FULL = Path("/dev/full")
ROOT = Path(__file__).parents[3]


# -- from a signature to a command -------------------------------------------------------------------------------------
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

    def paint(
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
        progress: Progress,
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
        progress(1.0, 2.0, "")
        got["seed"] = seed
        return Answer({"here": arm}, Document(parts=["transmission_ripple:1[k=20] and [red] \u2013"]))

    line = "a.toml b.csv c.csv --runs 3,4 --width 5 --only x --only y,z --no-check --seed 7"
    painting = command(paint, "armcal paint wall.toml")
    done = CliRunner().invoke(painting, [*line.split(), "--json"])
    assert (done.exit_code, done.stdout) == (0, '{"here": "a.toml"}\n')
    assert got == {
        "arm": Path("a.toml"), "data": (Path("b.csv"), Path("c.csv")), "runs": [3, 4], "color": "red",
        "only": (["x"], ["y", "z"]), "check": False, "size": Size(5, 3), "in_all": None, "seed": 7,
    }  # fmt: skip
    for charset, dash in (("utf-8", "\u2013"), ("latin-1", "?")):  # no markup
        shown = CliRunner(charset=charset).invoke(painting, line.split()).stdout
        assert shown == f"transmission_ripple:1[k=20] and [red] {dash}\n"
    names = "arm data runs color only check width depth in_all as_json seed quiet"
    assert [parameter.name for parameter in painting.params] == names.split()  # the order of the help
    page = " ".join(CliRunner().invoke(painting, ["--help"]).stdout.split())
    assert painting.short_help == "Paint a wall."
    for text in ("Paint a wall. More of it.", "--only NAMES These.", "How deep, in all. [default: 3; x<=9]", "paint"):
        assert text in page
    right = "a.toml b.csv --runs 3 --width 5"
    for part, wrong in ((" b.csv", ""), (" --runs 3", ""), (" --width 5", ""), ("3", "0"), ("5", "five")):
        assert CliRunner().invoke(painting, right.replace(part, wrong).split()).exit_code == 2


def test_help_formats_and_versions(folder: Folder) -> None:
    formats = folder.said("help ")
    assert "links_mm" in formats["text"]
    assert "**`design`, `score`**" in formats["text"]
    assert "temperature_C" in folder.armcal("help formats").out
    assert folder.armcal("help design").out.strip() == folder.armcal("design --help").out.strip()
    shown = folder.armcal("--version")
    assert (shown.code, shown.out) == (0, f"armcal {version('armcal')}\n")


@pytest.mark.parametrize("name", main.commands)
def test_the_help_of_a_verb_has_an_example_and_fits_a_terminal(folder: Folder, name: str) -> None:
    example = str(main.commands[name].epilog).partition("Example:\n")[2].partition("\n")[0]
    assert example.startswith(f"  armcal {name} ")
    shown = folder.armcal(name, "--help").out
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.replace("\n", "").isprintable()


# -- files -------------------------------------------------------------------------------------------------------------


PATHS = [(verb, p) for verb in main.commands.values() for p in verb.params if isinstance(p.type, click.Path)]


def test_every_file_of_a_verb_is_read_or_written() -> None:
    """By its name, so that no new option stands on the wrong side."""
    names = {True: set[str](), False: set[str]()}
    for _, parameter in PATHS:
        assert isinstance(parameter.type, FilePath)
        names[parameter.type.written].add(str(parameter.name))
    assert names[True] == {"out", "picture", "report", "urdf"}
    assert not names[True] & names[False]


@pytest.mark.parametrize(
    ("verb", "name"),
    [(verb, p.name) for verb, p in PATHS if p.type.written and p.type is not FOLDER],
    ids=lambda value: getattr(value, "name", value),
)
def test_every_output_file_is_checked_before_the_work(verb: click.Command, name: str, tmp_path: Path) -> None:
    there = tmp_path / "there.png"
    there.write_text("mine")
    for force, path, found in ((False, there, "exists"), (True, tmp_path, "directory"), (True, there, None)):
        context = click.Context(verb)
        context.params = {p.name or "": None for p in verb.params} | {name: path, "force": force}
        with nullcontext() if found is None else pytest.raises(InputError, match=found):
            check_outputs(context)
    assert there.read_text() == "mine"


# -- streams -----------------------------------------------------------------------------------------------------------
def shell(folder: Folder, words: str, redirection: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, as a shell starts it."""
    line = ["sh", "-c", f'"$0" -m doe {words} {redirection}', sys.executable]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(line, cwd=folder.path, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("said", "width"), [("60", 60), ("100", 100), ("0", 110), ("wide", 110), ("", 110)])
def test_a_pipe_is_as_wide_as_asked(folder: Folder, monkeypatch: pytest.MonkeyPatch, said: str, width: int) -> None:
    """A long sentence fills the lines; what is no width is as nothing said."""
    monkeypatch.setenv("COLUMNS", said)
    shown = folder.armcal("effects joint_compliance").out.splitlines()
    assert width - 20 < max(len(line.rstrip()) for line in shown) <= width  # 20: the next word, which did not fit


@pytest.mark.skipif(not FULL.exists(), reason="no full device here")
@pytest.mark.parametrize("words", ["effects backlash --json", "score --help"])
def test_a_full_device(folder: Folder, words: str) -> None:
    done = shell(folder, words, f"> {FULL}")
    assert done.returncode == 1, done.stderr
    assert without_progress(done.stderr) == "armcal: standard output cannot be written (No space left on device)\n"


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no such device here")
def test_an_output_that_is_no_file_is_refused_before_the_work(folder: Folder) -> None:
    """The work would fail: the measurements are no table."""
    folder.write("data.csv", "")
    reading, writing = os.pipe()
    for out in (f"/dev/fd/{writing}", "/dev/null"):
        done = folder.armcal(f"identify arm.toml data.csv --out {out} --force")
        assert done.err == f"armcal: {out}: is not a regular file, allowed: a new file name\n"
    os.close(reading)
    os.close(writing)


def test_closed_streams(folder: Folder) -> None:
    done = shell(folder, "design arm.toml --runs 8 --out new.csv", ">&-")
    assert done.returncode == 1, done.stderr
    assert without_progress(done.stderr) == "armcal: standard output is closed; send it to a file or to /dev/null\n"
    assert not (folder.path / "new.csv").exists()
    done = shell(folder, "effects backlash --json", "2>&-")
    assert (done.returncode, done.stdout[0]) == (0, "{")


# -- progress where standard error is no terminal ----------------------------------------------------------------------
def test_a_line_now_and_then(capfd: pytest.CaptureFixture[str]) -> None:
    with shown_progress("design", quiet=False, interval=0.02) as tell:
        for done, total, said in ((0, None, ""), (3, 10, ", best -1.35, 30 % done")):
            time.sleep(0.05)
            for _ in range(2):
                tell(done, total, "best -1.35" if done else "")
            assert capfd.readouterr().err == f"armcal design: 0 s{said}\n"
    with shown_progress("design", quiet=True) as report:
        assert report == Progress()


# -- signals -----------------------------------------------------------------------------------------------------------
class Ending:
    """An object at whose end a signal comes."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


def test_a_signal_that_meets_the_end_of_an_object_comes_again() -> None:
    def work() -> None:
        Ending()
        time.sleep(60.0)

    began = time.monotonic()
    with pytest.raises(JobError, match=r"^stopped by SIGTERM, in the end$"), interruptible(", in the end"), stoppable():
        work()
    assert time.monotonic() - began < 30.0  # what sleeps is woken


# -- how a command ends ------------------------------------------------------------------------------------------------
HALF_LOADED = """
import atexit, os, sys

class HalfLoaded:
    def __del__(self):
        os.abort()

there = HalfLoaded()  # until Python takes its modules down
atexit.register(print, "left in order")
sys.argv = ["armcal", "score", "none.toml", "none.csv"]
from doe.__main__ import run
run()
"""


def test_a_command_that_fails_ends_without_taking_libraries_down(tmp_path: Path) -> None:
    """A library that aborts when it is taken down, as half-loaded ones in C do; what is due at the end is done."""
    words = [sys.executable, "-c", HALF_LOADED]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "left in order\n")
    assert done.stderr.startswith("armcal: none.toml: ")
    assert done.stderr.count("\n") == 1
