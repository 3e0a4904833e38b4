"""Solvers by name: ours come first, those of installed packages are checked when they are loaded."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import pytest

from doe.solvers import Random
from doe.solvers.solving import SOLVERS, available_solvers, chosen_solver
from doe.studies.comparison import Comparison
from identification.errors import InputError
from tests.doe.arms import FOUR, problem

pytestmark = pytest.mark.filterwarnings("ignore:armcal.solvers of installed packages")


def test_every_solver_has_the_name_it_is_asked_for_by() -> None:
    for name in SOLVERS:
        assert chosen_solver(problem(FOUR), name).name == name
    with pytest.raises(InputError, match="did you mean 'fedorov'"):
        chosen_solver(problem(FOUR), "federov")


def test_solver_of_an_installed_package(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("baseline", "doe.solvers.solving:Random", "armcal.solvers")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == "armcal.solvers" else [])
    available_solvers.cache_clear()
    try:
        assert chosen_solver(problem(FOUR), "baseline") == Random()  # a class is called without arguments
        assert set(available_solvers()) == {*SOLVERS, "baseline"}
        Comparison([FOUR], [4], ["baseline"])
    finally:
        available_solvers.cache_clear()


@pytest.mark.parametrize(
    ("value", "expected"),
    [("no_such_package_at_all:Mine", "No module named"), ("math:pi", "a solver with offers"), ("math:tau2", "tau2")],
)
def test_a_broken_solver_of_a_package_is_named(monkeypatch: pytest.MonkeyPatch, value: str, expected: str) -> None:
    point = EntryPoint("mine", value, "armcal.solvers")
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point])
    available_solvers.cache_clear()
    try:
        with pytest.raises(InputError, match=f"mine = {value}.*{expected}"):
            chosen_solver(problem(FOUR), "mine")
    finally:
        available_solvers.cache_clear()
