"""Solvers by name: ours come first, those of installed packages are checked when they are loaded."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from doe.solvers import Random
from doe.solvers.solving import SOLVERS, available_solvers, installed_solvers, solver_named
from doe.studies.comparison import Comparison
from identification.errors import InputError
from tests.doe.arms import FOUR

pytestmark = pytest.mark.filterwarnings("ignore:armcal.solvers of installed packages")


def test_every_solver_has_the_name_it_is_asked_for_by() -> None:
    for name in SOLVERS:
        assert solver_named(name).name == name
    with pytest.raises(InputError, match="did you mean 'fedorov'"):
        solver_named("federov")


def test_solver_of_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("baseline", "doe.solvers.solving:Random", "armcal.solvers")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == "armcal.solvers" else [])
    installed_solvers.cache_clear()
    try:
        assert solver_named("baseline") == Random()  # a class is called without arguments
        assert set(available_solvers()) == {*SOLVERS, "baseline"}
        Comparison([FOUR], [4], ["baseline"])
    finally:
        installed_solvers.cache_clear()


@pytest.mark.parametrize(
    ("value", "expected"),
    [("no_such_package_at_all:Mine", "No module named"), ("math:pi", "a solver with offers"), ("math:tau2", "tau2")],
)
def test_a_broken_solver_of_a_package_is_named(monkeypatch: pytest.MonkeyPatch, value: str, expected: str) -> None:
    point = EntryPoint("mine", value, "armcal.solvers")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])
    installed_solvers.cache_clear()
    try:
        with pytest.raises(InputError, match=f"mine = {value}.*{expected}"):
            solver_named("mine")
    finally:
        installed_solvers.cache_clear()
