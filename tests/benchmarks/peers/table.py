"""Tools on one job, each in a process of its own, and the lines of the table that comes of them.

The process: `python -m tests.benchmarks.peers.table JOB.json ANSWER.npz`. Its clock is the processor's and leaves
imports out; the peak of memory counts everything, the interpreter too.
"""

import importlib
import importlib.metadata
import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).parents[3]
PYTHONS = [sys.executable, *filter(None, os.environ.get("ARMCAL_PEERS", "").split(os.pathsep))]
SECONDS = int(os.environ.get("ARMCAL_PEERS_SECONDS", "600"))  # of processor time, after which a process is stopped
MEMORY = 12 * 2**30  # bytes of address space
MISSING = 3  # exit code of a process whose Python has not the modules of the tool
HEADER = "| tool | value | | processor time | peak memory |\n|---|---|---|---|---|"
Answer = dict[str, Any]


class Tool(NamedTuple):
    """run : arguments of the job -> arrays of the answer;  modules : what it imports, the first ones its own"""

    run: Callable[..., Answer]
    modules: tuple[str, ...] = ()


def processor_seconds() -> float:
    """Of this process and of the processes it has waited for."""
    return sum(os.times()[:4])


def answer_of(folder: Path, task: str, tool: str, modules: tuple[str, ...], **job: Any) -> Answer | str:
    """What the tool's process wrote, by the first of the Pythons that has its modules, or a sentence why it did not."""
    question, written = folder / "job.json", folder / "answer.npz"
    question.write_text(json.dumps({"task": task, "tool": tool, "modules": modules} | job))
    written.unlink(missing_ok=True)
    threads = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    for python in PYTHONS:
        line = [python, "-m", "tests.benchmarks.peers.table", str(question), str(written)]
        done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, env=os.environ | threads)
        if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
            return f"no answer in {SECONDS} s"
        if done.returncode not in (0, MISSING):
            return f"failed: {(done.stderr.strip().splitlines() or ['?'])[-1][:80]}"
        if done.returncode == 0:
            with np.load(written) as data:
                return {name: data[name] for name in data}
    return "not installed"


def compared(
    folder: Path,
    title: str,
    tools: str,
    judged: Callable[[Answer], tuple[float, str, str]],
    left_out: tuple[str, ...] = (),
    **job: Any,
) -> list[float]:
    """Values of all tools of one table (MODULE.TABLE) on one job, printed as they come; the first is armcal's.

    judged : answer -> value (the smaller the better), the same for people, time for people
    Returns the values, infinite where a tool gave no answer.
    """
    print(f"\n\n**{title}**\n\n{HEADER}")
    values, ours = [], 0.0
    for name, tool in table_of(tools).items():
        if name in left_out:
            continue
        answer = answer_of(folder, tools, name, tool.modules, **job)
        if isinstance(answer, str):
            values.append(np.inf)
            print(f"| {name} | {answer} | | | |", flush=True)
            continue
        value, shown, time = judged(answer)
        values.append(value)
        seconds, named = float(answer["seconds"]), f"{name} {answer['version']}".strip()
        ratio = f"{seconds / max(ours, 0.01):.2g} x" if ours else ""
        ours = ours or seconds
        print(f"| {named} | {shown} | {ratio} | {time} | {float(answer['megabytes']):.0f} MB |", flush=True)
    return values


def table_of(tools: str) -> dict[str, Tool]:
    """The tools of MODULE.TABLE, by name."""
    module, _, name = tools.partition(".")
    return dict(getattr(importlib.import_module(f"tests.benchmarks.peers.{module}"), name))


def main(question: Path, written: Path) -> None:
    """Runs one tool; job: `task` (MODULE.TABLE), `tool`, and arguments."""
    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    job = json.loads(question.read_text())
    try:
        for module in job.pop("modules"):
            importlib.import_module(module)
    except ImportError:
        sys.exit(MISSING)
    tool = table_of(job.pop("task"))[job.pop("tool")]
    began = processor_seconds()
    answer = tool.run(**job)
    answer.setdefault("seconds", processor_seconds() - began)
    status = Path("/proc/self/status").read_text().splitlines()  # `ru_maxrss` would count the process that started it
    own = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
    peak = max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024.0
    try:
        version = importlib.metadata.version(tool.modules[0].split(".")[0]) if tool.modules else ""
    except importlib.metadata.PackageNotFoundError:  # this project's own
        version = ""
    np.savez(written, megabytes=peak, version=version, **answer)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
