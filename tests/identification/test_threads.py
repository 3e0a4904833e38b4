"""Threads are limited inside the context only."""

from __future__ import annotations

import os
import subprocess
import sys

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


def test_a_library_that_is_loaded_later_is_limited_too() -> None:
    """In a process of its own: SciPy brings a BLAS besides numpy's."""
    code = (
        "import numpy\n"
        "from threadpoolctl import threadpool_info\n"
        "from identification.threads import single_thread\n"
        "with single_thread(): pass\n"
        "import scipy.linalg\n"
        "with single_thread(): print(*(found['num_threads'] for found in threadpool_info()))\n"
    )
    system = {**os.environ, "OPENBLAS_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], env=system, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) == {"1"}
    assert len(done.stdout.split()) > 1
