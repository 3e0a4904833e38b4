"""Choosing m of a list: against all subsets, and against the relaxation's bound."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from doe.solvers import Fedorov, solve
from identification.errors import InputError
from tests.doe.arms import FOUR, OFFSET, problem

LIST = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (18, 4))


def test_best_of_all_subsets() -> None:
    case = problem(FOUR, choices=LIST)
    values = {rows: case.objective(LIST[list(rows)]) for rows in combinations(range(18), 5)}
    best = max(values, key=lambda rows: values[rows])
    design = solve(case, 5)
    assert design.value == pytest.approx(values[best], abs=1e-12)
    assert sorted(map(tuple, design.plan.postures)) == sorted(map(tuple, LIST[list(best)]))
    assert design.bound is not None
    assert design.bound.source == "grid"
    assert design.bound.value >= values[best]


def test_around_measured_postures() -> None:
    kept = LIST[:4]
    case = problem(FOUR, choices=LIST, kept=kept)
    values = [case.objective(LIST[list(rows)]) for rows in combinations(range(18), 3)]
    design = solve(case, 3)
    assert design.value == pytest.approx(max(values), abs=1e-12)
    assert design.efficiency is not None
    assert design.efficiency <= 1.0 + 1e-9


def test_repeats_only_when_asked_for() -> None:
    few = LIST[:6]
    assert len(np.unique(solve(problem(FOUR, choices=few), 6).plan.postures, axis=0)) == 6
    repeated = solve(problem(FOUR, choices=few, minimum_distance=0.0), 12)
    assert len(repeated.plan) == 12
    with pytest.raises(InputError, match=r"runs: found 12, allowed: up to 6, the different postures"):
        solve(problem(FOUR, choices=np.vstack([few, few])), 12)


def test_choices_outside_the_limits_are_not_chosen() -> None:
    beyond = np.array(LIST)
    beyond[:5, 1] = np.radians(150.0)
    design = solve(problem(FOUR, OFFSET, choices=beyond), 8)
    assert np.all(design.plan.postures <= FOUR.upper)


def test_bad_input() -> None:
    with pytest.raises(InputError, match="ipopt cannot choose from a list"):
        solve(problem(FOUR, choices=LIST), 6, "ipopt")
    with pytest.raises(InputError, match="found none, allowed: with --candidates"):
        solve(problem(FOUR), 6, Fedorov())
    with pytest.raises(InputError, match=r"allowed: \(N, 4\)"):
        solve(problem(FOUR, choices=LIST[:, :3]), 6)
    with pytest.raises(InputError, match="0 of 18"):
        solve(problem(FOUR, choices=LIST + 10.0), 6)
