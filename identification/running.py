"""How work runs: how it ended, how far it is, on how many threads, and what installed packages add to it."""

import sys
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from importlib import import_module, metadata
from typing import Any

from identification.errors import InputError


class Status(Enum):
    """Outcome of an iterative search or fit; `name` goes into JSON, `value` is the sentence shown to people."""

    bound_reached = "The upper bound is reached: no plan with this many runs can be better."
    starts_finished = "All starts are used up; more of them (--starts) might find a better plan."
    agreed = "Many independent starts ended at the same best value; more starts are unlikely to find a better plan."
    local_optimum = "No single exchange improves the plan; another --seed may lead to a better one."
    time_limit = "The time budget ended; the best plan so far is returned. Raise --seconds to keep searching."
    interrupted = "Stopped by the user (Ctrl-C, SIGTERM); the best plan so far is returned."
    replaced = "Postures without a collision-free path were replaced by the best of random ones that have one."
    scored = "Plan supplied by the user: evaluated, not optimized."
    converged = "Converged."
    almost_solved = "Stopped near a solution at reduced accuracy; check the optimality gap before relying on it."
    iteration_limit = "The iteration limit was reached before convergence; look at the residuals."
    solver_failed = "The solver failed; its result is not used."
    not_identifiable = (
        "Some parameters are not identifiable; the others hold. Measure more varied postures, or fix one "
        "per combination."
    )
    implausible = "Converged to an arm that cannot be the real one; check arm, frame and units before using it."


@dataclass(frozen=True)
class Progress:
    """Called as `progress(done, total, message)`; `total` may be None when it is not known.

    show : what is done with it; left out: nothing is shown
    """

    show: Callable[[float, float | None, str], object] = lambda *_: None

    def __call__(self, done: float, total: float | None, message: str) -> None:
        self.show(done, total, message)


@contextmanager
def single_thread() -> Generator[None, None, None]:
    """`with single_thread():`, or `@single_thread()` of a function: BLAS uses one thread inside, and as many as before
    afterwards. Matrices here are 8 x 8 or so: more threads only wait for each other (5 x slower)."""
    with _libraries(len(sys.modules)).limit(limits=1, user_api="blas"):
        yield


# those that are loaded; to look for them takes 2 ms, a tenth of a fit, so again only after an import: number of modules
_libraries = lru_cache(maxsize=1)(lambda modules: import_module("threadpoolctl").ThreadpoolController())


def additions(group: str) -> Iterator[tuple[str, str, Any]]:
    """Name, place (for messages) and object of every entry point of a group. Warns (`UserWarning`) of all of them
    before the first is loaded, which runs the package's code. Raises `InputError` for one that cannot be loaded."""
    points = list(metadata.entry_points(group=group))
    if points:
        packages = ("of no package" if p.dist is None else f"{p.dist.name} {p.dist.version}" for p in points)
        listed = ", ".join(f"{point.name} ({package})" for point, package in zip(points, packages, strict=True))
        warnings.warn(f"{group} of installed packages, whose code runs now: {listed}", UserWarning, stacklevel=2)
    for point in points:
        where = f"entry point {group}: {point.name} = {point.value}"
        try:
            loaded = point.load()
        except Exception as error:  # noqa: BLE001 - other people's code
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise InputError(f"{where}: {reason}, allowed: a package that can be imported") from None
        yield point.name, where, loaded
