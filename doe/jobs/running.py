"""Reproducible task lists: the rows depend on key and seed, never on workers or order.

A task is a key (what to do, in JSON types). Functions are sent to workers by name and called with keys: what cannot be
pickled (CasADi, IPOPT) is built there.

Where tasks run: in this process, on processes of this machine, or on a dask cluster.

Processes of our own, by loky (joblib): what hangs or crashes in one stops nothing else.

loky starts an ordinary Python, so it works from anywhere (a notebook, a pool, a dask worker); the process inherits no
locks or threads, and builds its own CasADi functions.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.jobs.rows import Key, Row, RowTable, canonical, made
from identification import SINGLE_THREAD, InputError, JobError, Progress, silent

if TYPE_CHECKING:
    import polars


# -- tasks -------------------------------------------------------------------------------------------------------------
Function = Callable[..., list[Row]]  # (key, seed sequence), and the key's payload where there is one
SEED = "seed"  # column; a key with an entry of this name brings its own


def seed_of(key: Key, seed: int = 0) -> np.random.SeedSequence:
    """The seed of a key's own stream of random numbers: from the key's text and the user's seed, nothing else."""
    digest = hashlib.sha256(canonical(key).encode()).digest()
    return np.random.SeedSequence([seed, *np.frombuffer(digest, dtype="<u4").tolist()])


def run_tasks(
    function: Function,
    keys: Sequence[Key],
    table: RowTable,
    workers: Workers | None = None,
    *,
    seed: int = 0,
    payload: Callable[[Key], Any] | None = None,
    progress: Progress = silent,
) -> polars.DataFrame:
    """The rows of all keys, in the order of the keys; those that the table has already are not done again.

    function : importable by name where the workers are; `function(key, seed_sequence)` gives the rows of one key
    payload : what a task needs besides its key, sent along as a third argument; it must follow from the key
    A task that raises, or whose worker dies each time, becomes a row with `status` "failed" and `error`; every row has
    its key's entries, `status` and `seconds`. Rows are in the table as soon as they are finished: Ctrl-C or a crash
    loses only what was being computed.
    Raises `JobError` if the workers are lost, `InputError` if the table's rows are those of another seed.
    """
    for key in keys:
        for row in table.rows.get(canonical(key), ()):
            if (made := row.get(SEED)) not in (None, key.get(SEED, seed)):
                allowed = f"--seed {made} to go on, or --force to replace them"
                raise InputError(f"{table.path}: its rows are of --seed {made}, found {seed}, allowed: {allowed}")
    queue = deque({canonical(key): key for key in keys if key not in table}.values())
    workers, done, failed = workers or serial(), len(keys) - len(queue), 0
    # three tasks per worker, so that none waits; a million tasks are never in flight at once
    ahead = workers.count * 3 if workers.count > 1 else 1
    running: dict[Future[Any], Key] = {}

    def store(future: Future[Any], key: Key) -> None:
        nonlocal done, failed
        error = future.exception()  # the executor's own: a worker killed several times over, rows that cannot travel
        rows = future.result() if error is None else [_failure(key, seed, error, 0.0)]
        table.add(key, rows)
        done, failed = done + 1, failed + (rows[0]["status"] != "done")
        progress(done, len(keys), f"{failed} failed" if failed else "")

    progress(done, len(keys), "")
    try:
        with workers.open() as executor:
            try:
                while queue or running:
                    while queue and len(running) < ahead:
                        key = queue.popleft()
                        sent = () if payload is None else (payload(key),)
                        running[executor.submit(perform, function, dict(key), seed, *sent)] = key
                    for future in wait(running, 0.2, FIRST_COMPLETED).done:  # then look after a cluster
                        if _lost(future):
                            raise BrokenExecutor
                        store(future, running.pop(future))
                    if isinstance(executor, Cluster) and executor.lost:
                        raise BrokenExecutor
            finally:  # after Ctrl-C: what is finished is kept
                for future, key in running.items():
                    if not future.cancel() and future.done() and not _lost(future):
                        store(future, key)
    except BrokenExecutor:
        raise JobError("the workers were lost; finished rows are kept, go on with --resume") from None
    finally:
        table.arrange(keys)
    return table.frame(keys)


def _lost(future: Future[Any]) -> bool:
    """Whether a task that has ended went down with its executor."""
    return future.cancelled() or isinstance(future.exception(), BrokenExecutor)


def perform(function: Function, key: dict[str, Any], seed: int, *payload: Any) -> list[Row]:
    """Run a task on a worker: the rows of its key, or one row that says how it failed."""
    started = time.perf_counter()
    try:
        rows = function(key, seed_of(key, seed), *payload)
    except Exception as error:  # noqa: BLE001 - failures are rows; the study goes on
        return [_failure(key, seed, error, time.perf_counter() - started)]
    seconds = time.perf_counter() - started
    return [{SEED: seed, **key, "status": "done", "error": None, "seconds": seconds, **row} for row in rows or [{}]]


def _failure(key: Key, seed: int, error: BaseException, seconds: float) -> Row:
    return {SEED: seed, **key, "status": "failed", "error": one_line(error), "seconds": seconds}


@dataclass(frozen=True)
class Job:
    """Several tables of rows that belong together, and how they are filled: arguments of `run_tasks`."""

    tables: Mapping[str, RowTable]
    options: Mapping[str, Any]

    @classmethod
    @contextmanager
    def open(
        cls,
        folder: Path | str | None,
        names: Sequence[str],
        workers: Workers | None = None,
        *,
        seed: int = 0,
        resume: bool = False,
        force: bool = False,
        progress: Progress = silent,
    ) -> Iterator[Job]:
        """The tables NAME in a folder, which is made (None: in memory), all of them closed to other runs."""
        paths = {name: None if folder is None else made(folder) / name for name in names}
        with ExitStack() as stack:
            tables = {
                name: stack.enter_context(RowTable.open(path, resume=resume, force=force))
                for name, path in paths.items()
            }
            yield cls(tables, {"workers": workers, "seed": seed, "progress": progress})

    def run(
        self, function: Function, keys: Sequence[Key], name: str, payload: Callable[[Key], Any] | None = None
    ) -> polars.DataFrame:
        """The rows of all keys, as `run_tasks` gives them, kept in the table of this name."""
        return run_tasks(function, keys, self.tables[name], payload=payload, **self.options)


# -- workers -----------------------------------------------------------------------------------------------------------
LOUD = ("distributed", "tornado", "asyncio")  # loggers of dask


@dataclass(frozen=True)
class Workers:
    """Where tasks run.

    open : gives an executor with `submit` and futures like those of `concurrent.futures`.
        For an existing executor, which stays open: `Workers(lambda: nullcontext(executor), 8)`
    count : number of tasks that run at once
    """

    open: Callable[[], AbstractContextManager[Executor]]
    count: int = 1


def serial() -> Workers:
    """This process, one task at a time."""
    return Workers(_Serial)


def processes(number: int | None = None) -> Workers:
    """`number` processes of this machine (default: its cores), each with one thread of linear algebra."""
    number = number or os.cpu_count() or 1
    return Workers(lambda: _Processes(number), number)


def cluster(address: str, patience: float = 10.0) -> Workers:
    """An existing dask cluster, `tcp://host:port` of its scheduler; its workers need this package installed.

    patience : time to wait for an answer, and for a first worker [s]

    Raises `InputError` if dask is not installed, nothing answers there, or no worker is connected.
    """
    try:
        from distributed.comm import get_address_host_port
    except ImportError:
        raise InputError("--cluster: dask is not installed, allowed: pip install 'armcal[cluster]'") from None
    try:
        get_address_host_port(address, strict=True)  # a client of a bad address hangs when it is closed
    except (ValueError, TypeError, NotImplementedError):
        raise InputError(f"--cluster: found {address!r}, allowed: an address as tcp://host:8786") from None
    try:
        with _client(address, patience) as client:
            try:
                client.wait_for_workers(1, timeout=patience)
            except TimeoutError:
                how = f"some, started with `dask worker {address}`"
                raise InputError(f"--cluster {address}: the scheduler has no workers, allowed: {how}") from None
            threads = sum(client.nthreads().values())
    except OSError as error:
        raise InputError(
            f"--cluster {address}: no scheduler answers ({one_line(error)}), allowed: one that runs"
        ) from None
    return Workers(lambda: _cluster(address, patience), max(threads, 1))


def chosen_workers(workers: int | None = None, address: str | None = None) -> Workers:
    """What the options --workers and --cluster ask for; both left out: all cores."""
    if address is not None:
        return cluster(address)
    number = workers or os.cpu_count() or 1
    return serial() if number == 1 else processes(number)


class _Serial(Executor):
    """Runs each task in this process when it is submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:  # noqa: BLE001 - as every executor: the future has it
            future.set_exception(error)
        return future


class _Processes(Executor):
    """Every process has one task at a time: if it dies, no other is lost, and it is done again in a new process."""

    def __init__(self, number: int) -> None:
        try:
            self._processes = [OneProcess() for _ in range(number)]
        except OSError as error:  # no semaphores: a /dev/shm that is read-only
            raise JobError(f"no processes can share work here ({error.strerror}), allowed: --workers 1") from None
        self._threads, self._stopped = ThreadPoolExecutor(number), False
        self._idle: SimpleQueue[int] = SimpleQueue()
        for place in range(number):
            self._idle.put(place)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **_: Any) -> Future[Any]:
        return self._threads.submit(self._run, function, arguments)

    def _run(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        place = self._idle.get()
        try:
            for _ in range(3):  # a task whose worker dies so often is at fault
                try:
                    return self._processes[place].submit(function, *arguments).result()
                except BrokenExecutor:
                    if self._stopped:
                        raise
                    self._processes[place].kill()
                    self._processes[place] = OneProcess()
            raise RuntimeError("the worker process died each time it ran this task")
        finally:
            self._idle.put(place)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """At once: after Ctrl-C or a full disk nobody waits for what is not finished."""
        self._stopped = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in self._processes:
            process.kill()


class Cluster(Executor):
    """Tasks on a dask cluster. When the scheduler is lost some futures never end: what fails while a result is fetched
    is logged and dropped."""

    def __init__(self, client: Any) -> None:
        self._client, self._inner = client, client.get_executor(pure=False)

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Raises `BrokenExecutor` if the scheduler is lost."""
        try:
            return self._inner.submit(function, *arguments, **named)
        except Exception:
            if self.lost:
                raise BrokenExecutor from None
            raise

    @property
    def lost(self) -> bool:
        """Whether the client has lost its scheduler, and with it every task: it does so once and for all."""
        return bool(self._client.status != "running")

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As every executor; without waiting for a lost scheduler."""
        if not self.lost:
            self._inner.shutdown(wait)


@contextmanager
def _cluster(address: str, patience: float) -> Iterator[Executor]:
    """Raises `JobError` if the scheduler does not answer any more."""
    try:
        with _client(address, patience) as client, Cluster(client) as executor:
            yield executor
    except OSError as error:
        raise JobError(f"--cluster {address}: the scheduler is gone ({one_line(error)})") from None


@contextmanager
def _client(address: str, patience: float) -> Iterator[Any]:
    """A client of dask, of which nothing is printed: a lost scheduler is one line of ours.

    patience : time to wait for an answer [s]. Raises `OSError` if none comes.
    """
    from distributed import Client

    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in LOUD]
    loggers = [logging.getLogger(name) for name in names]  # some have handlers of their own
    before = [(logger, logger.handlers, logger.propagate) for logger in loggers]
    for logger in loggers:
        logger.handlers, logger.propagate = [logging.NullHandler()], False
    try:
        client = Client(address, timeout=patience, set_as_default=False)
        try:
            yield client
        finally:
            client.close(timeout=patience)
    finally:
        for logger, handlers, propagate in before:
            logger.handlers, logger.propagate = handlers, propagate


# -- processes of our own ----------------------------------------------------------------------------------------------
QUIET = {
    "PYTHONSAFEPATH": "1",
    "PYTHONFAULTHANDLER": "",
}  # nothing is imported from the folder it starts in, no traceback


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
        # a minute to start and import, which is not part of the limit on the call itself
        process.submit(id, function).result(60.0)  # its module is imported by now
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
