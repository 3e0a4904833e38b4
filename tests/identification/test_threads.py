"""Threads are limited inside the context only."""

from __future__ import annotations

import numpy as np  # noqa: F401  (loads the BLAS that is limited)
from threadpoolctl import threadpool_info, threadpool_limits

from identification.threads import single_thread


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


def test_one_thread_inside_and_as_before_outside() -> None:
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with single_thread():
            assert set(blas_threads()) == {1}
        assert blas_threads() == before
