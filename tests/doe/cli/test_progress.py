"""Progress where standard error is no terminal."""

from __future__ import annotations

import re
import time
from functools import partial
from io import StringIO

import pytest
from rich.console import Console
from rich.progress import Progress as Bar

from doe.cli.verb import Lines, bar_columns, lines, shown_progress
from identification.running import silent
from tests.doe.cli.conftest import Folder


def test_a_line_now_and_then_also_from_a_silent_job(capfd: pytest.CaptureFixture[str]) -> None:
    with lines("design", interval=0.05) as told:
        told.tell(3, 10, "best -1.35")
        time.sleep(0.3)
    said = capfd.readouterr().err.splitlines()
    assert len(said) >= 2
    assert all(re.fullmatch(r"armcal design: \d+ s, best -1\.35, 30 % done, about \d+ s left", line) for line in said)
    time.sleep(0.1)
    assert capfd.readouterr().err == ""


def test_time_left_is_that_of_the_rest_at_the_same_pace() -> None:
    told = Lines("study", started=time.monotonic() - 20.0)
    told.tell(4, 10, "1 failed")
    assert told.text() == "armcal study: 20 s, 1 failed, 40 % done, about 30 s left"


def test_time_left_counts_down_while_nothing_advances() -> None:
    """80 s for four fifths leave 20 s, of which 15 have passed."""
    now = time.monotonic()
    told = Lines("diagnose", started=now - 95.0, done=0.8, total=1.0, message="step 3 of 4", advanced=now - 15.0)
    assert told.text() == "armcal diagnose: 95 s, step 3 of 4, 80 % done, about 5 s left"
    told.tell(0.8, 1.0, "step 3 of 4, curves")
    assert told.text().endswith("80 % done, about 5 s left")


def test_without_a_total_there_is_no_time_left() -> None:
    told = Lines("diagnose", started=time.monotonic() - 20.0)
    told.tell(2, None, "testing the effects, pass 1")
    assert told.text() == "armcal diagnose: 20 s, testing the effects, pass 1"
    told.tell(0, 10, "")
    assert told.text() == "armcal diagnose: 20 s"


@pytest.mark.parametrize("width", [60, 80, 120])
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
    folder.simulated()
    for words in (["score", "arm.toml", "plan.csv"], ["check", "arm.toml", "data.csv"]):
        assert f"armcal {words[0]}: 0 s" in folder.armcal(*words).err
    assert folder.armcal("score", "arm.toml", "plan.csv", "--quiet").err == ""


def test_quiet_says_nothing() -> None:
    with shown_progress("design", quiet=True) as report:
        assert report is silent
