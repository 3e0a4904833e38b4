"""Times of exact design: `pytest -m benchmark -s tests/benchmarks/test_design_speed.py`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from doe.solvers import solve
from identification.arm import Arm
from tests.doe.arms import FIVE, FOUR, SIX, problem
from tests.doe.cli.conftest import ARM

pytestmark = pytest.mark.benchmark

BARS = [  # arm, runs, value to reach, seconds allowed
    *((FOUR, m, -0.0612353 - 1e-7, 3.0) for m in (4, 8, 12, 20)),
    (FOUR, 5, -0.28088, 3.0), (FOUR, 6, -0.29681, 3.0), (FOUR, 7, -0.19866, 3.0), (FOUR, 9, -0.13104, 3.0),
    (FOUR, 10, -0.14289, 3.0), (FOUR, 14, -0.10248, 3.0), (FOUR, 18, -0.08609, 3.0),
    (FIVE, 5, -1.358411, 10.0), (FIVE, 8, -0.704662, 10.0), (FIVE, 11, -0.830503, 10.0), (FIVE, 16, -0.704179, 10.0),
    (SIX, 8, -1.624468, 20.0), (SIX, 12, -1.433951, 20.0), (SIX, 20, -1.351505, 20.0), (SIX, 32, -1.299458, 20.0),
]  # fmt: skip


@pytest.mark.parametrize(("arm", "runs", "value", "seconds"), BARS)
def test_best_known_value_in_time(arm: Arm, runs: int, value: float, seconds: float) -> None:
    case = problem(arm)
    began = time.perf_counter()
    design = solve(case, runs)
    took = time.perf_counter() - began
    print(
        f"{arm.links} links, m = {runs:2}: {design.log_det:.7f} (bar {value:.7f}) in {took:.2f} s (bar {seconds:g} s)"
    )
    assert design.log_det >= value
    assert took <= seconds


def test_whole_design_process(tmp_path: Path) -> None:
    """`armcal design`, 4 links, m = 20: at most 2 s and 400 MB, imports included."""
    (tmp_path / "arm.toml").write_text(ARM)
    own_memory = "atexit.register(lambda: print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr))"
    code = f"import atexit, resource, sys; {own_memory}; from doe.cli import main; main()"
    command = [sys.executable, "-c", code, "design", "arm.toml", "--runs", "20", "--json"]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    began = time.perf_counter()
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True, env=environment)
    took = time.perf_counter() - began
    megabytes = int(done.stderr.split()[-1]) / 1024
    print(f"armcal design, 4 links, m = 20: {took:.2f} s, {megabytes:.0f} MB (bars 2 s, 400 MB)")
    assert json.loads(done.stdout)["certified_optimal"]
    assert took <= 2.0
    assert megabytes <= 400.0
