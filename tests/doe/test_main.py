"""The command as a process: how it ends."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HALF_LOADED = """
import atexit, os, sys

class HalfLoaded:
    def __del__(self):
        os.abort()

there = HalfLoaded()  # until Python takes its modules down
atexit.register(print, "left in order")
sys.argv = ["armcal", "score", "none.toml", "none.csv"]
from doe.__main__ import run
run()
"""


def test_a_command_that_fails_ends_without_taking_libraries_down(tmp_path: Path) -> None:
    """A library that aborts when it is taken down, as half-loaded ones in C do; what is due at the end is done."""
    words = [sys.executable, "-c", HALF_LOADED]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "left in order\n")
    assert done.stderr.startswith("armcal: none.toml: ")
    assert done.stderr.count("\n") == 1
