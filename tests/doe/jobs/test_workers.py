"""The same rows from one process, several, and a dask cluster; killed workers lose nothing."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from doe.jobs.row_table import RowTable, read_rows
from doe.jobs.workers import Function, Workers, choose, cluster, processes, run, seed_of, serial
from identification.errors import InputError, JobError

sys.path.insert(0, str(Path(__file__).parent))  # workers find the tasks by name
import work

KEYS = [{"task": task, "setting": "a"} for task in range(12)]


def rows(function: Function, workers: Workers, keys: list[dict[str, Any]] = KEYS, **options: Any) -> pl.DataFrame:
    with RowTable.open(None) as table:
        return run(function, keys, table, workers, **options).drop("seconds")


def expected(keys: list[dict[str, Any]], seed: int = 0) -> list[float]:
    draws = [float(np.random.default_rng(seed_of(key, seed)).standard_normal()) for key in keys]
    return [value + part for value in draws for part in range(2)]


def test_rows_come_in_the_order_of_the_keys_and_from_their_own_seeds() -> None:
    frame = rows(work.draw, serial(), seed=5)
    assert frame["task"].to_list() == [k for k in range(12) for _ in range(2)]
    assert frame["value"].to_list() == expected(KEYS, seed=5)
    assert len(set(frame["value"])) == 24
    assert set(frame["status"]) == {"done"}


def test_own_executor_gives_the_same_rows() -> None:
    with ThreadPoolExecutor(3) as executor:
        assert rows(work.draw, Workers(lambda: nullcontext(executor), 8)).equals(rows(work.draw, serial()))
        executor.submit(int)  # still open


def test_a_task_that_raises_is_a_row() -> None:
    frame = rows(work.raise_at_three, serial())
    failed = frame.filter(pl.col("status") == "failed")
    assert failed.select("task", "setting", "error", "value").rows() == [
        (3, "a", "ValueError: three is not allowed", None)
    ]
    assert len(frame) == 23


def test_resume_does_only_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    with pytest.raises(KeyboardInterrupt), RowTable.open(path) as table:
        run(work.interrupt_at_three, KEYS, table)
    assert sorted(set(read_rows(path)["task"])) == [0, 1, 2]
    seen = []
    with RowTable.open(path, resume=True) as table:
        frame = run(work.draw, KEYS, table, progress=lambda done, total, _: seen.append((done, total)))
    assert seen == [(done, 12) for done in range(3, 13)]
    assert frame["value"].to_list() == expected(KEYS)
    assert read_rows(path)["value"].to_list() == expected(KEYS)


def test_lost_workers_that_cannot_come_back_are_an_error(tmp_path: Path) -> None:
    keys = [{"task": task, "mark": str(tmp_path / "mark") if task == 3 else ""} for task in range(8)]
    pool = processes(1)
    with RowTable.open(None) as table, pytest.raises(JobError, match="--resume"):
        run(work.die_once, keys, table, Workers(pool.open, 1))


def test_killed_process_loses_nothing(tmp_path: Path) -> None:
    keys = [{"task": task, "mark": str(tmp_path / "mark") if task == 5 else ""} for task in range(12)]
    frame = rows(work.die_once, processes(2), keys)
    assert (tmp_path / "mark").exists()
    assert frame["value"].to_list() == expected(keys)
    assert frame.equals(rows(work.draw, serial(), keys))


def test_a_task_that_kills_its_worker_each_time_is_a_row() -> None:
    frame = rows(work.die_always, processes(2), KEYS[:8])
    failed = frame.filter(pl.col("status") == "failed")
    assert failed["task"].to_list() == [3]
    assert "died each time" in failed["error"][0]
    done = [key for key in KEYS[:8] if key["task"] != 3]
    assert frame.filter(pl.col("status") == "done")["value"].to_list() == expected(done)


def test_killed_study_leaves_no_process_behind_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    code = (
        "import os, signal, work\nfrom doe.jobs.workers import processes, run\n"
        "from doe.jobs.row_table import RowTable\n"
        "def kill(done, total, message):\n    if done == 6: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"with RowTable.open({str(path)!r}) as table:\n"
        "    run(work.slow_draw, [{'task': k} for k in range(30)], table, processes(2), progress=kill)\n"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # the workers hold standard output: it closes when the last of them is gone
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, timeout=60.0, check=False
    )
    assert done.returncode == -signal.SIGKILL
    assert len(read_rows(path)) == 12
    keys = [{"task": task} for task in range(30)]
    with RowTable.open(path, resume=True) as table:
        frame = run(work.draw, keys, table)
    assert frame["value"].to_list() == expected(keys)


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
            frame = run(work.slow_draw, keys, table, workers, progress=kill_one)
    assert len(victims) == 1
    assert len(set(frame["process"])) == 2
    assert victims[0] not in set(frame["process"][-20:])
    assert frame["value"].to_list() == expected(keys)
    assert read_rows(path).equals(frame)  # the file is in the order of the keys, whoever finished first
    assert frame.drop("seconds", "process").equals(rows(work.draw, serial(), keys))


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


def test_choice_of_workers() -> None:
    assert choose(1).count == 1
    assert choose(3).count == 3
    assert choose(3).reopens
