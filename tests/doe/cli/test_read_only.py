"""A root file system that is read-only: no folder for temporary files, none for settings, only the outputs' folder.

Permissions do not bind the superuser, so the places that the system offers are taken away instead: `tempfile` finds
none, and home and settings are below a file.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.doe.cli.conftest import Folder, without_progress

ROOT = Path(__file__).parents[3]
START = (
    "import os, sys, tempfile, doe.cli.common as common\n"
    "tempfile._candidate_tempdir_list = lambda: [os.environ.get('TMPDIR', '/dev/null/none')]\n"
    "common.SHARED_MEMORY = common.Path('/dev/null/none')\n"
    "from doe.cli import main\n"
    "main(sys.argv[1:])"
)


@pytest.fixture
def loop(folder: Folder) -> Folder:
    folder.simulated()
    assert folder.armcal("identify", "arm.toml", "data.csv", "--out", "calibrated.toml").code == 0
    folder.write("targets.csv", "x_mm,y_mm\n400,300\n")
    (folder.path / "outputs").mkdir()
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "design arm.toml --runs 8 --starts 1 --picture outputs/plan.png --out outputs/plan.csv",
        "score arm.toml plan.csv",
        "advise arm.toml --runs 6:7",
        "compare arm.toml --runs 8 --solvers random --out outputs/new",
        "check arm.toml data.csv",
        "identify arm.toml data.csv --out outputs/calibrated.toml",
        "validate calibrated.toml data.csv",
        "validate calibrated.toml data.csv --picture outputs/errors.svg",
        "compensate calibrated.toml targets.csv --out outputs/commands.csv",
        "report arm.toml calibrated.toml plan.csv data.csv --out outputs/page.html",
    ],
)
def test_verbs_on_a_read_only_root(loop: Folder, words: str) -> None:
    nowhere = "/dev/null/none"
    environment = {name: value for name, value in os.environ.items() if name not in ("TMPDIR", "TEMP", "TMP")}
    environment |= {"PYTHONPATH": str(ROOT)} | dict.fromkeys(
        ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR"), nowhere
    )
    command = [sys.executable, "-c", START, *words.split()]
    done = subprocess.run(
        command,
        cwd=loop.path,
        env={**environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, without_progress(done.stderr)) == (0, ""), done.stderr
    left = [path.name for path in (loop.path / "outputs").rglob("*") if "tmp" in path.name or "matplotlib" in path.name]
    assert left == []
