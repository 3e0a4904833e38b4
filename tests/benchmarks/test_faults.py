"""Commands killed at random moments, many of them: `--kills 200` of each, signals in turn; prints a table.

What is asked after every kill is in `tests/doe/faults.py`: whole files, no process left, no traceback, and the next run
gives the bits of one that was not disturbed.
"""

from pathlib import Path

import numpy as np
import pytest

from tests.doe.faults import COMMANDS, SIGNALS, Command, Reference, verdict

pytestmark = pytest.mark.benchmark


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_kills_at_random_moments(command: Command, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    reference = Reference.of(command, tmp_path / "reference")
    print(f"\n| {command.name} | {reference.seconds:.1f} s |", end="")
    moments = np.random.default_rng(len(command.name)).uniform(size=request.config.getoption("--kills"))
    wrong = []
    for first, number in enumerate(SIGNALS):
        shares = dict(enumerate(moments[first :: len(SIGNALS)].tolist()))
        verdicts = {s: verdict(reference, tmp_path / f"{number.name}{k}", number, s) for k, s in shares.items()}
        lines = [
            f"  {number.name} after {s:.2f} of its time: {'; '.join(said)}" for s, said in verdicts.items() if said
        ]
        print(f" {len(shares) - len(lines)} of {len(shares)} {number.name} |", end="")
        wrong += lines
    print("", *wrong, sep="\n")
    assert not wrong
