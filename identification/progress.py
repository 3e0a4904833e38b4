"""Progress of long work, as a callable that the caller provides. Nothing is printed unless one is given."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called as `progress(done, total, message)`; `total` may be None when it is not known."""

    def __call__(self, done: float, total: float | None, message: str) -> None: ...


def silent(done: float, total: float | None, message: str) -> None:
    """The default: says nothing."""
