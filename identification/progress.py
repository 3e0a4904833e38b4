"""Progress of long work, as a callable that the caller provides. Nothing is printed unless one is given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

Tell = Callable[[str], None]  # is told what a part of the work is at


class Progress(Protocol):
    """Called as `progress(done, total, message)`; `total` may be None when it is not known."""

    def __call__(self, done: float, total: float | None, message: str) -> None: ...


def silent(done: float, total: float | None, message: str) -> None:
    """The default: says nothing."""


def within(part: str, tell: Tell) -> Tell:
    """Tells what is told after what it is a part of."""
    return lambda message: tell(part + message)


def say_nothing(message: str) -> None:
    """The default of a `Tell`."""
