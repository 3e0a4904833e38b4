"""Tasks for the tests of executors: functions that workers import by name."""

import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from doe.jobs import Key, call, seed_of

Rows = list[dict[str, Any]]


def draw(key: dict[str, Any], seed: np.random.SeedSequence, _: Any = None) -> Rows:
    """Two random rows of a key."""
    return [{"part": part, "value": float(np.random.default_rng(seed).standard_normal() + part)} for part in range(2)]


def slow_draw(key: dict[str, Any], seed: np.random.SeedSequence) -> Rows:
    """As `draw`, with the worker's process number, slowly enough to be killed in the middle."""
    time.sleep(0.02)
    return [{**row, "process": os.getpid()} for row in draw(key, seed)]


def die_at_nine(key: dict[str, Any], seed: np.random.SeedSequence) -> Rows:
    """As `slow_draw`, but task 9 kills its process."""
    time.sleep(0.02)
    if key["task"] == 9:
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(key, seed)


def mixed(key: dict[str, Any], seed: np.random.SeedSequence) -> Rows:
    """Rows of several forms: none, whole and broken numbers, lists, texts, and a task that raises."""
    rows = ([{"value": key["task"]}], [{"value": 0.5, "more": [1.0, 2.5]}, {"value": 1 / 3}], [])
    if key["task"] % 4 == 3:
        raise ValueError("no")
    return rows[key["task"] % 4]


def stop_at_three(key: dict[str, Any], seed: np.random.SeedSequence, how: str) -> Rows:
    """As `draw`, but task 3 raises or is stopped by Ctrl-C."""
    if key["task"] == 3 and how == "raises":
        raise ValueError("three is\nnot allowed")
    if key["task"] == 3 and how == "interrupt":
        raise KeyboardInterrupt
    return draw(key, seed)


def hang(seconds: float) -> str:
    """Sleeps."""
    time.sleep(seconds)
    return "awake"


def hang_and_tell(path: str) -> None:
    """Writes its process number, and sleeps."""
    Path(f"{path}.new").write_text(str(os.getpid()))
    os.replace(f"{path}.new", path)
    time.sleep(300.0)


def ask_and_die(path: str) -> None:
    """Is killed while a call of its own sleeps."""
    threading.Thread(target=call, args=(hang_and_tell, path), kwargs={"seconds": 300.0}).start()
    while not Path(path).exists():
        time.sleep(0.02)
    os.kill(os.getpid(), signal.SIGKILL)


def hang_in_compiled_code() -> None:
    """Takes longer than anybody waits, without giving the interpreter back."""
    re.match(r"(a+)+$", "a" * 60 + "b")


def call_from_here(queue: Any) -> None:
    """Puts what a call returns that is made in this process."""
    queue.put(call(hang, 0.0, seconds=60.0))


def crash() -> None:
    """Dies of a signal."""
    os.kill(os.getpid(), signal.SIGSEGV)


def fail() -> None:
    """Raises."""
    raise ArithmeticError("no\nanswer")


def drawn(keys: list[Key], seed: int = 0) -> list[float]:
    """The values that `draw` gives for the keys."""
    draws = [float(np.random.default_rng(seed_of(key, seed)).standard_normal()) for key in keys]
    return [value + part for value in draws for part in range(2)]
