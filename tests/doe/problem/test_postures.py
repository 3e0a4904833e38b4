"""Finite candidate sets: grids and lists, what constraints and limits drop."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from doe.problem.constraints import Expression
from doe.problem.postures import grid, listed_candidates, well_spread
from identification.errors import InputError
from tests.doe.arms import FOUR, OFFSET, problem


def above(least: float) -> Expression:
    """q_3 >= least."""
    return Expression(lambda q: q[2] - least, 4)


def test_grid_is_the_product_of_its_axes() -> None:
    made = grid(problem(FOUR), 3)
    axes = [np.linspace(a, b, 3) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    np.testing.assert_array_equal(made[:, 1:], list(product(*axes)))
    assert np.all(made[:, 0] == 0.0)  # q_1 plays no part
    every = grid(problem(FOUR, OFFSET), 5)
    assert len(every) == 5**4  # with a base offset q_1 matters
    for bound in (FOUR.lower, FOUR.upper):
        assert np.any(np.all(every == bound, axis=1))


def test_constraints_and_limits_drop_candidates() -> None:
    case = problem(FOUR, constraints=(above(0.1),))
    full = grid(problem(FOUR, OFFSET), 6)
    np.testing.assert_array_equal(grid(case, 6), full[full[:, 2] >= 0.1])  # all joints: constraints tie them
    listed = np.array([[0.0, 1.0, 0.5, 1.0], [0.0, 1.0, -0.5, 1.0], [0.0, 2.2, 0.5, 1.0]])
    np.testing.assert_array_equal(listed_candidates(case, listed), listed[:1])


def test_a_list_from_a_file_in_degrees_may_touch_the_limits() -> None:
    made = listed_candidates(problem(FOUR), [[0.0, FOUR.upper[1] + 4e-10, 0.0, FOUR.lower[3] - 4e-10]])
    assert len(made) == 1
    assert np.all((made >= FOUR.lower) & (made <= FOUR.upper))


def test_a_part_is_spread_and_has_limits_and_middles() -> None:
    full = grid(problem(FOUR), 21)
    some = well_spread(full, 100)
    assert 50 < len(some) <= 102
    corners = np.all((some[:, 1:] == FOUR.lower[1:]) | (some[:, 1:] == FOUR.upper[1:]), axis=1)
    assert np.count_nonzero(corners) == 8
    np.testing.assert_array_equal(well_spread(full[:50], 100), full[:50])


def test_bad_input() -> None:
    case = problem(FOUR)
    with pytest.raises(InputError, match="at least 2"):
        grid(case, 1)
    with pytest.raises(InputError, match="2 to 256, which are 16,777,216 candidates at most"):
        grid(case, 500)
    with pytest.raises(InputError, match=r"allowed: \(N, 4\)"):
        listed_candidates(case, np.zeros((3, 5)))
    with pytest.raises(InputError, match="row 2"):
        listed_candidates(case, np.array([[0.0] * 4, [np.nan] * 4]))
    with pytest.raises(InputError, match="0 of 2"):
        listed_candidates(case, np.full((2, 4), 3.1))
    with pytest.raises(InputError, match="0 of "):
        grid(problem(FOUR, constraints=(above(9.0),)), 3)
