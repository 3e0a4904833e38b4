"""Code of installed packages: named before it runs, refused in one line where it fails. Threads: limited inside the
context only."""

from __future__ import annotations

import sys
import warnings
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np  # noqa: F401  (loads the BLAS that is limited)
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from identification import InputError
from identification.running import additions, single_thread


def install(monkeypatch: pytest.MonkeyPatch, folder: Path, source: str) -> None:
    (folder / "addition_for_test.py").write_text(source)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "addition_for_test", raising=False)
    point = EntryPoint("mine", "addition_for_test:thing", "armcal.effects")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])


def test_named_before_its_code_runs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The warning of what runs comes before the one that the code itself gives."""
    install(monkeypatch, tmp_path, "import warnings\nwarnings.warn('running')\nthing = 7\n")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert [(name, found) for name, _, found in additions("armcal.effects")] == [("mine", 7)]
    first = "armcal.effects of installed packages, whose code runs now: mine (of no package)"
    assert [str(one.message) for one in said] == [first, "running"]


@pytest.mark.parametrize("source", ["raise RuntimeError('a\\nb')", "def", ""])
@pytest.mark.filterwarnings("ignore:armcal.effects of installed packages")
def test_one_that_fails_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, source: str) -> None:
    install(monkeypatch, tmp_path, source)
    with pytest.raises(
        InputError, match=r"^entry point armcal.effects: mine = addition_for_test:thing: .*, allowed: ."
    ):
        list(additions("armcal.effects"))


def blas_threads() -> list[int]:
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]


def test_one_thread_inside_and_as_before_outside() -> None:
    with threadpool_limits(2, user_api="blas"):
        before = blas_threads()
        with single_thread():
            assert set(blas_threads()) == {1}
        assert blas_threads() == before
