"""Processes of our own, by loky (joblib): what hangs or crashes in one stops nothing else.

loky starts an ordinary Python, so it works from anywhere (a notebook, a pool, a dask worker); the process inherits no
locks or threads, and builds its own CasADi functions.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SINGLE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
QUIET = {
    "PYTHONSAFEPATH": "1",
    "PYTHONFAULTHANDLER": "",
}  # nothing is imported from the folder it starts in, no traceback
GRACE = 60.0  # [s] for the interpreter to start and import; not part of the limit on the call itself


@dataclass(frozen=True)
class Outcome:
    """How a call in its own process ended.

    value : what it returned, None unless `status` is "done"
    status : "done", "failed" (it raised), "timeout" (killed), "crashed" (the process died)
    error : one line on what went wrong
    seconds : wall time of the call itself, without starting the process
    peak_memory_mb : largest resident memory of the process, with its imports; None where the system does not give it
    """

    value: Any
    status: str
    error: str | None
    seconds: float
    peak_memory_mb: float | None


class OneProcess:
    """A process of this machine with one thread of linear algebra, started at the first call."""

    def __init__(self) -> None:
        from joblib.externals.loky import ProcessPoolExecutor

        # of loky's tracker, which would print what a killed process leaves behind and it removes
        os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
        self._executor: Executor = ProcessPoolExecutor(
            1, env={**SINGLE_THREAD, **QUIET}, initializer=_end_with, initargs=(os.getpid(),)
        )

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """The call, one after another. Its future raises `BrokenExecutor` if the process dies."""
        # a dask worker is a daemon, which may have no children since they would outlive it: ours do not
        multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for the one that asked
        try:
            return self._executor.submit(function, *arguments)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def kill(self) -> None:
        """Ends the process, whatever it does."""
        self._executor.shutdown(kill_workers=True)  # type: ignore[call-arg]


def call(function: Callable[..., Any], *arguments: Any, seconds: float) -> Outcome:
    """`function(*arguments)` in a new process, killed `seconds` [s] after it was called.

    function : importable by name there;  arguments : picklable
    """
    process, started = OneProcess(), time.monotonic()
    try:
        process.submit(id, function).result(GRACE)  # its module is imported by now
        started = time.monotonic()
        return process.submit(_measured, function, arguments).result(seconds)
    except TimeoutError:
        return Outcome(None, "timeout", f"killed after {seconds:g} s", seconds, None)
    except BrokenExecutor as error:
        code = re.search(r"\((-?\d+)\)\}", str(error))
        number = int(code[1]) if code else 1
        reason = f"signal {-number}" if number < 0 else f"exit code {number}"
        return Outcome(None, "crashed", reason, time.monotonic() - started, None)
    finally:
        process.kill()


def _measured(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Outcome:
    """The call, in the new process; what it prints goes nowhere: solvers print banners."""
    for stream in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
    started = time.perf_counter()
    try:
        value, status, error = function(*arguments), "done", None
    except Exception as raised:  # noqa: BLE001 - every failure becomes the outcome
        value, status, error = None, "failed", one_line(raised)
    return Outcome(value, status, error, time.perf_counter() - started, peak_memory_mb())


def _end_with(parent: int) -> None:
    """Ends this process when the one that asked is gone: killed, it could not say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def one_line(error: BaseException) -> str:
    """`TypeName: message`, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far [MB]; None where the system does not give it.

    Of the address space: `getrusage` would count what the parent had before this process began.
    """
    status = Path("/proc/self/status")
    return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024.0 if status.exists() else None
