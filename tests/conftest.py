"""What every test runs under: one BLAS thread, and examples that repeat."""

import gc
import os
import signal
import sys

sys.dont_write_bytecode = False  # some environments ask for it: each worker, kernel and process would compile anew
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
os.environ.pop("COLUMNS", None)  # a library that edits lines sets it for the workers; tests expect the width of a pipe
# xdist fills the cores
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(_name, "1")

import pytest
from hypothesis import settings
from hypothesis.internal.conjecture import providers

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # a shell ignores it for what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)
# examples would hold numbers of the modules that are loaded, which differ between workers: they would not repeat
providers.is_local_module_file = lambda _: False  # type: ignore[attr-defined]
settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=40)
settings.register_profile("explore", deadline=None, print_blob=True)  # 100 new ones every time, failures are stored
settings.register_profile("stress", deadline=None, max_examples=5000)  # of the stress tests a fifth or less
settings.load_profile("repeatable")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--kills", type=int, default=200, metavar="NUMBER", help="of each command, in test_faults.py")
    parser.addoption("--against", metavar="TREE", help="another checkout, to compare with in test_speed.py")


FIRST = ("notebooks", "test_house.py", "studies", "cli", "test_diagnose.py")  # folders and files of the longest tests


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest first: none must be the last that one core works on while the others wait."""
    items.sort(key=lambda item: min(FIRST.index(part) if part in FIRST else len(FIRST) for part in item.path.parts))
    gc.freeze()  # modules and tests stay to the end: to look through them for garbage takes seconds of the suite
    gc.set_threshold(50_000)  # and so does to look after every 700 of the many numbers of CasADi
