"""The same rows from one process and from several; killed workers lose nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from doe.jobs.rows import RowTable, parquet, read_rows
from doe.jobs.running import Function, Job, Workers, processes, run_tasks, serial
from identification.errors import InputError, JobError

sys.path.insert(0, str(Path(__file__).parent))  # workers find the tasks by name
import work

KEYS = [{"task": task, "setting": "a"} for task in range(12)]


def rows(function: Function, workers: Workers, keys: list[dict[str, Any]] = KEYS, **options: Any) -> pl.DataFrame:
    with RowTable.open(None) as table:
        return run_tasks(function, keys, table, workers, **options).drop("seconds")


def test_rows_come_in_the_order_of_the_keys_and_from_their_own_seeds() -> None:
    frame = rows(work.draw, serial(), seed=5)
    assert frame["task"].to_list() == [k for k in range(12) for _ in range(2)]
    assert frame["value"].to_list() == work.drawn(KEYS, seed=5)
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
        run_tasks(work.interrupt_at_three, KEYS, table)
    assert sorted(set(read_rows(path)["task"])) == [0, 1, 2]
    seen = []
    with RowTable.open(path, resume=True) as table:
        frame = run_tasks(work.draw, KEYS, table, progress=lambda done, total, _: seen.append((done, total)))
    assert seen == [(done, 12) for done in range(3, 13)]
    assert frame["value"].to_list() == work.drawn(KEYS)
    assert read_rows(path)["value"].to_list() == work.drawn(KEYS)


def test_lost_workers_that_cannot_come_back_are_an_error(tmp_path: Path) -> None:
    keys = [{"task": task, "mark": str(tmp_path / "mark") if task == 3 else ""} for task in range(8)]
    workers = Workers(lambda: ProcessPoolExecutor(1, get_context("spawn")), 1)
    with RowTable.open(None) as table, pytest.raises(JobError, match="--resume"):
        run_tasks(work.die_once, keys, table, workers)


def test_killed_process_loses_nothing(tmp_path: Path) -> None:
    keys = [{"task": task, "mark": str(tmp_path / "mark") if task == 5 else ""} for task in range(12)]
    frame = rows(work.die_once, processes(2), keys)
    assert (tmp_path / "mark").exists()
    assert frame["value"].to_list() == work.drawn(keys)
    assert frame.equals(rows(work.draw, serial(), keys))


def test_a_task_that_kills_its_worker_each_time_is_a_row() -> None:
    frame = rows(work.die_always, processes(2), KEYS[:8])
    failed = frame.filter(pl.col("status") == "failed")
    assert failed["task"].to_list() == [3]
    assert "died each time" in failed["error"][0]
    done = [key for key in KEYS[:8] if key["task"] != 3]
    assert frame.filter(pl.col("status") == "done")["value"].to_list() == work.drawn(done)


def test_killed_study_leaves_no_process_behind_and_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    code = (
        "import os, signal, work\nfrom doe.jobs.running import Job, run_tasks\nfrom doe.jobs.running import processes\n"
        "from doe.jobs.rows import RowTable\n"
        "def kill(done, total, message):\n    if done == 6: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"with RowTable.open({str(path)!r}) as table:\n"
        "    run_tasks(work.slow_draw, [{'task': k} for k in range(30)], table, processes(2), progress=kill)\n"
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
        frame = run_tasks(work.draw, keys, table)
    assert frame["value"].to_list() == work.drawn(keys)


def test_a_job_keeps_its_tables_in_one_folder_and_resumes_each(tmp_path: Path) -> None:
    folder, names = tmp_path / "job", ("a.parquet", "b.parquet")
    with Job.open(folder, names, seed=5) as job:
        first = job.run(work.draw, KEYS[:2], "a.parquet")
        with pytest.raises(InputError, match="another run"), Job.open(folder, names[1:], resume=True):
            pass  # closed before its turn comes
    asked: list[Any] = []

    def payload(key: Any) -> None:
        asked.append(key)

    with Job.open(folder, names, seed=5, resume=True) as job:
        more = job.run(work.draw_with_payload, KEYS[:3], "a.parquet", payload)
    assert more.head(len(first)).equals(first.select(more.columns))
    assert asked == [KEYS[2]]
    assert more["value"].to_list() == work.drawn(KEYS[:3], seed=5)
    with pytest.raises(InputError, match="exists"), Job.open(folder, names):
        pass
    assert [path.name for path in folder.iterdir()] == ["a.parquet"]


def test_rows_of_another_seed_are_not_mixed_in(tmp_path: Path) -> None:
    with Job.open(tmp_path, ("a.parquet",), seed=5) as job:
        job.run(work.draw, KEYS[:2], "a.parquet")
    with (
        Job.open(tmp_path, ("a.parquet",), seed=6, resume=True) as job,
        pytest.raises(InputError, match="--seed 5, found 6, allowed: --seed 5"),
    ):
        job.run(work.draw, KEYS, "a.parquet")
    assert read_rows(tmp_path / "a.parquet")["seed"].to_list() == [5] * 4


@given(done=st.sets(st.integers(0, 11)), again=st.sets(st.integers(0, 11)), killed=st.booleans())
@settings(max_examples=25)
def test_wherever_it_stopped_the_bytes_are_those_of_one_run(
    done: set[int], again: set[int], killed: bool, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Finished in any order by two earlier runs, of which the last left a table, or a journal with a torn end."""
    folder = tmp_path_factory.mktemp("rows")
    for number, part in enumerate((done, again)):
        with RowTable.open(folder / "parts", resume=True) as table:
            run_tasks(work.mixed, [KEYS[k] for k in sorted(part, reverse=True)], table)
            if killed and number:
                table._finish = lambda: None  # type: ignore[method-assign]
                assert table._journal is not None
                table._journal.write(b'["torn", [')
    content = []
    for name in ("parts", "whole"):
        with RowTable.open(folder / name, resume=True) as table:
            run_tasks(work.mixed, KEYS, table)
        content.append(parquet(pl.read_parquet(folder / name).drop("seconds")))
    assert content[0] == content[1]
