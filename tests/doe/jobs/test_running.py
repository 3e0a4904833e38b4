"""The same rows from one process, from several and from a cluster; killed workers lose nothing; calls end as asked.

Tables: nothing finished is lost, nothing is overwritten unasked, floats survive to the bit.
"""

import logging
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe import jobs
from doe.jobs import Workers, call, canonical, cluster, parquet, rows_of_table, run_tasks
from identification import InputError, JobError

sys.path.insert(0, str(Path(__file__).parent))  # workers find the tasks by name
import work

from tests.doe.faults import running

KEYS = [{"task": task, "setting": "a"} for task in range(12)]
MANY = [{"task": task} for task in range(60)]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


def rows(function: Any, workers: Workers = 1, keys: list[dict[str, Any]] = KEYS, **options: Any) -> pl.DataFrame:
    return run_tasks(function, keys, None, workers, **options).drop("seconds")


@pytest.mark.parametrize("threads", [False, True])
def test_rows_are_in_the_order_of_their_keys_from_own_seeds(threads: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    with ThreadPoolExecutor(3) as executor:
        if threads:
            monkeypatch.setattr(jobs, "executor_of", lambda _: nullcontext((executor, 8)))
        frame = rows(work.draw, seed=5)
    assert frame["task"].to_list() == [k for k in range(12) for _ in range(2)]
    assert frame["value"].to_list() == work.drawn(KEYS, seed=5)
    assert (len(set(frame["value"])), set(frame["status"])) == (24, {"done"})


def test_a_task_that_fails_is_a_row() -> None:
    frame = rows(work.stop_at_three, payload=lambda _: "raises")
    failed = frame.filter(pl.col("status") == "failed")
    assert failed.select("task", "setting", "value", "error").rows() == [
        (3, "a", None, "ValueError: three is not allowed")
    ]
    assert frame.filter(pl.col("status") == "done")["value"].to_list() == work.drawn([*KEYS[:3], *KEYS[4:]])


def test_ctrl_c_among_processes_leaves_what_is_finished_and_no_failures(tmp_path: Path) -> None:
    def stop(done: float, total: float | None, message: str) -> None:
        if done == 5:
            raise KeyboardInterrupt

    path = tmp_path / "rows.parquet"
    with pytest.raises(KeyboardInterrupt):
        run_tasks(work.slow_draw, MANY, path, 2, progress=stop)
    kept = pl.read_parquet(path)
    assert 5 <= len(kept) / 2 < 20
    assert set(kept["status"]) == {"done"}
    assert kept["value"].to_list() == work.drawn([{"task": task} for task in kept["task"][::2]])


def test_a_killed_process_ends_the_run_and_nothing_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    with pytest.raises(JobError, match="--resume"):
        run_tasks(work.die_at_nine, KEYS, path, 2)
    assert len(pl.read_parquet(path)) < 24
    assert run_tasks(work.draw, KEYS, path, resume=True)["value"].to_list() == work.drawn(KEYS)


def test_two_runs_that_go_on_with_one_table_keep_each_others_rows(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"

    def other(done: float, total: float | None, message: str) -> None:
        if done == 2:
            run_tasks(work.draw, KEYS[6:], path, resume=True)

    run_tasks(work.draw, KEYS[:6], path, resume=True, progress=other)
    assert {text: len(rows) for text, rows in rows_of_table(path).items()} == {canonical(key): 2 for key in KEYS}


# -- a cluster ---------------------------------------------------------------------------------------------------------
@contextmanager
def started(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    words = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:], "--no-dashboard"]
    silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(words, env=ENVIRONMENT, **silent)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[bytes], str, Callable[[], Any]]]:
    """A scheduler, its address, and what starts one more worker there."""
    pytest.importorskip("distributed")
    with socket.socket() as stream:
        stream.bind(("127.0.0.1", 0))
        port = stream.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    options = ("--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    with ExitStack() as stack:
        scheduler = stack.enter_context(started("dask_scheduler", "--host", address))
        for _ in range(1500):
            with socket.socket() as stream:
                if stream.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.02)
        yield scheduler, address, lambda: stack.enter_context(started("dask_worker", address, *options))


def ready(address: str, count: int) -> str:
    """The address of the cluster, once its workers have come."""
    for _ in range(300):
        with cluster(address, patience=30.0) as (_, threads):
            if threads == count:
                return address
        time.sleep(0.1)
    return pytest.fail("the workers did not start")


def test_cluster_with_a_killed_worker_and_then_a_killed_scheduler(
    dask: tuple[Any, str, Callable[[], Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits without the worker; without the scheduler one line, and what is finished is kept."""
    scheduler, address, start = dask
    path, printed, victims = tmp_path / "rows.parquet", list[logging.LogRecord](), list[int]()
    with pytest.raises(InputError, match=rf"no scheduler with workers answers.*dask worker {address}"):
        cluster(address, patience=0.2).__enter__()
    start(), start()
    workers = ready(address, 2)

    def kill_one(done: float, total: float | None, message: str) -> None:
        if done >= 20 and not victims:
            victims.append(pl.read_parquet(path)["process"][-1])
            os.kill(victims[0], signal.SIGKILL)

    monkeypatch.setattr(jobs, "EVERY", 0.0)
    frame = run_tasks(work.slow_draw, MANY, path, workers, progress=kill_one)
    assert (len(victims), len(set(frame["process"]))) == (1, 2)
    assert victims[0] not in set(frame["process"][-20:])
    assert pl.read_parquet(path).equals(frame)  # in the order of the keys, whoever finished first
    assert frame.drop("seconds", "process").equals(rows(work.draw, 1, MANY))

    def kill(done: float, total: float | None, message: str) -> None:
        if done >= 5:
            scheduler.kill()

    handler = logging.Handler(logging.WARNING)
    handler.emit = printed.append  # type: ignore[method-assign]
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client", "tornado.application")]
    for logger in loggers:
        logger.addHandler(handler)
    with pytest.raises(JobError, match="--resume"):
        run_tasks(work.slow_draw, MANY, path, ready(address, 1), force=True, progress=kill)
    for logger in loggers:
        logger.removeHandler(handler)
    assert printed == []
    kept = pl.read_parquet(path)
    assert 5 <= len(kept) / 2 < 60
    assert kept["value"].to_list() == work.drawn(MANY[: len(kept) // 2])


@pytest.mark.parametrize("address", ["nonsense", "tcp://host", ""])
def test_bad_address_is_one_line_at_once(address: str) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=f"--cluster: found '{address}', allowed: an address as tcp://host:8786"):
        cluster(address, patience=0.2).__enter__()


# -- one call in a process of its own ----------------------------------------------------------------------------------
def test_ends_of_calls_are_told_apart() -> None:
    """Python's own signals and timers would wait for the interpreter, which compiled code does not give back."""
    assert call(work.hang, 0.1, seconds=60.0) == "awake"
    for function, seconds, error, words in (
        (work.hang_in_compiled_code, 0.5, JobError, "killed after 0.5 s"),
        (work.fail, 10.0, ArithmeticError, "no\nanswer"),
        (work.crash, 10.0, JobError, r"the process died of SIGSEGV\(-11\)"),
    ):
        with pytest.raises(error, match=words):
            call(function, seconds=seconds)


def test_call_from_a_daemon() -> None:
    """As from a dask worker, which may not have children by `multiprocessing`."""
    queue = multiprocessing.get_context("spawn").Queue()
    process = multiprocessing.get_context("spawn").Process(target=work.call_from_here, args=(queue,), daemon=True)
    process.start()
    assert queue.get(timeout=60.0) == "awake"
    process.join()


def test_a_call_ends_with_the_process_that_asked(tmp_path: Path) -> None:
    """Killed, that process cannot end it."""
    code = "import sys, work; work.ask_and_die(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "pid")], env=ENVIRONMENT, check=False)
    assert done.returncode == -signal.SIGKILL
    asked = int((tmp_path / "pid").read_text())
    for _ in range(600):
        if not running(asked):
            return
        time.sleep(0.05)
    pytest.fail("the call goes on")


# -- tables of rows ----------------------------------------------------------------------------------------------------
def test_a_table_is_one_file_that_is_refused_resumed_or_replaced(tmp_path: Path) -> None:
    path, asked = tmp_path / "job" / "rows.parquet", list[object]()
    first = run_tasks(work.draw, KEYS[:2], path, seed=5)
    with pytest.raises(InputError, match="--resume"):
        run_tasks(work.draw, KEYS[:2], path, seed=5)
    with pytest.raises(InputError, match="--seed 5, found 6"):
        run_tasks(work.draw, KEYS, path, seed=6, resume=True)
    more = run_tasks(work.draw, KEYS[:3], path, seed=5, resume=True, payload=asked.append)
    assert more.head(len(first)).equals(first.select(more.columns))
    assert asked == [KEYS[2]]
    assert more["value"].to_list() == pl.read_parquet(path)["value"].to_list() == work.drawn(KEYS[:3], seed=5)
    run_tasks(work.draw, KEYS[4:5], path, force=True, progress=lambda *_: asked.append(path.exists()))
    assert asked[1:] == [False, False]  # what is replaced does not come back when the new run is killed
    assert (pl.read_parquet(path)["task"].to_list(), list(path.parent.iterdir())) == ([4, 4], [path])


def test_the_table_of_another_run_that_began_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    run = partial(run_tasks, work.draw, KEYS[:2], path)
    with pytest.raises(InputError, match="the file exists, allowed: a new file name"):
        run(seed=6, progress=lambda *_: path.exists() or run(seed=5))
    assert pl.read_parquet(path)["value"].to_list() == work.drawn(KEYS[:2], seed=5)


@pytest.mark.parametrize("writing", [False, True])
def test_ctrl_c_keeps_what_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writing: bool) -> None:
    """While a task runs; a second one while the table is written leaves no half of it."""
    path, run = tmp_path / "rows.parquet", lambda **how: run_tasks(work.stop_at_three, KEYS, path, **how)
    if writing:
        monkeypatch.setattr(jobs, "parquet", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        run(payload=lambda _: "interrupt")
    monkeypatch.undo()
    assert len([*tmp_path.iterdir()]) == (0 if writing else 1)
    seen = list[float]()
    frame = run(payload=lambda _: "", resume=True, progress=lambda done, *_: seen.append(done))
    assert (seen, frame["value"].to_list()) == ([*range(0 if writing else 3, 13)], work.drawn(KEYS))


def test_bad_places_and_foreign_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("no")
    pl.DataFrame({"x": [1]}).write_parquet(tmp_path / "b.parquet")
    places = {"missing/there/rows.parquet": "no folder", ".": "allowed", "a.parquet": "not a Parquet"}
    for name, reason in {**places, "b.parquet": "column 'key'"}.items():
        with pytest.raises(InputError, match=reason):
            run_tasks(work.draw, KEYS, tmp_path / name, resume=True)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_table_without_a_finished_task_leaves_nothing(tmp_path: Path) -> None:
    for folder in (tmp_path / "new", tmp_path):
        run_tasks(work.stop_at_three, [KEYS[3]], folder / "rows.parquet", payload=lambda _: "raises")
        assert not list(tmp_path.iterdir())


@given(done=st.sets(st.integers(0, 11)), again=st.sets(st.integers(0, 11)))
@settings(max_examples=20)
def test_wherever_it_stopped_the_bytes_are_those_of_one_run(
    done: set[int], again: set[int], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Finished in any order by two earlier runs."""
    folder = tmp_path_factory.mktemp("rows")
    for part in (done, again):
        run_tasks(work.mixed, [KEYS[k] for k in sorted(part, reverse=True)], folder / "parts", resume=True)
    for name in ("parts", "whole"):
        run_tasks(work.mixed, KEYS, folder / name, resume=True)
    parts, whole = (parquet(pl.read_parquet(folder / name).drop("seconds")) for name in ("parts", "whole"))
    assert parts == whole
