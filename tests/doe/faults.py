"""Commands killed at random moments: what must hold of the files, the processes and the next run.

Every command is first run once to its end: its files are the reference. Then it is started again, in a new folder and a
session of its own, and stopped by a signal after a part of that time. What must hold afterwards is in `verdict`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

ROOT = Path(__file__).parents[2]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
PATIENCE = 90.0  # [s] for an end after the signal, and for the rerun, on a busy machine
TIMES = ("seconds", "seconds_to_hit", "peak_memory_mb")

ARM = """name = "arm"
links_mm = [260.0, 180.0, 120.0]
[joint_limits_deg]
lower = [-180.0, -120.0, -100.0]
upper = [180.0, 120.0, 60.0]
[measurement]
sigma_mm = 0.1
"""
STUDY = """arms = ["arm.toml"]
plans = ["dft", "random"]
runs = [6]
replications = 2000
"""


class Command(NamedTuple):
    """What is killed.

    words : of the command line;  again : what a run after the kill has besides, if there are files
    paths : files and folders that it writes;  best_so_far : whether Ctrl-C may leave another plan than the last
    """

    name: str
    words: str
    again: str
    paths: tuple[str, ...]
    best_so_far: bool = False


COMPARE = "compare arm.toml --runs 5 --solvers random,exchange --repeats 1 --starts 2 --out compared"
DESIGN = "design arm.toml --runs 7 --starts 12 --seconds 60 --out plan.csv"
DIAGNOSE = "diagnose arm.toml data.csv --out extended.toml --report gap.html --force"
COMMANDS = (
    Command("study", "study study.toml --workers 2", "--resume --workers 1", ("study.results",)),
    Command("compare", COMPARE, "--resume", ("compared",)),
    Command("design --seconds", DESIGN, "--force", ("plan.csv",), best_so_far=True),
    # its page shows the command line: with more words it would be another page
    Command("diagnose", DIAGNOSE, "", ("extended.toml", "gap.html")),
    Command("demo", "demo --out demo --force", "", ("demo",)),
)


class Reference(NamedTuple):
    """A run to the end: its files, and how long it took [s]."""

    command: Command
    files: dict[str, Any]
    seconds: float

    @classmethod
    def of(cls, command: Command, folder: Path) -> Reference:
        began = time.monotonic()
        code, errors = ended(start(command, prepare(folder)))
        assert code == 0, errors
        return cls(command, content(command, folder), time.monotonic() - began)


def prepare(folder: Path) -> Path:
    """A new folder with what the commands read."""
    folder.mkdir(parents=True)
    (folder / "arm.toml").write_text(ARM)
    (folder / "study.toml").write_text(STUDY)
    generator = np.random.default_rng(3)
    angles = generator.uniform([-180, -120, -100], [180, 120, 60], (24, 3))
    reached = np.exp(1j * np.cumsum(np.radians(angles), axis=1)) @ [261.0, 179.5, 120.3]
    places = np.column_stack([reached.real, reached.imag]) + 0.1 * generator.standard_normal((24, 2))
    header = "q1_deg,q2_deg,q3_deg,x_mm,y_mm"
    np.savetxt(folder / "data.csv", np.hstack([angles, places]), "%.17g", ",", header=header, comments="")
    return folder


def session_of(process: int) -> int | None:
    """Session of a process that works, not of one that has ended and waits to be collected."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[3])


def running(process: int) -> bool:
    """Whether the process of this number works."""
    return session_of(process) is not None


def left_of(session: int, seconds: float = 10.0) -> list[int]:
    """Processes of a session that still work after so many seconds."""
    deadline = time.monotonic() + seconds
    while True:
        numbers = (int(path.name) for path in Path("/proc").glob("[0-9]*"))
        left = [number for number in numbers if session_of(number) == session]
        if not left or time.monotonic() > deadline:
            return left
        time.sleep(0.05)


def start(command: Command, folder: Path, more: str = "") -> subprocess.Popen[str]:
    """The command in a session of its own, both streams kept."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "stdin": subprocess.DEVNULL}
    line = [sys.executable, "-m", "doe", *command.words.split(), *more.split(), "--json", "--quiet"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(line, cwd=folder, env=environment, text=True, start_new_session=True, **pipes)


def ended(process: subprocess.Popen[str]) -> tuple[int | None, str]:
    """Exit code and standard error of a process; no code where it had to be killed after `PATIENCE`."""
    try:
        errors = process.communicate(timeout=PATIENCE)[1]
        return process.returncode, errors
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return None, process.communicate()[1]


def content(command: Command, folder: Path) -> dict[str, Any]:
    """Path -> what is in each file that the command wrote: bytes, or the rows of a table without times."""
    files: dict[str, Any] = {}
    for path in (folder / name for name in command.paths):
        for file in sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []:
            table = file.suffix == ".parquet"
            text = pl.read_parquet(file).drop(TIMES, strict=False).write_json() if table else file.read_bytes()
            files[str(file.relative_to(folder))] = text
    return files


def verdict(
    reference: Reference, folder: Path, number: signal.Signals, share: float, *, again: bool = True
) -> list[str]:
    """What is wrong after a kill: nothing, if the list is empty.

    share : of the reference's time after which the signal comes;  again : whether the run after it is checked too
    """
    command, whole = reference.command, reference.files
    process = start(command, prepare(folder))
    time.sleep(share * reference.seconds)
    # Ctrl-C goes to all of them, as from a terminal
    (os.killpg if number is signal.SIGINT else os.kill)(process.pid, number)
    code, errors = ended(process)
    if code is None:
        return ["does not end"]
    left = left_of(process.pid)
    for one in left:
        os.kill(one, signal.SIGKILL)
    wrong = ["processes left behind"] if left else []
    for name, text in content(command, folder).items():
        # as in the reference, or a table with fewer rows, or another plan with as many
        lines = whole.get(name, b"").count(b"\n") if command.best_so_far else None
        if "nothing was written" in errors:
            wrong.append(f"{name} was written")
        elif name not in whole:
            wrong.append(f"{name} left behind")
        elif text != whole[name] and not name.endswith(".parquet") and text.count(b"\n") != lines:
            wrong.append(f"{name} is half written")
    by = "Ctrl-C" if number is signal.SIGINT else number.name
    if "Traceback" in errors or "Exception ignored" in errors:
        wrong.append("traceback: " + errors.strip().splitlines()[-1])
    elif code not in (-number, 0) and not (code == 1 and errors.count("\n") == 1 and f"stopped by {by}" in errors):
        wrong.append(f"exit code {code}: {errors.strip()[-200:]!r}")
    if again:
        code, errors = ended(start(command, folder, command.again if content(command, folder) else ""))
        if code != 0:
            wrong.append("the rerun does not end" if code is None else f"the rerun fails: {errors.strip()[-200:]!r}")
        elif content(command, folder) != whole:
            wrong.append("the rerun gives other bits")
    return wrong
