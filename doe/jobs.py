"""Many tasks, and tables of their rows that outlive a crash; on processes of this machine or on a dask cluster.

A task is a key (what to do, in JSON types) of a function that workers import by name: what cannot be pickled (CasADi,
IPOPT) is built there. Its rows depend on key and seed, never on workers or order.

A table is one Parquet file. While work goes on, finished rows are appended to a journal beside it (one line of JSON per
key, floats to the last bit); closing the table turns both into the Parquet file. After a kill the journal remains, and
`resume` reads it; a line cut short by the crash is passed over, and its key is done again.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import json
import logging
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import polars as pl

from doe import SINGLE_THREAD
from identification import InputError, JobError, Progress
from identification.files.io import check_writable, write_together

Key = Mapping[str, Any]  # JSON types only; says everything that the rows depend on
Row = dict[str, Any]
Function = Callable[..., list[Row]]  # (key, seed sequence), and the key's payload where there is one
Workers = int | str  # processes of this machine, 1: this one, one task at a time; or the address of a dask scheduler
KEY = "key"  # column with the key's canonical text
SEED = "seed"  # column; a key with an entry of this name brings its own
LOST = "the workers were lost; finished rows are kept, go on with --resume"
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
    return hashlib.sha256(_text(data).encode()).hexdigest()[:12]


def _text(data: Any) -> str:
    if is_dataclass(data):
        return type(data).__name__ + _text([getattr(data, each.name) for each in fields(data)])
    if isinstance(data, Mapping):
        return f"{{{', '.join(sorted(map(_text, data.items())))}}}"
    if isinstance(data, np.ndarray | np.generic):
        return _text(data.tolist())
    if isinstance(data, Set):
        return f"{{{', '.join(sorted(map(_text, data)))}}}"
    return f"[{', '.join(map(_text, data))}]" if isinstance(data, list | tuple) else repr(data)


def seed_of(key: Key, seed: int = 0) -> np.random.SeedSequence:
    """The seed of a key's own stream of random numbers: from the key's text and the user's seed, nothing else."""
    digest = hashlib.sha256(canonical(key).encode()).digest()
    return np.random.SeedSequence([seed, *np.frombuffer(digest, dtype="<u4").tolist()])


# -- tables ------------------------------------------------------------------------------------------------------------
def frame_of(rows: Sequence[Row]) -> pl.DataFrame:
    """Rows as a polars frame with the union of their columns; what a row does not have is null."""
    return pl.DataFrame(rows, infer_schema_length=None, strict=False) if rows else pl.DataFrame()


def parquet(frame: pl.DataFrame) -> bytes:
    """The content of the frame's Parquet file."""
    buffer = io.BytesIO()
    frame.write_parquet(buffer)
    return buffer.getvalue()


def with_columns(frame: pl.DataFrame, types: Mapping[str, Any]) -> pl.DataFrame:
    """The frame with columns of these names and types; one that no row has is there, empty."""
    empty = [pl.lit(None).alias(name) for name in types if name not in frame.columns]
    return frame.with_columns(empty).cast(types)  # type: ignore[arg-type]


class RowTable:
    """Rows by the text of their key, in memory and in the journal.

    path : the Parquet file, in a folder that is made; written on the way out of `with`, also after Ctrl-C or an error,
        if a row is of a finished task; None: in memory only
    resume : continue a table that exists;  force : replace it, at once: what is resumed later is of one run

    Raises `InputError` if the table exists and neither is given, or another process is writing it.
    """

    def __init__(self, path: Path | str | None = None, *, resume: bool = False, force: bool = False) -> None:
        self.rows: dict[str, list[Row]] = {}
        self.path = None if path is None else Path(path).absolute()
        if self.path is None:
            return
        self._made = not os.path.exists(self.path.parent)
        try:
            self.path.parent.mkdir(exist_ok=True)
        except OSError as error:
            reason = f"cannot be made ({error.strerror})"
            raise InputError(f"{self.path.parent}: {reason}, allowed: a folder in an existing one") from None
        check_writable(self.path, force=True)
        self.journal = self.path.with_name(self.path.name + ".journal")  # finished rows, while work goes on
        for file in (self.path, self.journal):
            if file.exists() and not (resume or force):
                allowed = "a new name, --resume to go on, or --force to replace it"
                raise InputError(f"{file}: exists, allowed: {allowed}")
        if resume and self.path.exists():
            try:
                self.rows = pl.read_parquet(self.path).rows_by_key(KEY, named=True, include_key=True)
            except (pl.exceptions.PolarsError, OSError) as error:
                reason = f"not a Parquet file with a column {KEY!r} ({str(error).splitlines()[0]})"
                raise InputError(f"{self.path}: {reason}, allowed: a table written by armcal") from None
        try:
            self._open = self.journal.open("ab", buffering=0)
            fcntl.flock(self._open, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._open.close()
            raise InputError(f"{self.journal}: another run is writing this table, allowed: one at a time") from None
        except OSError as error:
            reason = f"cannot be written ({error.strerror})"
            raise InputError(f"{self.journal}: {reason}, allowed: a writable place") from None
        if resume:
            for line in self.journal.read_bytes().splitlines():
                with suppress(ValueError):  # cut short by a crash
                    text, rows = json.loads(line)
                    self.rows[text] = [{KEY: text, **row} for row in rows]
            self._open.write(b"\n")
        else:
            self.path.unlink(missing_ok=True)
            self._open.truncate(0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.path is None:
            return
        with self._open:
            if any(row.get("status") != "failed" for rows in self.rows.values() for row in rows):
                every = frame_of([row for rows in self.rows.values() for row in rows])
                write_together({self.path: parquet(every)}, force=True)
            self.journal.unlink(missing_ok=True)
        if self._made:
            with suppress(OSError):  # there are files in it
                self.path.parent.rmdir()

    def add(self, text: str, rows: Sequence[Row]) -> None:
        """The rows of the key with this text, in the journal before this returns. Raises `JobError` if that cannot be
        written."""
        self.rows[text] = [{KEY: text, **row} for row in rows]
        if self.path is None:
            return
        line = json.dumps([text, list(rows)]).encode() + b"\n"
        try:
            while line:
                line = line[self._open.write(line) :]
        except OSError as error:
            reason = f"cannot be written ({error.strerror}); finished rows are kept, go on with --resume"
            raise JobError(f"{self.journal}: {reason}") from None


# -- tasks -------------------------------------------------------------------------------------------------------------
class _Serial(Executor):
    """Runs each task in this process when it is submitted; one that raises is a row."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*arguments, **named))
        return future


def run_tasks(
    function: Function,
    keys: Sequence[Key],
    table: RowTable,
    workers: Workers = 1,
    *,
    seed: int = 0,
    payload: Callable[[Key], Any] | None = None,
    progress: Progress = Progress(),
) -> pl.DataFrame:
    """The rows of all keys, in the order of the keys; those that the table has already are not done again.

    function : importable by name where the workers are; `function(key, seed_sequence)` gives the rows of one key
    payload : what a task needs besides its key, sent along as a third argument; it must follow from the key
    A task that raises, or whose worker dies when it runs alone, becomes a row with `status` "failed" and `error`; every
    row has its key's entries, `status` and `seconds`. Rows are in the table as soon as they are finished: Ctrl-C or a
    crash loses only what was being computed.
    Raises `JobError` if the workers are lost, `InputError` if the table's rows are those of another seed.
    """
    asked = {canonical(key): key for key in keys}
    for made in (row.get(SEED, seed) for text in asked for row in table.rows.get(text, ())):
        if made != seed:
            allowed = f"--seed {made} to go on, or --force to replace them"
            raise InputError(f"{table.path}: its rows are of --seed {made}, found {seed}, allowed: {allowed}")
    waiting, running = deque(text for text in asked if text not in table.rows), dict[Future[Any], str]()
    done, failed = len(asked) - len(waiting), 0

    def task(text: str) -> tuple[Any, ...]:
        """The arguments of `perform`."""
        key = asked[text]
        return function, dict(key), seed, *(() if payload is None else (payload(key),))

    def store(text: str, rows: list[Row] | None, error: BaseException | None) -> None:
        nonlocal done, failed
        table.add(text, rows or [_failure(asked[text], seed, error)])
        done, failed = done + 1, failed + (rows is None or rows[0]["status"] != "done")
        progress(done, len(asked), f"{failed} failed" if failed else "")

    progress(done, len(asked), "")
    try:
        while waiting:
            try:
                with executor_of(workers) as (executor, count):
                    while waiting or running:
                        # three tasks per worker, so that none waits; a million tasks are never in flight at once
                        while waiting and len(running) < (count * 3 if count > 1 else 1):
                            future = executor.submit(perform, *task(waiting[0]))
                            running[future] = waiting.popleft()
                        for future in wait(running, 0.2, FIRST_COMPLETED).done:
                            if future.cancelled():
                                raise JobError(LOST)
                            if isinstance(error := future.exception(), BrokenExecutor):
                                raise error
                            text = running.pop(future)  # the executor's own error: rows that cannot travel
                            store(text, None if error else future.result(), error)
                        # a dask client loses its scheduler once and for all, and some futures never end: what fails
                        # while a result is fetched is logged and dropped
                        if (client := getattr(executor, "_client", None)) and client.status != "running":
                            raise JobError(LOST)
            except BrokenExecutor:
                if not running:
                    raise JobError(LOST) from None
                for text in running.values():  # one of these killed its worker, and took the others with it
                    rows, alone = call(perform, *task(text), seconds=None)
                    died = f"the worker process died when it ran this task alone ({alone['error']})"
                    store(text, rows, JobError(died))
                running.clear()
    finally:  # in the order of the keys, whichever finished first
        table.rows = {text: table.rows[text] for text in (asked | table.rows) if text in table.rows}
    return frame_of([row for text in asked for row in table.rows[text]])


def perform(function: Function, key: dict[str, Any], seed: int, *payload: Any) -> list[Row]:
    """Run a task on a worker: the rows of its key, or one row that says how it failed."""
    started = time.perf_counter()
    try:
        rows = function(key, seed_of(key, seed), *payload)
    except Exception as error:  # noqa: BLE001 - failures are rows; the study goes on
        return [_failure(key, seed, error, time.perf_counter() - started)]
    seconds = time.perf_counter() - started
    return [{SEED: seed, **key, "status": "done", "error": None, "seconds": seconds, **row} for row in rows or [{}]]


def _failure(key: Key, seed: int, error: BaseException | None, seconds: float = 0.0) -> Row:
    return {SEED: seed, **key, "status": "failed", "error": one_line(error), "seconds": seconds}


def one_line(error: BaseException | None) -> str:
    """`TypeName: message`, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


# -- workers -----------------------------------------------------------------------------------------------------------
@contextmanager
def executor_of(workers: Workers) -> Iterator[tuple[Executor, int]]:
    """What runs tasks, and how many at once. Raises `InputError` if no cluster answers."""
    if isinstance(workers, str):
        with cluster(workers) as connected:
            yield connected
    elif workers > 1:
        with _pool(workers) as pool:
            yield pool, workers
    else:
        yield _Serial(), 1


@contextmanager
def _pool(number: int) -> Iterator[Executor]:
    """Processes of our own, by loky (joblib): it starts an ordinary Python, so it works from anywhere (a notebook, a
    dask worker), and what hangs or crashes there stops nothing here. Killed at the end: after Ctrl-C nobody waits."""
    from joblib.externals.loky import ProcessPoolExecutor

    # of loky's tracker, which would print what a killed process leaves behind and it removes
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker")
    # a dask worker is a daemon, which may have no children since they would outlive it: ours do not
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is for the one that asked
    try:
        environment = {**SINGLE_THREAD, **QUIET}
        pool = ProcessPoolExecutor(number, env=environment, initializer=_end_with, initargs=(os.getpid(),))
        pool.submit(int)  # starts them
    except OSError as error:  # no semaphores: a /dev/shm that is read-only
        raise JobError(f"no processes can share work here ({error.strerror}), allowed: --workers 1") from None
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield pool
    finally:
        pool.shutdown(kill_workers=True)


def _end_with(parent: int) -> None:
    """Ends this process when the one that asked is gone: killed, it could not say so."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def cluster(address: str, patience: float = 10.0) -> Iterator[tuple[Executor, int]]:
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
def call(function: Callable[..., Any], *arguments: Any, seconds: float | None) -> tuple[Any, Row]:
    """`function(*arguments)` in a new process, killed `seconds` [s] after it was called: what it returned, and a row.

    function : importable by name there;  arguments : picklable

    `status` : "done", "failed" (it raised), "timeout" (killed) or "crashed" (the process died), where the value is None
    `error` : one line on what went wrong;  `seconds` : of the call itself, without starting the process
    """

    def silenced() -> Any:  # in the new process: solvers print banners
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        return function(*arguments)

    value, status, error = None, "done", None
    with _pool(1) as process:
        began = time.monotonic()
        try:
            # a minute to start and import, which is not part of the limit on the call itself
            process.submit(id, function).result(60.0)  # its module is imported by now
            began = time.monotonic()
            value = process.submit(silenced).result(seconds)
        except TimeoutError:
            status, error = "timeout", f"killed after {seconds or 60.0:g} s"
        except BrokenExecutor as lost:  # loky says how in its message
            code = re.search(r"\((-?)(\d+)\)\}", str(lost)) or ("", "", "1")
            status, error = "crashed", f"{'signal' if code[1] else 'exit code'} {code[2]}"
        except Exception as raised:  # noqa: BLE001 - every failure becomes a row
            status, error = "failed", one_line(raised)
        return value, {"status": status, "error": error, "seconds": time.monotonic() - began}
