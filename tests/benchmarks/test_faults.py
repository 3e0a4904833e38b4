"""Commands killed at random moments, many of them: `--kills 200` of each, signals in turn; prints a table.

What is asked after every kill is in `tests/doe/faults.py`: whole files, no process left, no traceback, and the next run
gives the bits of one that was not disturbed.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.doe.faults import COMMANDS, SIGNALS, Command, Reference, random_kills

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_kills_at_random_moments(command: Command, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    count = request.config.getoption("--kills")
    reference = Reference.of(command, tmp_path / "reference")
    wrong = random_kills(reference, tmp_path, count, seed=len(command.name))
    sent = Counter(SIGNALS[kill % len(SIGNALS)].name for kill in range(count))
    print(f"\n| {command.name} | {reference.seconds:.1f} s |", end="")
    for name, number in sent.items():
        print(f" {number - len(wrong[name])} of {number} {name} |", end="")
    print("", *(f"\n  {name} {text}" for name, texts in wrong.items() for text in texts))
    assert not any(wrong.values())
