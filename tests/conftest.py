"""What every test runs under: one BLAS thread, examples that repeat, and, if asked for, disturbed last digits."""

from __future__ import annotations

import gc
import os
import signal
import sys
from typing import Any

sys.dont_write_bytecode = False  # some environments ask for it: each worker, kernel and process would compile anew
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.pop("COLUMNS", None)  # a library that edits lines sets it for the workers; tests expect the width of a pipe
for _name in (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "POLARS_MAX_THREADS",
):  # xdist fills the cores
    os.environ.setdefault(_name, "1")

import numpy as np
import pytest
from hypothesis import settings

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell ignores it for what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=40)
settings.register_profile("explore", deadline=None, print_blob=True)  # 100 new ones every time, failures are stored
settings.register_profile("stress", deadline=None, max_examples=5000)  # of the stress tests a fifth or less
settings.load_profile("repeatable")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--disturb",
        type=float,
        default=0.0,
        metavar="SIZE",
        help="relative change of every random number, 1e-12 say, and of design Jacobians by a hundredth of it: "
        "other last digits, as another processor has them",
    )
    parser.addoption("--kills", type=int, default=200, metavar="NUMBER", help="of each command, in test_faults.py")
    parser.addoption("--against", metavar="TREE", help="another checkout, to compare with in test_speed.py")


FIRST = ("notebooks", "test_house.py", "studies", "cli", "test_diagnose.py")  # folders and files of the longest tests


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first: none must be the last that one core works on while the others wait."""
    items.sort(key=lambda item: min(FIRST.index(part) if part in FIRST else len(FIRST) for part in item.path.parts))
    gc.freeze()  # modules and tests stay to the end: to look through them for garbage takes seconds of the suite


def pytest_configure(config: pytest.Config) -> None:
    if size := config.getoption("--disturb"):
        disturb(size)


def disturb(size: float) -> None:
    """Random numbers nearer to their low end by a factor 1 - size; Jacobians with a ripple of size / 100, at least the
    rounding of a number: some tests compare what follows from them to 1e-12.

    A function of the number alone, so that what repeats still repeats, in this process.
    """
    from doe.problem.problem import DesignProblem

    class Disturbed(np.random.Generator):
        def uniform(self, low: Any = 0.0, high: Any = 1.0, size: Any = None) -> Any:
            return low + (super().uniform(low, high, size) - low) * below_one

        def standard_normal(self, *arguments: Any, **named: Any) -> Any:
            return super().standard_normal(*arguments, **named) * below_one

    below_one, usual, jacobians = 1.0 - size, np.random.default_rng, DesignProblem.scaled_jacobians

    def default_rng(seed: Any = None) -> np.random.Generator:
        return seed if isinstance(seed, np.random.Generator) else Disturbed(usual(seed).bit_generator)

    def rippled(problem: DesignProblem, postures: Any) -> np.ndarray:
        found = jacobians(problem, postures)
        return found * (1.0 + max(0.01 * size, 2.2e-16) * np.sin(1e9 * found))

    np.random.default_rng = default_rng
    DesignProblem.scaled_jacobians = rippled  # type: ignore[method-assign, assignment]
