"""Signals that stop a verb, also where Python can raise nothing."""

from __future__ import annotations

import signal
import time

import pytest

from doe.cli.verb import stoppable, stopped_by


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
