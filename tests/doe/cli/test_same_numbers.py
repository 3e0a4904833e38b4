"""The same seed gives the same answer on the kernels of other processors, and with more threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from doe.cli import main
from tests.doe.faults import ROOT, prepare

COMMANDS = ("design arm.toml --runs 5 --starts 4", "identify arm.toml data.csv", "identify six.toml measured.csv")
ELBOW = ((0, 90, 400), (-600, 0, 0), (-500, 0, 0), (0, 90, 150), (0, -90, 120), (0, 0, 90))
CODE = """
import sys
from click.testing import CliRunner
from doe.cli import main
for words in sys.argv[1:]:
    print(CliRunner().invoke(main, [*words.split(), "--json", "--quiet"]).stdout.strip())
"""


def prepare_six(folder: Path) -> Path:
    """An arm of six axes, a plan of 30 postures, and what another truth measures there."""
    rows = "".join(f"[[dh]]\na_mm = {a}.0\nalpha_deg = {alpha}.0\nd_mm = {d}.0\n" for a, alpha, d in ELBOW)
    tool = "[tool]\nx_mm = 60.0\ny_mm = 20.0\nz_mm = 30.0\n"
    arm = f'kind = "spatial"\n{rows}{tool}[measurement]\nsigma_mm = 0.05\n'
    (folder / "six.toml").write_text(arm)
    true = '[calibration]\nvalues = {"joint_offset:2" = 0.3, "joint_offset:5" = -0.2, "translation_x:4" = 0.4}\n'
    (folder / "truth.toml").write_text(arm + true)
    generator = np.random.default_rng(4)
    lines = [",".join(["run", *(f"q{j}_deg" for j in range(1, 7))])]
    lines += [",".join(map(repr, [k, *generator.uniform(-150.0, 150.0, 6).tolist()])) for k in range(1, 31)]
    (folder / "plan.csv").write_text("\n".join(lines) + "\n")
    arm, plan, truth, out = (str(folder / name) for name in ("six.toml", "plan.csv", "truth.toml", "measured.csv"))
    done = CliRunner().invoke(main, ["simulate", arm, plan, "--truth", truth, "--out", out], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return folder


def test_the_same_answer_on_an_older_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same verdict and status, plan values to 1e-6, parameters to 1e-9 of their deviation, in the plane and with
    six axes; another process only for the other kernel: to start one takes longer than to work."""
    folder = prepare_six(prepare(tmp_path / "work"))
    monkeypatch.chdir(folder)
    here = [CliRunner().invoke(main, [*words.split(), "--json", "--quiet"]).stdout for words in COMMANDS]
    system = {"OPENBLAS_NUM_THREADS": "2", "PYTHONHASHSEED": "7", "OPENBLAS_CORETYPE": "Prescott"}
    environment = {**os.environ, **system, "PYTHONPATH": str(ROOT)}
    words = [sys.executable, "-c", CODE, *COMMANDS]
    other = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    for one, two in zip(map(json.loads, here), map(json.loads, other.stdout.splitlines()), strict=True):
        assert one.keys() == two.keys()
        for key in ("verdict", "effects", "status", "certified_optimal", "confirmed", "method"):
            assert one.get(key) == two.get(key), key
        for key in ("value", "log_det"):
            assert one.get(key) == pytest.approx(two.get(key), abs=1e-6)
        for row, same in zip(one.get("parameters", []), two.get("parameters", []), strict=True):
            assert row["name"] == same["name"]
            assert abs(row["value"] - same["value"]) <= 1e-9 * row["std"]
            assert row["std"] == pytest.approx(same["std"], rel=1e-9)
