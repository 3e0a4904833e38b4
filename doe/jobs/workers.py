"""Where tasks run: in this process, on processes of this machine, or on a dask cluster."""

from __future__ import annotations

import logging
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, InvalidStateError, ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from doe.jobs.isolated import SINGLE_THREAD, one_line
from identification.errors import InputError, JobError

LOUD = ("distributed", "tornado", "asyncio")  # loggers of dask
WATCH = 0.2  # [s] between two looks at whether a cluster's scheduler is still there


@dataclass(frozen=True)
class Workers:
    """Where tasks run.

    open : gives an executor with `submit` and futures like those of `concurrent.futures`; called again if it broke.
        For an existing executor, which stays open: `Workers(lambda: nullcontext(executor), 8)`
    count : number of tasks that run at once;  reopens : whether a broken executor can be opened anew
    """

    open: Callable[[], AbstractContextManager[Executor]]
    count: int = 1
    reopens: bool = False


class _Serial(Executor):
    """An executor that runs each task in this process when it is submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:  # noqa: BLE001 - as every executor: the future has it
            future.set_exception(error)
        return future


def serial() -> Workers:
    """This process, one task at a time."""
    return Workers(_Serial)


def processes(number: int | None = None) -> Workers:
    """`number` processes of this machine (default: its cores), each with one thread of linear algebra."""
    number = number or os.cpu_count() or 1
    return Workers(lambda: _process_pool(number), number, reopens=True)


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
    return Workers(lambda: _cluster_executor(address, patience), max(threads, 1))


def chosen_workers(workers: int | None = None, address: str | None = None) -> Workers:
    """What the options --workers and --cluster ask for; both left out: all cores."""
    if address is not None:
        return cluster(address)
    number = workers or os.cpu_count() or 1
    return serial() if number == 1 else processes(number)


@contextmanager
def _process_pool(number: int) -> Iterator[Executor]:
    settings = {**SINGLE_THREAD, "PYTHONSAFEPATH": "1"}  # no module of the working directory comes first
    before = {name: os.environ.get(name) for name in settings}
    os.environ.update(settings)  # read when the workers start
    try:
        pool = _Pool(number, multiprocessing.get_context("spawn"), initializer=_end_with_the_parent)
    except OSError as error:  # no semaphores: a /dev/shm that is read-only
        raise JobError(f"no processes can share work here ({error.strerror}), allowed: --workers 1") from None
    others = multiprocessing.active_children()
    try:
        yield pool
    except BaseException:  # Ctrl-C, a full disk: nobody waits for what is not finished
        for process in multiprocessing.active_children():
            if process not in others:
                process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class _Pool(ProcessPoolExecutor):
    """A pool whose processes start with SIGINT blocked: one that arrived during start-up would show a traceback."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        with _ctrl_c_waits():
            return super().submit(function, *arguments, **named)


@contextmanager
def _ctrl_c_waits() -> Iterator[None]:
    """Block SIGINT in this block; processes started meanwhile inherit that until they unblock it."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_the_parent() -> None:
    """In a new worker: Ctrl-C ends it at once, and so does the death of the process that started it (kill -9 too)."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    sentinel = parent.sentinel

    def watch() -> None:
        multiprocessing.connection.wait([sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _cluster_executor(address: str, patience: float) -> Iterator[Executor]:
    """Raises `JobError` if the scheduler does not answer any more."""
    with ExitStack() as stack:
        try:
            client = stack.enter_context(_client(address, patience))
        except OSError as error:
            raise JobError(f"--cluster {address}: the scheduler is gone ({one_line(error)})") from None
        yield stack.enter_context(_ClusterExecutor(client))


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


class _ClusterExecutor(Executor):
    """Tasks on a dask cluster, whose futures end when the scheduler is lost: of dask's own some never do, since what
    fails while a result is fetched is logged and dropped."""

    def __init__(self, client: Any) -> None:
        self._client, self._inner = client, client.get_executor(pure=False)
        self._pending: set[Future[Any]] = set()
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        """Raises `BrokenExecutor` if the scheduler is lost."""
        future: Future[Any] = Future()
        self._pending.add(future)
        future.add_done_callback(self._pending.discard)
        try:
            if self.lost:
                raise BrokenExecutor
            inner = self._inner.submit(function, *arguments, **named)
        except Exception as error:
            self._pending.discard(future)
            if self.lost:
                raise BrokenExecutor("the scheduler is lost") from None
            raise error
        inner.add_done_callback(lambda done: _pass_on(done, future))
        future.add_done_callback(lambda done: inner.cancel() if done.cancelled() and not self.lost else None)
        return future

    @property
    def lost(self) -> bool:
        """Whether the client has lost its scheduler, and with it every task: it does so once and for all."""
        return bool(self._client.status != "running")

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As every executor; without waiting for a lost scheduler."""
        self._ended.set()
        if not self.lost:
            self._inner.shutdown(wait)

    def _watch(self) -> None:
        while not self._ended.wait(WATCH):
            for future in list(self._pending) if self.lost else ():
                if future.cancel():
                    future.set_running_or_notify_cancel()


def _pass_on(done: Future[Any], future: Future[Any]) -> None:
    """The outcome of one future to another that may have been cancelled meanwhile."""
    with suppress(InvalidStateError):
        if done.cancelled():
            if future.cancel():
                future.set_running_or_notify_cancel()
        elif (error := done.exception()) is not None:
            future.set_exception(error)
        else:
            future.set_result(done.result())
