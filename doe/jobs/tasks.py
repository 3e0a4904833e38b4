"""Reproducible task lists: the rows depend on key and seed, never on workers or order.

A task is a key (what to do, in JSON types); its rows depend on the key and the seed only, never on the number of
workers or the order. Functions are sent to workers by name and called with keys: what cannot be pickled (CasADi,
IPOPT) is built there.
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.jobs.isolated import one_line
from doe.jobs.row_table import Key, Row, RowTable, canonical
from doe.jobs.workers import Workers, serial
from identification.errors import InputError, JobError
from identification.files.io import PathLike
from identification.progress import Progress, silent

if TYPE_CHECKING:
    import polars

Function = Callable[..., list[Row]]  # (key, seed sequence), and the key's payload where there is one
SEED = "seed"  # column; a key with an entry of this name brings its own
AHEAD = 3  # tasks handed out per worker, so that none waits; a million tasks are never in flight at once
TRIES = 2  # a task whose worker died this often runs once more alone: if that worker dies too, the task is at fault


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
    A task that raises becomes a row with `status` "failed" and `error`; every row has its key's entries, `status` and
    `seconds`. Rows are in the table as soon as they are finished: Ctrl-C or a crash loses only what was being computed.
    Raises `JobError` if all workers are lost and cannot be opened again, `InputError` if the table's rows are those of
    another seed.
    """
    _check_seeds(keys, table, seed)
    todo = {canonical(key): key for key in keys if key not in table}
    done = len(keys) - len(todo)
    state = _Dispatcher(function, payload, table, seed, deque(todo.values()), progress, done, len(keys))
    workers = workers or serial()
    ahead = workers.count * AHEAD if workers.count > 1 or workers.reopens else 1
    try:
        _work(state, workers, ahead)
    finally:
        table.arrange(keys)
    return table.frame(keys)


def _check_seeds(keys: Sequence[Key], table: RowTable, seed: int) -> None:
    for key in keys:
        for row in table.rows.get(canonical(key), ()):
            if (made := row.get(SEED)) not in (None, key.get(SEED, seed)):
                allowed = f"--seed {made} to go on, or --force to replace them"
                raise InputError(f"{table.path}: its rows are of --seed {made}, found {seed}, allowed: {allowed}")


@dataclass(frozen=True)
class Job:
    """Several tables of rows that belong together, and the workers that fill them."""

    tables: Mapping[str, RowTable]
    workers: Workers | None
    seed: int
    progress: Progress

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
        with ExitStack() as stack:
            tables = {
                name: stack.enter_context(RowTable.within(folder, name, resume=resume, force=force)) for name in names
            }
            yield cls(tables, workers, seed, progress)

    def run(
        self, function: Function, keys: Sequence[Key], name: str, payload: Callable[[Key], Any] | None = None
    ) -> polars.DataFrame:
        """The rows of all keys, as `run_tasks` gives them, kept in the table of this name."""
        options: dict[str, Any] = {"seed": self.seed, "payload": payload, "progress": self.progress}
        return run_tasks(function, keys, self.tables[name], self.workers, **options)


def _work(state: _Dispatcher, workers: Workers, ahead: int) -> None:
    """Work through the queue, opening a new executor whenever one breaks."""
    before = state.done
    for opened in count(1):
        if not state.queue:
            return
        with workers.open() as executor:
            state.drain(executor, ahead)
        if state.queue and not workers.reopens:
            raise JobError("the workers were lost; finished rows are kept, go on with --resume")
        if opened > TRIES and state.done == before:
            raise JobError("no worker process survives its start; a script needs `if __name__ == '__main__':`")


@dataclass
class _Dispatcher:
    """The loop over one executor: hands out, collects, and notes what a broken one left undone."""

    function: Function
    payload: Callable[[Key], Any] | None
    table: RowTable
    seed: int
    queue: deque[Key]
    progress: Progress
    done: int
    total: int
    failed: int = 0
    deaths: dict[str, int] = field(default_factory=dict)

    def drain(self, executor: Executor, ahead: int) -> None:
        """Works until the queue is empty or the executor broke; what it was doing then is back in the queue."""
        self._report()
        running: dict[Future[Any], Key] = {}
        lost: list[Key] = []
        try:
            while (self.queue and not lost) or running:
                if not lost:
                    lost += self._hand_out(executor, running, ahead)
                finished = wait(running, return_when=FIRST_COMPLETED).done
                lost += [key for future in finished if (key := self._collect(future, running.pop(future))) is not None]
        finally:  # after Ctrl-C: keep what is finished, stop what is not
            for future, key in running.items():
                if not future.cancel() and future.done():
                    self._collect(future, key)
        self.queue.extendleft(reversed(lost))

    def _hand_out(self, executor: Executor, running: dict[Future[Any], Key], ahead: int) -> list[Key]:
        """Submits until `ahead` tasks are out; those whose worker died go singly. Returns what could not go out."""
        while self.queue and len(running) < (1 if self._suspect(self.queue[0]) else ahead):
            if any(self._suspect(key) for key in running.values()):
                break
            key = self.queue.popleft()
            try:
                more = () if self.payload is None else (self.payload(key),)
                running[executor.submit(perform, self.function, dict(key), self.seed, *more)] = key
            except (BrokenExecutor, RuntimeError):
                return [key]
        return []

    def _suspect(self, key: Key) -> bool:
        return self.deaths.get(canonical(key), 0) >= TRIES

    def _collect(self, future: Future[Any], key: Key) -> Key | None:
        """Stores a finished task; returns its key if its worker died and it is to be tried again."""
        if future.cancelled():
            return key
        error = future.exception()
        if isinstance(error, BrokenExecutor):
            if self._may_try_again(canonical(key)):
                return key
            error = RuntimeError("the worker process died each time it ran this task")
        # an error here is the executor's own: a dask worker killed several times over, rows that cannot travel
        rows = future.result() if error is None else [_failure(key, self.seed, error, 0.0)]
        self.table.add(key, rows)
        self.done += 1
        self.failed += rows[0]["status"] != "done"
        self._report()
        return None

    def _may_try_again(self, text: str) -> bool:
        self.deaths[text] = self.deaths.get(text, 0) + 1
        return self.deaths[text] <= TRIES

    def _report(self) -> None:
        self.progress(self.done, self.total, f"{self.failed} failed" if self.failed else "")


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
