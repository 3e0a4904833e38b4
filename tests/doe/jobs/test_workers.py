"""Workers on processes and on a dask cluster: the same rows, and one line where there are none."""

from __future__ import annotations

import errno
import logging
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from doe.jobs.rows import RowTable, read_rows
from doe.jobs.running import Cluster, Workers, chosen_workers, cluster, run_tasks
from identification.errors import InputError, JobError

sys.path.insert(0, str(Path(__file__).parent))  # workers find the tasks by name
import work


def free_port() -> int:
    with socket.socket() as stream:
        stream.bind(("127.0.0.1", 0))
        return int(stream.getsockname()[1])


@contextmanager
def started(stack: ExitStack, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_cluster_with_a_killed_worker_gives_the_same_bits(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    keys = [{"task": task} for task in range(60)]
    address = f"tcp://127.0.0.1:{free_port()}"
    common = ("--no-dashboard",)
    with ExitStack() as stack:
        scheduler = ("dask_scheduler", "--host", address, *common)
        stack.enter_context(started(stack, *scheduler))
        worker = ("dask_worker", address, "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path), *common)
        for _ in range(2):
            stack.enter_context(started(stack, *worker))
        workers = ready(address, 2)
        victims: list[int] = []
        path = tmp_path / "rows.parquet"

        def kill_one(done: float, total: float | None, message: str) -> None:
            if done >= 20 and not victims:
                victims.append(read_rows(path)["process"][-1])
                os.kill(victims[0], signal.SIGKILL)

        with RowTable.open(path) as table:
            frame = run_tasks(work.slow_draw, keys, table, workers, progress=kill_one)
    assert len(victims) == 1
    assert len(set(frame["process"])) == 2
    assert victims[0] not in set(frame["process"][-20:])
    assert frame["value"].to_list() == work.drawn(keys)
    assert read_rows(path).equals(frame)  # the file is in the order of the keys, whoever finished first
    with RowTable.open(None) as table:
        assert frame.drop("seconds", "process").equals(run_tasks(work.draw, keys, table).drop("seconds"))


def test_a_killed_scheduler_is_one_line_and_keeps_what_is_finished(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    keys = [{"task": task} for task in range(60)]
    address = f"tcp://127.0.0.1:{free_port()}"
    worker = ("dask_worker", address, "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    path = tmp_path / "rows.parquet"
    printed: list[logging.LogRecord] = []
    with ExitStack() as stack:
        stack.enter_context(recorded(printed, "distributed", "distributed.client", "tornado.application", "asyncio"))
        scheduler = stack.enter_context(started(stack, "dask_scheduler", "--host", address, "--no-dashboard"))
        stack.enter_context(started(stack, *worker, "--no-dashboard"))
        workers = ready(address, 1)

        def kill(done: float, total: float | None, message: str) -> None:
            if done >= 5:
                scheduler.kill()

        with pytest.raises(JobError, match="--resume"), RowTable.open(path) as table:
            run_tasks(work.slow_draw, keys, table, workers, progress=kill)
    assert printed == []
    kept = read_rows(path)
    assert 5 <= len(kept) / 2 < 60
    assert kept["value"].to_list() == work.drawn(keys[: len(kept) // 2])
    with RowTable.open(path, resume=True) as table:
        assert run_tasks(work.draw, keys, table)["value"].to_list() == work.drawn(keys)


@contextmanager
def recorded(records: list[logging.LogRecord], *names: str) -> Iterator[None]:
    """Collects what these loggers print."""
    handler = logging.Handler(logging.WARNING)
    handler.emit = records.append  # type: ignore[method-assign]
    for name in names:
        logging.getLogger(name).addHandler(handler)
    try:
        yield
    finally:
        for name in names:
            logging.getLogger(name).removeHandler(handler)


class Scheduler:
    """Stands for a dask client whose scheduler dies when a number of tasks are done: the others never end."""

    def __init__(self, tasks: int) -> None:
        self.tasks, self.status = tasks, "running"

    def get_executor(self, pure: bool) -> Executor:
        assert not pure
        outer = self

        class Some(Executor):
            def submit(self, function, /, *arguments, **named):  # type: ignore[no-untyped-def]
                future: Future[object] = Future()
                if outer.status != "running":
                    raise RuntimeError("client is closed")
                if outer.tasks:
                    outer.tasks -= 1
                    future.set_result(function(*arguments, **named))
                else:
                    outer.status = "connecting"
                return future

            def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
                raise AssertionError("nobody waits for a scheduler that is lost")

        return Some()


@pytest.mark.parametrize("done", [0, 1, 9])
def test_futures_that_a_lost_scheduler_never_ends(tmp_path: Path, done: int) -> None:
    """dask drops what fails while it fetches a result: who waits for such a future waits for ever."""
    keys, path = [{"task": task} for task in range(30)], tmp_path / "rows.parquet"
    workers = Workers(lambda: Cluster(Scheduler(done)), 3)
    lost = "workers were lost; finished rows are kept, go on with --resume"
    with pytest.raises(JobError, match=lost), RowTable.open(path) as table:
        run_tasks(work.draw, keys, table, workers)
    assert len(read_rows(path)) / 2 == done if done else not path.exists()
    with RowTable.open(path, resume=True) as table:
        assert run_tasks(work.draw, keys, table)["value"].to_list() == work.drawn(keys)


def ready(address: str, count: int) -> Workers:
    """The cluster, once its workers have come."""
    for _ in range(60):
        workers = cluster(address, patience=30.0)
        if workers.count == count:
            return workers
        time.sleep(0.5)
    return pytest.fail("the workers did not start")


def test_no_scheduler_is_one_line() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no scheduler answers"):
        cluster("tcp://127.0.0.1:1", patience=1.0)


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", ""])
def test_bad_address_is_one_line_at_once(address: str) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"--cluster: found '.*', allowed: an address as tcp://host:8786"):
        cluster(address)


def test_scheduler_without_workers_is_one_line() -> None:
    pytest.importorskip("distributed")
    port = free_port()
    address = f"tcp://127.0.0.1:{port}"
    with ExitStack() as stack:
        stack.enter_context(started(stack, "dask_scheduler", "--host", address, "--no-dashboard"))
        for _ in range(300):
            with socket.socket() as stream:
                if stream.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        with pytest.raises(InputError, match=f"the scheduler has no workers.*dask worker {address}"):
            cluster(address, patience=1.0)


def test_processes_without_semaphores_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system whose shared memory is read-only (EROFS)."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("joblib.externals.loky.backend.synchronize.SemLock.__init__", refuse)
    with RowTable.open(None) as table, pytest.raises(JobError, match=r"Read-only file system.*--workers 1"):
        run_tasks(work.draw, [{"task": 1}], table, chosen_workers(2))


def test_choice_of_workers() -> None:
    assert chosen_workers(1).count == 1
    assert chosen_workers(3).count == 3
