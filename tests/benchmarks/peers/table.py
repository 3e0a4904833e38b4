"""Jobs in processes of their own, and the lines of the table that comes of them."""

from __future__ import annotations

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[3]
PYTHONS = [sys.executable, *filter(None, os.environ.get("ARMCAL_PEERS", "").split(os.pathsep))]
SECONDS = int(os.environ.get("ARMCAL_PEERS_SECONDS", "600"))  # of processor time, after which a process is stopped
MEMORY = 12 * 2**30  # bytes of address space
ABSENT, HEADER = "not installed", "| tool | value | | processor time | peak memory |\n|---|---|---|---|---|"


@dataclass(frozen=True)
class Row:
    """A tool's answer as we judge it; `said` where there is none.

    value : ours, computed from its answer;  shown : the same for people
    """

    tool: str
    value: float | None = None
    shown: str = ""
    seconds: float = 0.0
    time: str = ""
    megabytes: float = 0.0
    said: str = ""

    def line(self, ours: Row) -> str:
        """In Markdown; times beside a multiple of ours."""
        if self.value is None:
            return f"| {self.tool} | {self.said} | | | |"
        ratio = "" if self is ours else f"{self.seconds / max(ours.seconds, 0.01):.2g} x"
        return f"| {self.tool} | {self.shown} | {ratio} | {self.time} | {self.megabytes:.0f} MB |"


@cache
def interpreter(modules: tuple[str, ...]) -> str | None:
    """The first of the Pythons that has all of these modules."""
    code = f"import importlib; [importlib.import_module(name) for name in {modules!r}]"
    for python in PYTHONS:
        if subprocess.run([python, "-c", code], cwd=ROOT, capture_output=True).returncode == 0:
            return python
    return None


def limited() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def answer_of(folder: Path, task: str, tool: str, modules: tuple[str, ...], **job: Any) -> dict[str, Any] | str:
    """What the tool's process wrote, or a sentence why it did not."""
    python = interpreter(modules)
    if python is None:
        return ABSENT
    question, written = folder / "job.json", folder / "answer.npz"
    question.write_text(json.dumps({"task": task, "tool": tool} | job))
    written.unlink(missing_ok=True)
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    done = subprocess.run(
        [python, "-m", "tests.benchmarks.peers.tool", str(question), str(written)],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | threads, preexec_fn=limited,
    )  # fmt: skip
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return f"no answer in {SECONDS} s"
    if done.returncode:
        return f"failed: {(done.stderr.strip().splitlines() or ['?'])[-1][:80]}"
    with np.load(written) as data:
        return {name: data[name] for name in data}


def compared(
    folder: Path, title: str, task: str, judged: Callable[[dict[str, Any]], tuple[float, str, str]], **job: Any
) -> list[Row]:
    """All tools of a task on one job, printed as they come; the first is armcal.

    judged : answer -> value, the same for people, time for people
    """
    print(f"\n\n**{title}**\n\n{HEADER}")
    rows: list[Row] = []
    left_out = job.pop("left_out", ())
    for name, tool in importlib.import_module(f"tests.benchmarks.peers.{task}").TOOLS.items():
        if name not in left_out:
            found = answer_of(folder, task, name, tool.modules, **job)
            rows.append(row_of(name, found, judged))
            print(rows[-1].line(rows[0]), flush=True)
    return rows


def row_of(name: str, found: dict[str, Any] | str, judged: Callable[[dict[str, Any]], tuple[float, str, str]]) -> Row:
    """With the tool's version."""
    if isinstance(found, str):
        return Row(name, said=found)
    value, shown, time = judged(found)
    version = str(found.get("version", ""))
    named = f"{name} {version}".strip()
    return Row(named, value, shown, float(found["seconds"]), time, float(found["megabytes"]))
