"""Many tasks, and the table of their rows; on processes of this machine or on a dask cluster.

A task is a key (what to do, in JSON types) of a function that workers import by name: what cannot be pickled (CasADi,
IPOPT) is built there. Its rows depend on key and seed, never on workers or order.

The table is one Parquet file, written whole every few seconds while work goes on and when it ends: a kill loses the
tasks of these seconds, and `resume` does what the table does not have.
"""

import hashlib
import io
import json
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from doe import SINGLE_THREAD
from identification import InputError, JobError, Progress, require
from identification.document import Sheet
from identification.files.io import check_writable, write_together

Key = Mapping[str, Any]  # JSON types only; says everything that the rows depend on
Row = dict[str, Any]
Workers = int | str  # processes of this machine, 1: this one, one task at a time; or the address of a dask scheduler
KEY = "key"  # column with the key's canonical text
SEED = "seed"  # column; a key with an entry of this name brings its own
EVERY = 5.0  # [s] between two writings of a table
LOST = "a worker was lost, killed or out of memory; finished rows are kept, go on with --resume"
# of a new process: nothing is imported from the folder it starts in, no traceback
QUIET = {"PYTHONSAFEPATH": "1", "PYTHONFAULTHANDLER": ""}


def canonical(key: Key) -> str:
    """The key as text, independent of the order of its entries.

    >>> canonical({"runs": 4, "arm": "a"})
    '{"arm":"a","runs":4}'
    """
    return json.dumps(key, sort_keys=True, separators=(",", ":"), allow_nan=False)


def short_hash(*data: Any) -> str:
    """Twelve hexadecimal digits that identify long inputs in the keys of tasks, of plain data and dataclasses, the same
    in every process."""

    def text(value: Any) -> str:
        if is_dataclass(value):
            return type(value).__name__ + text([getattr(value, each.name) for each in fields(value)])
        if isinstance(value, Mapping | Set):
            return f"{{{', '.join(sorted(map(text, value.items() if isinstance(value, Mapping) else value)))}}}"
        if isinstance(value, np.ndarray | np.generic):
            return text(value.tolist())
        return f"[{', '.join(map(text, value))}]" if isinstance(value, list | tuple) else repr(value)

    return hashlib.sha256(text(data).encode()).hexdigest()[:12]


def seed_of(key: Key, seed: int = 0) -> np.random.SeedSequence:
    """The seed of a key's own stream of random numbers: from the key's text and the user's seed, nothing else."""
    digest = hashlib.sha256(canonical(key).encode()).digest()
    return np.random.SeedSequence([seed, *np.frombuffer(digest, dtype="<u4").tolist()])


# -- tables ------------------------------------------------------------------------------------------------------------
def frame_of(rows: Sequence[Row]) -> pl.DataFrame:
    """Rows as a polars frame with the union of their columns; what a row does not have is null."""
    return pl.DataFrame(rows, infer_schema_length=None, strict=False) if rows else pl.DataFrame()


def rows_of_table(path: Path) -> dict[str, list[Row]]:
    """Rows of a table by the text of their key. Raises `InputError` for what is none."""
    try:
        return pl.read_parquet(path).rows_by_key(KEY, named=True, include_key=True)
    except (pl.exceptions.PolarsError, OSError) as unreadable:
        reason = f"not a Parquet file with a column {KEY!r} ({str(unreadable).splitlines()[0]})"
        raise InputError(f"{path}: {reason}, allowed: a table written by armcal") from None


def parquet(frame: pl.DataFrame) -> bytes:
    """The content of the frame's Parquet file."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer)
    return buffer.getvalue()


Columns = Mapping[str, tuple[str, str]]  # heading -> name in a row, and format of its numbers


def sheet(rows: Iterable[dict[str, Any]], columns: Columns, title: str) -> Sheet:
    """Rows as a table, a dash for none."""
    return Sheet([*columns], [[cell_text(row[name], kind) for name, kind in columns.values()] for row in rows], title)


def cell_text(value: Any, kind: str = ".4g") -> str:
    """A cell: a number in this format, a dash for none, text as it is."""
    return "-" if value is None else format(value, kind) if isinstance(value, float) else str(value)


# -- tasks -------------------------------------------------------------------------------------------------------------
class _Serial(Executor):
    """Runs each task in this process when it is submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **named))
        return future


def run_tasks(
    function: Callable[..., list[Row]],
    keys: Sequence[Key],
    path: Path | None = None,
    workers: Workers = 1,
    *,
    seed: int = 0,
    resume: bool = False,
    force: bool = False,
    payload: Callable[[Key], Any] | None = None,
    progress: Progress = Progress(),
) -> pl.DataFrame:
    """The rows of all keys, in the order of the keys; those that the table has already are not done again.

    function : importable by name where the workers are; `function(key, seed_sequence)` gives the rows of one key
    path : of the table, in a folder that is made; written if a row is of a finished task. None: no table
    resume : go on with a table that exists;  force : replace it, at once
    payload : what a task needs besides its key, sent along as a third argument; it must follow from the key

    A task that raises becomes a row with `status` "failed" and `error`; every row has its key's entries, `status` and
    `seconds`. After Ctrl-C or an error the table has all that is finished. Raises `JobError` if a worker dies or all
    are lost, `InputError` for a table that exists and is neither to be resumed nor replaced, that cannot be read or
    written, or that has rows of another seed.
    """
    rows: dict[str, list[Row]] = {}  # by the text of their key
    if path is not None:
        check_writable(path if os.path.isdir(path.parent) else path.parent, force=True)
    if path is not None and path.exists():
        require(resume or force, f"{path}: exists, allowed: a new name, --resume to go on, or --force to replace it")
        if resume:
            rows = rows_of_table(path)
        else:
            path.unlink()  # so that what is resumed later is of one run
    asked = {canonical(key): key for key in keys}
    for made in (row.get(SEED, seed) for text in asked for row in rows.get(text, ())):
        allowed = f"--seed {made} to go on, or --force to replace them"
        require(made == seed, f"{path}: its rows are of --seed {made}, found {seed}, allowed: {allowed}")
    waiting, running = deque(text for text in asked if text not in rows), dict[Future[Any], str]()
    done, failed, due = len(asked) - len(waiting), 0, time.monotonic() + EVERY
    own = resume or force  # the table is this run's, not of another that began meanwhile

    def save() -> None:
        """In the order of the keys, whichever finished first; another run that goes on with it keeps its rows."""
        nonlocal own
        written = rows_of_table(path) | rows if path is not None and own and path.exists() else rows
        every = [row for text in (asked | written) for row in written.get(text, ())]
        if path is not None and any(row.get("status") != "failed" for row in every):
            path.parent.mkdir(exist_ok=True)
            write_together({path: parquet(frame_of(every))}, force=own)
            own = True

    def store(text: str, of_task: list[Row]) -> None:
        nonlocal done, failed, due
        rows[text] = [{KEY: text, **row} for row in of_task]
        done, failed = done + 1, failed + (of_task[0]["status"] != "done")
        if (now := time.monotonic()) > due:
            save()
            due = time.monotonic() + max(EVERY, 10.0 * (time.monotonic() - now))  # of a long table more rarely
        progress(done, len(asked), f"{failed} failed" if failed else "")

    progress(done, len(asked), "")
    try:
        with executor_of(workers) as (executor, count):
            while waiting or running:
                # three tasks per worker, so that none waits; a million tasks are never in flight at once
                while waiting and len(running) < (count * 3 if count > 1 else 1):
                    key = asked[text := waiting.popleft()]
                    sent = () if payload is None else (payload(key),)
                    running[executor.submit(perform, function, dict(key), seed, *sent)] = text
                for future in wait(running, 0.2, FIRST_COMPLETED).done:
                    if future.cancelled() or isinstance(error := future.exception(), BrokenExecutor):
                        raise JobError(LOST)
                    text = running.pop(future)
                    if error:  # the executor's own: rows that cannot travel
                        failure = {"status": "failed", "error": one_line(error), "seconds": 0.0}
                        store(text, [{SEED: seed, **asked[text], **failure}])
                    else:
                        store(text, future.result())
                # a dask client loses its scheduler once and for all, and some futures never end: what fails while a
                # result is fetched is logged and dropped
                if (client := getattr(executor, "_client", None)) and client.status != "running":
                    raise JobError(LOST)
    except BrokenExecutor:  # while a task was sent
        raise JobError(LOST) from None
    finally:
        save()
    return frame_of([row for text in asked for row in rows[text]])


def perform(function: Callable[..., list[Row]], key: dict[str, Any], seed: int, *payload: Any) -> list[Row]:
    """Run a task on a worker: the rows of its key, or one row that says how it failed."""
    started = time.perf_counter()
    try:
        rows = function(key, seed_of(key, seed), *payload)
    except Exception as error:  # noqa: BLE001 - failures are rows; the study goes on
        rows = [{"status": "failed", "error": one_line(error)}]
    told = {"status": "done", "error": None, "seconds": time.perf_counter() - started}
    return [{SEED: seed, **key, **told, **row} for row in rows or [{}]]


def one_line(error: BaseException | None) -> str:
    """`TypeName: message`, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


# -- workers -----------------------------------------------------------------------------------------------------------
def executor_of(workers: Workers) -> AbstractContextManager[tuple[Executor, int]]:
    """What runs tasks, and how many at once. Raises `InputError` if no cluster answers."""
    if isinstance(workers, str):
        return cluster(workers)
    return _pool(workers) if workers > 1 else nullcontext((_Serial(), 1))


@contextmanager
def _pool(number: int) -> Generator[tuple[Executor, int], None, None]:
    """Processes of our own, by loky (joblib): it starts an ordinary Python, so it works from anywhere (a notebook, a
    dask worker), and what hangs or crashes there stops nothing here. Killed at the end: after Ctrl-C nobody waits."""
    from joblib.externals.loky import ProcessPoolExecutor

    # of loky's tracker, which would print what a killed process leaves behind and it removes
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    parent = os.getpid()

    def end_with_parent() -> None:
        """Ends a process when the one that asked is gone: killed, it could not say so."""

        def watch() -> None:
            while os.getppid() == parent:
                time.sleep(0.2)
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()

    # a dask worker is a daemon, which may have no children since they would outlive it: ours do not
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for the one that asked
    try:
        pool = ProcessPoolExecutor(number, env={**SINGLE_THREAD, **QUIET}, initializer=end_with_parent)
        pool.submit(int)  # starts them
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool, number
    finally:
        pool.shutdown(kill_workers=True)


@contextmanager
def cluster(address: str, patience: float = 10.0) -> Generator[tuple[Executor, int], None, None]:
    """Executor and number of threads of a dask cluster, `tcp://host:port` of its scheduler; its workers need this
    package installed. dask prints nothing meanwhile: a lost scheduler is one line of ours.

    patience : time to wait for an answer, and for a first worker [s]

    Raises `InputError` if dask is not installed, nothing answers there, or no worker is connected.
    """
    try:
        from distributed import Client
        from distributed.comm import get_address_host_port
    except ImportError:
        raise InputError("--cluster: dask is not installed, allowed: pip install 'armcal[cluster]'") from None
    try:
        get_address_host_port(address, strict=True)  # a client of a bad address hangs when it is closed
    except (ValueError, TypeError, NotImplementedError):
        raise InputError(f"--cluster: found {address!r}, allowed: an address as tcp://host:8786") from None
    with ExitStack() as stack:
        stack.callback(logging.disable, logging.root.manager.disable)
        logging.disable()
        try:
            client = Client(address, timeout=patience, set_as_default=False)
            stack.callback(client.close, timeout=patience)
            client.wait_for_workers(1, timeout=patience)
            threads = sum(client.nthreads().values())
        except OSError as error:
            allowed = f"one that runs, with workers, started with `dask worker {address}`"
            reason = f"no scheduler with workers answers ({one_line(error)})"
            raise InputError(f"--cluster {address}: {reason}, allowed: {allowed}") from None
        try:
            yield client.get_executor(pure=False), max(threads, 1)
        except Exception:
            if client.status != "running":
                raise JobError(LOST) from None
            raise


# -- one call in a process of its own ----------------------------------------------------------------------------------
def call(function: Callable[..., Any], *arguments: Any, seconds: float) -> Any:
    """`function(*arguments)` in a new process, which is killed `seconds` [s] after the call: what it returned.

    function : importable by name there;  arguments : picklable

    Raises what it raises, and `JobError` where it was killed or its process died.
    """

    def silenced() -> Any:  # in the new process: solvers print banners
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        return function(*arguments)

    limit = 60.0  # to start and import, which is not part of the limit on the call itself
    with _pool(1) as (process, _):
        try:
            process.submit(id, function).result(limit)  # its module is imported by now
            limit = seconds
            return process.submit(silenced).result(limit)
        except TimeoutError:
            raise JobError(f"killed after {limit:g} s") from None
        except BrokenExecutor as lost:
            how = str(lost).partition("{")[2].partition("}")[0]  # as loky's message has it
            raise JobError(f"the process died of {how}") from None
