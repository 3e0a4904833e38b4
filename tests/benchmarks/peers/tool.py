"""One tool on one job, in a process of its own: `python -m tests.benchmarks.peers.tool JOB.json ANSWER.npz`.

The clock is the processor's and leaves imports out; the peak of memory counts everything, the interpreter too.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import resource
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

Answer = dict[str, Any]


class Tool(NamedTuple):
    """run : arguments of the job -> arrays of the answer;  modules : what it imports, the first ones its own"""

    run: Callable[..., Answer]
    modules: tuple[str, ...]


def processor_seconds() -> float:
    """Of this process and of the processes it has waited for."""
    return sum(os.times()[:4])


def peak_megabytes() -> float:
    """Of the largest single process; `ru_maxrss` of this one would count the process that started it."""
    with open("/proc/self/status") as file:
        own = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    return max(own, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024.0


def version(modules: tuple[str, ...]) -> str:
    """Of the distribution that the first module belongs to; nothing for this project's own."""
    try:
        return importlib.metadata.version(modules[0].split(".")[0]) if modules else ""
    except importlib.metadata.PackageNotFoundError:
        return ""


def main(job_file: str, answer_file: str) -> None:
    """Job: `task` (module here), `tool`, and arguments."""
    with open(job_file) as file:
        job = json.load(file)
    tool = importlib.import_module(f"tests.benchmarks.peers.{job.pop('task')}").TOOLS[job.pop("tool")]
    for module in tool.modules:
        importlib.import_module(module)
    began = processor_seconds()
    answer = tool.run(**job)
    answer.setdefault("seconds", processor_seconds() - began)
    np.savez(answer_file, megabytes=peak_megabytes(), version=version(tool.modules), **answer)


if __name__ == "__main__":
    main(*sys.argv[1:])
