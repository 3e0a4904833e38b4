"""A folder with the files of a small loop, and a way to call `armcal` as a user does."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from doe.cli import main

ARM = """\
name = "paper-4-link"
links_mm = [260.0, 180.0, 120.0, 100.0]

[joint_limits_deg]
lower = [-180.0, -120.0, -100.0, -90.0]
upper = [180.0, 120.0, 60.0, 90.0]

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


def without_progress(text: str) -> str:
    """Standard error without the line every ten seconds, which only slow machines see."""
    return "".join(line for line in text.splitlines(keepends=True) if not re.match(r"armcal \w+: \d{2,} s\b", line))


class Folder:
    """A working directory with arm.toml, truth.toml, plan.csv."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.write("arm.toml", ARM)
        self.write("truth.toml", ARM + CALIBRATION)
        generator = np.random.default_rng(7)
        postures = generator.uniform([-180, -120, -100, -90], [180, 120, 60, 90], (12, 4))
        rows = [",".join([str(k + 1), *(f"{a:.6f}" for a in posture)]) for k, posture in enumerate(postures)]
        self.write("plan.csv", "\n".join(["run,q1_deg,q2_deg,q3_deg,q4_deg", *rows]) + "\n")

    def write(self, name: str, text: str) -> Path:
        (self.path / name).write_text(text)
        return self.path / name

    def read(self, name: str) -> str:
        return (self.path / name).read_text()

    def armcal(self, *words: str) -> Outcome:
        """Run the command in this folder."""
        done = CliRunner().invoke(main, list(words), catch_exceptions=False)
        return Outcome(done.exit_code, done.stdout, without_progress(done.stderr))

    def simulated(self, name: str = "data.csv", seed: int = 0) -> None:
        """Write data.csv, or another file: the truth measured at plan.csv."""
        words = ["simulate", "arm.toml", "plan.csv", "--truth", "truth.toml", "--out", name, "--seed", str(seed)]
        done = self.armcal(*words)
        assert done.code == 0, done.err


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Folder:
    monkeypatch.chdir(tmp_path)
    return Folder(tmp_path)
