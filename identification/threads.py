"""Linear algebra on one thread. Matrices here are 8 x 8 or so: more threads only wait for each other (5 x slower)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def single_thread() -> Iterator[None]:
    """`with single_thread():`, or `@single_thread()` of a function: BLAS uses one thread inside, and as many as before
    afterwards."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield
