"""Linear algebra on one thread. Matrices here are 8 x 8 or so: more threads only wait for each other (5 x slower)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

# what the environment of a new process says for it
SINGLE_THREAD = MappingProxyType(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))


@contextmanager
def single_thread() -> Iterator[None]:
    """`with single_thread():`, or `@single_thread()` of a function: BLAS uses one thread inside, and as many as before
    afterwards."""
    with _libraries(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Those that are loaded; to look for them takes 2 ms, so again only after an import (`modules`: their number)."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
