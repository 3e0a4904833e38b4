"""One call in a process of its own: value, time and memory, and every way in which it can end badly."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from doe.jobs.running import call

sys.path.insert(0, str(Path(__file__).parent))  # the new process finds the tasks by name
import work

from tests.doe.faults import running


def test_call_returns_value_seconds_and_memory() -> None:
    small, large = call(work.fill_memory, 1, seconds=60.0), call(work.fill_memory, 300, seconds=60.0)
    assert (small.status, small.value, small.error) == ("done", 2**17, None)
    assert large.peak_memory_mb is not None
    assert small.peak_memory_mb is not None
    assert 290.0 < large.peak_memory_mb - small.peak_memory_mb < 330.0  # the array, 300 MB, and nothing of ours


def test_hanging_call_is_killed() -> None:
    outcome = call(work.hang, 300.0, seconds=0.5)
    assert (outcome.status, outcome.value) == ("timeout", None)


def test_call_hanging_in_compiled_code_is_killed() -> None:
    """Python's own signals and timers would wait for the interpreter, which that code does not give back."""
    assert call(work.hang_in_compiled_code, seconds=0.5).status == "timeout"


def test_call_from_a_daemon() -> None:
    """As from a dask worker, which may not have children by `multiprocessing`."""
    queue = multiprocessing.get_context("spawn").Queue()
    process = multiprocessing.get_context("spawn").Process(target=work.call_from_here, args=(queue,), daemon=True)
    process.start()
    assert queue.get(timeout=60.0) == "done"
    process.join()


def test_a_call_ends_with_the_process_that_asked(tmp_path: Path) -> None:
    """Killed, that process cannot end it."""
    code = "import sys, work; work.ask_and_die(sys.argv[1])"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "pid")], env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    asked = int((tmp_path / "pid").read_text())
    for _ in range(600):
        if not running(asked):
            return
        time.sleep(0.05)
    pytest.fail("the call goes on")


def test_nothing_is_imported_from_the_folder_it_starts_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "doe").mkdir()
    (tmp_path / "doe" / "__init__.py").write_text("raise SystemExit('hijacked')")
    monkeypatch.chdir(tmp_path)
    assert call(work.hang, 0.0, seconds=60.0).value == "awake"


def test_raising_and_crashing_calls_are_told_apart() -> None:
    assert call(work.fail, seconds=10.0).error == "ArithmeticError: no answer"
    crashed = call(work.crash, seconds=10.0)
    assert crashed.status == "crashed"
    assert crashed.error is not None
    assert "signal 11" in crashed.error
