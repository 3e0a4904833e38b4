"""A folder with the files of a small loop, and ways to call `armcal` as a user does."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from doe.cli import main

LOWER, UPPER = [-180.0, -120.0, -100.0, -90.0], [180.0, 120.0, 60.0, 90.0]
ARM = f"""\
name = "paper-4-link"
links_mm = [260.0, 180.0, 120.0, 100.0]

[joint_limits_deg]
lower = {LOWER}
upper = {UPPER}

[measurement]
sigma_mm = 0.1
"""
CALIBRATION = """
[calibration]
length_errors_mm = [1.5, -0.6, -0.4, 0.7]
joint_offsets_deg = [0.5, -0.5, 0.7, -0.3]
"""


@dataclass(frozen=True)
class Outcome:
    """Exit code and the two streams of one call."""

    code: int
    out: str
    err: str

    @property
    def data(self) -> dict:
        """The JSON object on standard output (fails if there is anything else)."""

        def refuse(text: str) -> None:
            raise AssertionError(f"JSON holds {text}")

        return json.loads(self.out, parse_constant=refuse)

    @property
    def flat(self) -> str:
        """Standard output in one line."""
        return " ".join(self.out.split())


def without_progress(text: str) -> str:
    """Standard error without the line every ten seconds, which only slow machines see."""
    return "".join(line for line in text.splitlines(keepends=True) if not re.match(r"armcal \w+: \d{2,} s\b", line))


def table(columns: dict[str, Any]) -> str:
    """A CSV file of these columns."""
    rows = zip(*(np.asarray(column).tolist() for column in columns.values()), strict=True)
    return "".join(f"{','.join(map(str, row))}\n" for row in [list(columns), *rows])


class Folder:
    """A working directory with arm.toml, truth.toml, plan.csv."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.write("arm.toml", ARM)
        self.write("truth.toml", ARM + CALIBRATION)
        self.plan(12, 7)

    def write(self, name: str, text: str) -> Path:
        (self.path / name).write_text(text)
        return self.path / name

    def read(self, name: str) -> str:
        return (self.path / name).read_text()

    def plan(self, rows: int, seed: int, name: str = "plan.csv") -> None:
        """Write a plan of random postures within the limits."""
        postures = np.random.default_rng(seed).uniform(LOWER, UPPER, (rows, 4)).round(6)
        angles = {f"q{j}_deg": column for j, column in enumerate(postures.T, start=1)}
        self.write(name, table({"run": range(1, len(postures) + 1), **angles}))

    def armcal(self, *words: str) -> Outcome:
        """Run the command in this folder, with these words, or those of one line."""
        line = words[0].split() if len(words) == 1 and " " in words[0] else [*words]
        done = CliRunner().invoke(main, line, catch_exceptions=False)
        return Outcome(done.exit_code, done.stdout, without_progress(done.stderr))

    def said(self, line: str) -> dict:
        """The JSON object of a command that is done."""
        done = self.armcal(f"{line} --json")
        assert done.code == 0, done.err
        return done.data

    def simulated(
        self, name: str = "data.csv", seed: int = 0, truth: str = "truth.toml", plan: str = "plan.csv"
    ) -> None:
        """Write data.csv, or another file: the truth measured at plan.csv, or at another plan."""
        self.said(f"simulate arm.toml {plan} --truth {truth} --out {name} --seed {seed} --force")

    def refused(self, words: str | list[str], *named: str, code: int = 2) -> None:
        """One line on standard error that names all of this, nothing on standard output, and every file as it was."""
        before = {path: path.read_bytes() for path in self.path.rglob("*") if path.is_file()}
        done = self.armcal(*([words] if isinstance(words, str) else words))
        assert (done.code, done.out) == (code, ""), (done.code, done.out, done.err)
        (line,) = (line for line in done.err.splitlines() if not line.startswith("armcal: warning:"))
        assert line.isprintable()
        assert [text for text in named if text not in line] == [], line
        assert {path: path.read_bytes() for path in self.path.rglob("*") if path.is_file()} == before


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Folder:
    monkeypatch.chdir(tmp_path)
    return Folder(tmp_path)
