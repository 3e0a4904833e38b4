"""One call in a separate process, with a time limit: a call that hangs or crashes stops nothing else.

The process is an ordinary Python started for this call, so it works from anywhere (a notebook, a pool, or a dask
worker, which as a daemon may not start a pool of `multiprocessing` or pebble), inherits no locks or threads, and
builds its own CasADi functions. The limit is enforced by the watchdog of `faulthandler`: a thread in C, which ends the
process even while compiled code holds the interpreter.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SINGLE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
GRACE = 60.0  # [s] for the interpreter to start, import and answer; not part of the limit on the call itself
COMMAND = "from doe.jobs.isolated import serve; serve()"


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


def call(function: Callable[..., Any], *arguments: Any, seconds: float) -> Outcome:
    """`function(*arguments)` in a new process, killed `seconds` [s] after it was called.

    function : importable by name there;  arguments : picklable
    """
    task = pickle.dumps((os.getpid(), seconds, sys.path, pickle.dumps((function, arguments))))
    started = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", COMMAND],  # -P: nothing is imported from the folder it starts in
        env={**os.environ, **SINGLE_THREAD, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    try:
        result, errors = process.communicate(task, timeout=seconds + GRACE)
    except subprocess.TimeoutExpired:
        return Outcome(None, "timeout", f"killed after {seconds:g} s", seconds, None)
    finally:
        process.kill()
        process.communicate()
    return _outcome(process.returncode, result, errors, seconds, time.monotonic() - started)


def _outcome(code: int, result: bytes, errors: bytes, limit: float, wall: float) -> Outcome:
    if code == 0 and result:
        return Outcome(*pickle.loads(result))
    if b"Timeout (" in errors:  # the watchdog's first word
        return Outcome(None, "timeout", f"killed after {limit:g} s", limit, None)
    lines = errors.decode(errors="replace").strip().splitlines()
    reason = f"signal {-code}" if code < 0 else f"exit code {code}"
    return Outcome(None, "crashed", f"{reason}: {lines[-1] if lines else 'no message'}", wall, None)


def serve() -> None:
    """What runs in the new process: the task from standard input, the outcome to what was standard output."""
    channel = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # solvers print banners there
    parent, limit, search, task = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    sys.path[:] = search
    try:
        function, arguments = pickle.loads(task)
        faulthandler.dump_traceback_later(limit, exit=True)
        started = time.perf_counter()
        value, status, error = function(*arguments), "done", None
        seconds = time.perf_counter() - started
    except Exception as raised:  # noqa: BLE001 - every failure becomes the outcome
        value, status, error = None, "failed", one_line(raised)
        seconds = time.perf_counter() - started if "started" in locals() else 0.0
    faulthandler.cancel_dump_traceback_later()
    with channel:
        channel.write(pickle.dumps((value, status, error, seconds, peak_memory_mb())))


def _end_with(parent: int) -> None:
    """Ends this process when the one that asked is gone: killed, it could not say so."""
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)


def one_line(error: BaseException) -> str:
    """`TypeName: message`, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far [MB].

    Linux's own figure of the address space: `getrusage` would count what the parent had before this process began.
    """
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 1024.0
    except (OSError, IndexError):
        return _peak_of_usage()


def _peak_of_usage() -> float | None:
    """As `peak_memory_mb` where there is no /proc; None where there is no `getrusage` either."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)
