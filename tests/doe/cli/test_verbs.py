"""What all verbs share: options by a signature, help, files, streams, progress, signals, and a read-only system."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from io import StringIO
from pathlib import Path
from typing import Annotated, Any, Literal

import click
import pytest
from click.testing import CliRunner
from rich.console import Console
from rich.progress import Progress as Bar

from doe.cli import main
from doe.cli.verb import (
    FOLDER,
    FilePath,
    Lines,
    Names,
    WholeNumbers,
    bar_columns,
    check_outputs,
    lines,
    shown_progress,
    stoppable,
    stopped_by,
    verb,
)
from doe.studies.monte_carlo import StudyFile
from identification.document import Answer
from identification.errors import InputError
from identification.running import silent
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
        return Answer({"here": arm}, ["transmission_ripple:1[k=20] and [red]"])

    line = "a.toml b.csv c.csv --runs 3,4 --width 5 --only x --only y,z --no-check --seed 7"
    done = CliRunner().invoke(command, [*line.split(), "--json"])
    assert (done.exit_code, done.stdout) == (0, '{"here": "a.toml"}\n')
    assert got == {
        "arm": Path("a.toml"), "data": (Path("b.csv"), Path("c.csv")), "runs": [3, 4], "color": "red",
        "only": ("x", "y,z"), "check": False, "size": Size(5, 3), "in_all": None, "seed": 7,
    }  # fmt: skip
    assert CliRunner().invoke(command, line.split()).stdout == "transmission_ripple:1[k=20] and [red]\n"  # no markup
    names = "arm data runs color only check width depth in_all as_json seed quiet"
    assert [parameter.name for parameter in command.params] == names.split()  # the order of the help
    page = " ".join(CliRunner().invoke(command, ["--help"]).stdout.split())
    assert command.short_help == "Paint a wall."
    for text in ("Paint a wall. More of it.", "--only NAMES These.", "How deep, in all. [default: 3; x<=9]", "paint"):
        assert text in page
    right = "a.toml b.csv --runs 3 --width 5"
    for part, wrong in ((" b.csv", ""), (" --runs 3", ""), (" --width 5", ""), ("3", "0"), ("5", "five")):
        assert CliRunner().invoke(command, right.replace(part, wrong).split()).exit_code == 2


def test_help_formats_and_versions(folder: Folder) -> None:
    formats = folder.said("help ")
    assert "links_mm" in formats["text"]
    assert "**`design`, `score`**" in formats["text"]
    assert "temperature_C" in folder.armcal("help formats").out
    assert folder.armcal("help design").out.strip() == folder.armcal("design --help").out.strip()
    shown = folder.armcal("--version")
    assert shown.code == 0
    assert all(f"{name} {version(name)}" in shown.out for name in ("armcal", "casadi", "clarabel"))
    example = folder.armcal("study --help").out.partition("(names of files are beside it):\n")[2]
    study = StudyFile.model_validate(tomllib.loads(example))
    assert (study.replications, [truth.name for truth in study.truths]) == (10_000, ["eccentric"])


@pytest.mark.parametrize("name", main.commands)
def test_the_help_of_a_verb_has_an_example_and_fits_a_terminal(folder: Folder, name: str) -> None:
    example = str(main.commands[name].epilog).partition("Example:\n")[2].partition("\n")[0]
    assert example.startswith(f"  armcal {name} ")
    shown = folder.armcal(name, "--help").out
    assert max(map(len, shown.splitlines())) <= 80
    assert shown.replace("\n", "").isprintable()


def test_the_list_of_effects_and_one_of_them(folder: Folder) -> None:
    by_name = {found["name"]: found for found in folder.said("effects ")["effects"]}
    assert by_name["thermal_growth"]["parameters"] == [{"key": "a_per_K", "unit": "1/K", "typical": 2e-5}]
    assert by_name["link_bending"]["arms"] == ["planar"]
    shown = folder.armcal("effects transmission_ripple:2").out
    assert 'name = "transmission_ripple"' in shown
    assert "0.25 to 2000" in shown
    everything = folder.armcal("effects").out
    assert [name for name in by_name if f"  {name}" not in everything] == []


# -- files -------------------------------------------------------------------------------------------------------------


PATHS = [(verb, p) for verb in main.commands.values() for p in verb.params if isinstance(p.type, click.Path)]


def test_every_file_of_a_verb_is_read_or_written() -> None:
    """By its name, so that no new option stands on the wrong side."""
    names = {True: set[str](), False: set[str]()}
    for _, parameter in PATHS:
        assert isinstance(parameter.type, FilePath)
        names[parameter.type.written].add(str(parameter.name))
    assert names[True] == {"out", "picture", "aliases", "report", "curves", "urdf"}
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


START = """
import os, sys, tempfile, doe.cli.verb as verb
tempfile._candidate_tempdir_list = lambda: [os.environ.get("TMPDIR", "/dev/null/none")]
verb.SHARED_MEMORY = verb.Path("/dev/null/none")
from doe.cli import main
for words in sys.argv[1:]:
    try:
        main(words.split())
    except SystemExit as end:
        assert not end.code, words
"""
COMMANDS = (
    "design arm.toml --runs 8 --starts 1 --picture outputs/plan.png --out outputs/plan.csv",
    "identify arm.toml data.csv --out outputs/calibrated.toml",
    "compensate outputs/calibrated.toml targets.csv --out outputs/commands.csv",
    "report arm.toml outputs/calibrated.toml plan.csv data.csv --out outputs/page.html",
)


def test_verbs_on_a_read_only_root(folder: Folder) -> None:
    """No folder for temporary files, none for settings, only the outputs' folder; all in one process: to start one
    takes longer than to work.

    Permissions do not bind the superuser, so the places that the system offers are taken away instead: `tempfile` finds
    none, and home and settings are below a file.
    """
    folder.simulated()
    folder.write("targets.csv", "x_mm,y_mm\n400,300\n")
    (folder.path / "outputs").mkdir()
    environment = {name: value for name, value in os.environ.items() if name not in ("TMPDIR", "TEMP", "TMP")}
    environment |= dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"), "/dev/null/none")
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-c", START, *COMMANDS]
    done = subprocess.run(command, cwd=folder.path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    outputs = (folder.path / "outputs").rglob("*")
    assert [path.name for path in outputs if "tmp" in path.name or "matplotlib" in path.name] == []


# -- streams -----------------------------------------------------------------------------------------------------------
def shell(folder: Folder, words: str, redirection: str) -> subprocess.CompletedProcess[str]:
    """A command in a process of its own, as a shell starts it."""
    line = ["sh", "-c", f'"$0" -m doe {words} {redirection}', sys.executable]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(line, cwd=folder.path, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("said", "width"), [("60", 60), ("100", 100), ("0", 110), ("wide", 110), ("", 110)])
def test_a_pipe_is_as_wide_as_columns_says(
    folder: Folder, monkeypatch: pytest.MonkeyPatch, said: str, width: int
) -> None:
    """A long sentence fills the lines; what is no width is as nothing said."""
    monkeypatch.setenv("COLUMNS", said)
    shown = folder.armcal("effects gravity").out.splitlines()
    assert width - 20 < max(len(line.rstrip()) for line in shown) <= width  # 20: the next word, which did not fit


@pytest.mark.skipif(not FULL.exists(), reason="no full device here")
@pytest.mark.parametrize("words", ["effects backlash", "effects backlash --json", "score --help"])
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


def test_closed_streams_and_a_pipe_that_ends_early(folder: Folder) -> None:
    done = shell(folder, "score arm.toml plan.csv --picture plan.png", ">&-")
    assert done.returncode == 1, done.stderr
    assert without_progress(done.stderr) == "armcal: standard output is closed; send it to a file or to /dev/null\n"
    assert not (folder.path / "plan.png").exists()
    done = shell(folder, "effects backlash --json", "2>&-")
    assert (done.returncode, done.stdout[0]) == (0, "{")
    assert without_progress(shell(folder, "effects --json", "| true").stderr) == ""


# -- progress where standard error is no terminal ----------------------------------------------------------------------
def test_a_line_now_and_then_also_from_a_silent_job(capfd: pytest.CaptureFixture[str]) -> None:
    with lines("design", interval=0.05) as told:
        told.tell(3, 10, "best -1.35")
        time.sleep(0.3)
    said = capfd.readouterr().err.splitlines()
    assert len(said) >= 2
    assert all(re.fullmatch(r"armcal design: \d+ s, best -1\.35, 30 % done, about \d+ s left", line) for line in said)
    time.sleep(0.1)
    assert capfd.readouterr().err == ""
    with shown_progress("design", quiet=True) as report:
        assert report is silent


def test_time_left_is_that_of_the_rest_at_the_same_pace_and_counts_down() -> None:
    """80 s for four fifths leave 20 s, of which 15 have passed."""
    now = time.monotonic()
    told = Lines("study", started=now - 20.0)
    told.tell(4, 10, "1 failed")
    assert told.text() == "armcal study: 20 s, 1 failed, 40 % done, about 30 s left"
    told = Lines("diagnose", started=now - 95.0, done=0.8, total=1.0, message="step 3 of 4", advanced=now - 15.0)
    assert told.text() == "armcal diagnose: 95 s, step 3 of 4, 80 % done, about 5 s left"
    told.tell(0.8, 1.0, "step 3 of 4, curves")
    assert told.text().endswith("80 % done, about 5 s left")
    for done, total, message in ((2, None, "testing the effects, pass 1"), (0, 10, "")):
        told.tell(done, total, message)
        assert told.text() == f"armcal diagnose: 95 s{message and f', {message}'}"


@pytest.mark.parametrize("width", [60, 120])
def test_the_times_are_whole_in_a_narrow_terminal(width: int) -> None:
    """The longest that diagnose says: the clock, which is all that tells that it goes on, is never cut."""
    said = "step 2 of 4: scatter 2 of 3, further orders, other shapes 10 of 12, workspace"
    console = Console(file=StringIO(), width=width, force_terminal=True, color_system=None)
    with Bar(*bar_columns(), console=console, expand=True, auto_refresh=False) as shown:
        task = shown.add_task(said, total=10.0)
        shown.update(task, completed=5.0)
        shown.tasks[0].start_time = shown.get_time() - 3725.5
        (line,) = console.render_lines(shown.get_renderable(), pad=False)
    text = "".join(segment.text for segment in line)
    assert re.search(r" 1:02:05 (-:--:--|\d:\d\d:\d\d)$", text), text
    assert text.startswith(said[: width - 28])
    assert len(text) == width


def test_every_verb_says_that_it_is_at_work(folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those that have no steps to tell: here with a line at once instead of every ten seconds."""
    monkeypatch.setattr("doe.cli.verb.lines", partial(lines, interval=1e-4))
    assert "armcal score: 0 s" in folder.armcal("score arm.toml plan.csv").err
    assert folder.armcal("score arm.toml plan.csv --quiet").err == ""


# -- signals -----------------------------------------------------------------------------------------------------------
class Ending:
    """An object at whose end a signal comes."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        signal.raise_signal(self.number)


@pytest.mark.parametrize(("number", "words"), [(signal.SIGTERM, "SIGTERM"), (signal.SIGINT, "Ctrl-C")])
def test_a_signal_that_meets_the_end_of_an_object_is_not_lost(
    number: signal.Signals, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    end = time.monotonic() + 20.0
    with pytest.raises(KeyboardInterrupt) as stopped, stoppable():  # noqa: PT012 - two statements are the point
        Ending(number)
        time.sleep(20.0)
    assert time.monotonic() < end  # the sleep was not slept to its end
    assert stopped_by(stopped.value) == f"stopped by {words}"
    assert capsys.readouterr().err == ""
