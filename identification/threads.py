"""Linear algebra on one thread. Matrices here are 8 x 8 or so: more threads only wait for each other (5 x slower)."""

from __future__ import annotations

from contextlib import AbstractContextManager


def single_thread() -> AbstractContextManager[object]:
    """`with single_thread():` BLAS uses one thread inside, and as many as before afterwards."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1, user_api="blas")
