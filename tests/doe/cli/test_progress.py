"""Progress where standard error is no terminal."""

from __future__ import annotations

import re
import time

import pytest

from doe.cli.progress import Lines, lines, shown_progress
from identification.progress import silent


def test_a_line_now_and_then_also_from_a_silent_job(capfd: pytest.CaptureFixture[str]) -> None:
    with lines("design", interval=0.05) as report:
        report(3, 10, "best -1.35")
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


def test_without_a_total_there_is_no_time_left() -> None:
    told = Lines("diagnose", started=time.monotonic() - 20.0)
    told.tell(2, None, "testing the effects, pass 1")
    assert told.text() == "armcal diagnose: 20 s, testing the effects, pass 1"
    told.tell(0, 10, "")
    assert told.text() == "armcal diagnose: 20 s"


def test_quiet_says_nothing() -> None:
    with shown_progress("design", quiet=True) as report:
        assert report is silent
