"""Where tasks run: in this process, on processes of this machine, or on a dask cluster."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from doe.jobs.isolated import OneProcess, one_line
from identification.errors import InputError, JobError

LOUD = ("distributed", "tornado", "asyncio")  # loggers of dask
TRIES = 3  # a task whose worker dies so often is at fault


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
            for _ in range(TRIES):
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
