"""Reproducible task lists: the rows depend on key and seed, never on workers or order.

A task is a key (what to do, in JSON types). Functions are sent to workers by name and called with keys: what cannot be
pickled (CasADi, IPOPT) is built there.
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.jobs.isolated import one_line
from doe.jobs.row_table import Key, Row, RowTable, canonical, made
from doe.jobs.workers import Cluster, Workers, serial
from identification.errors import InputError, JobError
from identification.files.io import PathLike
from identification.progress import Progress, silent

if TYPE_CHECKING:
    import polars

Function = Callable[..., list[Row]]  # (key, seed sequence), and the key's payload where there is one
SEED = "seed"  # column; a key with an entry of this name brings its own
AHEAD = 3  # tasks handed out per worker, so that none waits; a million tasks are never in flight at once
WATCH = 0.2  # [s] between two looks at whether a cluster's scheduler is still there


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
    _check_seeds(keys, table, seed)
    queue = deque({canonical(key): key for key in keys if key not in table}.values())
    workers, done, failed = workers or serial(), len(keys) - len(queue), 0
    ahead = workers.count * AHEAD if workers.count > 1 else 1
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
                    for future in wait(running, WATCH, FIRST_COMPLETED).done:
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


def _check_seeds(keys: Sequence[Key], table: RowTable, seed: int) -> None:
    for key in keys:
        for row in table.rows.get(canonical(key), ()):
            if (made := row.get(SEED)) not in (None, key.get(SEED, seed)):
                allowed = f"--seed {made} to go on, or --force to replace them"
                raise InputError(f"{table.path}: its rows are of --seed {made}, found {seed}, allowed: {allowed}")


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
        folder: PathLike | None,
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
