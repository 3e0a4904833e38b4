"""A root file system that is read-only: no folder for temporary files, none for settings, only the outputs' folder.

Permissions do not bind the superuser, so the places that the system offers are taken away instead: `tempfile` finds
none, and home and settings are below a file.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.doe.cli.conftest import Folder, without_progress

ROOT = Path(__file__).parents[3]
START = """
import os, sys, tempfile, doe.cli.verb as common
tempfile._candidate_tempdir_list = lambda: [os.environ.get("TMPDIR", "/dev/null/none")]
common.SHARED_MEMORY = common.Path("/dev/null/none")
from doe.cli import main
for words in sys.argv[1:]:
    try:
        main(words.split())
    except SystemExit as end:
        assert not end.code, words
"""
COMMANDS = (
    "design arm.toml --runs 8 --starts 1 --picture outputs/plan.png --out outputs/plan.csv",
    "score arm.toml plan.csv",
    "advise arm.toml --runs 6:7",
    "compare arm.toml --runs 8 --solvers random --out outputs/new",
    "check arm.toml data.csv",
    "identify arm.toml data.csv --out outputs/calibrated.toml",
    "validate outputs/calibrated.toml data.csv --picture outputs/errors.svg",
    "compensate outputs/calibrated.toml targets.csv --out outputs/commands.csv",
    "report arm.toml outputs/calibrated.toml plan.csv data.csv --out outputs/page.html",
)


def test_verbs_on_a_read_only_root(folder: Folder) -> None:
    """All in one process: to start one takes longer than to work."""
    folder.simulated()
    folder.write("targets.csv", "x_mm,y_mm\n400,300\n")
    (folder.path / "outputs").mkdir()
    environment = {name: value for name, value in os.environ.items() if name not in ("TMPDIR", "TEMP", "TMP")}
    environment |= dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"), "/dev/null/none")
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-c", START, *COMMANDS]
    done = subprocess.run(command, cwd=folder.path, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    outputs = (folder.path / "outputs").rglob("*")
    assert [path.name for path in outputs if "tmp" in path.name or "matplotlib" in path.name] == []
