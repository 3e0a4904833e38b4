"""Finite candidate sets: grids that are never made whole, lists, what constraints and limits drop."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import casadi as ca
import numpy as np
import pytest

from doe.problem.postures import Grid, PostureList, chunks, grid, listed_candidates, well_spread
from identification.arrays import Array
from identification.errors import InputError
from tests.doe.arms import FOUR, OFFSET, problem


@dataclass(frozen=True)
class Halfplane:
    """q_j >= least."""

    joint: int
    least: float
    kind: str = "halfplane"

    def margin(self, postures: Array) -> Array:
        return postures[:, self.joint : self.joint + 1] - self.least

    def symbolic(self, q: ca.SX) -> ca.SX:
        return q[self.joint] - self.least


def everything(candidates: Grid | PostureList) -> Array:
    return np.concatenate([postures for _, postures in chunks(candidates, 7)])


def test_grid_is_the_product_of_its_axes() -> None:
    case = problem(FOUR)
    made = grid(case, 3)
    assert len(made) == 27  # q_1 plays no part
    axes = [np.linspace(a, b, 3) for a, b in zip(FOUR.lower[1:], FOUR.upper[1:], strict=True)]
    assert everything(made)[:, 1:] == pytest.approx(np.array(list(product(*axes))), abs=0.0)
    assert np.all(everything(made)[:, 0] == 0.0)


@pytest.mark.parametrize("levels", [2, 5, 8])
def test_axes_contain_the_limits_exactly(levels: int) -> None:
    made = everything(grid(problem(FOUR, OFFSET), levels))
    assert len(made) == levels**4  # with a base offset q_1 matters
    for bound in (FOUR.lower, FOUR.upper):
        assert np.any(np.all(made == bound, axis=1))


def test_constraints_drop_candidates() -> None:
    case = problem(FOUR, constraints=(Halfplane(2, 0.1),))
    made = grid(case, 6)
    full = everything(Grid(made.axes))
    expected = full[full[:, 2] >= 0.1]
    assert len(made) == len(expected)
    assert made.dropped == len(full) - len(expected)
    assert everything(made) == pytest.approx(expected, abs=0.0)
    assert made.take(np.array([3, 1])) == pytest.approx(expected[[3, 1]], abs=0.0)


def test_a_list_loses_what_is_not_allowed() -> None:
    case = problem(FOUR, constraints=(Halfplane(2, 0.1),))
    inside, low, beyond = np.array([[0.0, 1.0, 0.5, 1.0], [0.0, 1.0, -0.5, 1.0], [0.0, 2.2, 0.5, 1.0]])
    made = listed_candidates(case, np.stack([inside, low, beyond]))
    assert made.postures == pytest.approx(inside[None], abs=0.0)
    assert made.dropped == 2


def test_a_list_from_a_file_in_degrees_may_touch_the_limits() -> None:
    at_limit = np.array([[0.0, FOUR.upper[1] + 4e-10, 0.0, FOUR.lower[3] - 4e-10]])
    made = listed_candidates(problem(FOUR), at_limit)
    assert len(made) == 1
    assert np.all((made.postures >= FOUR.lower) & (made.postures <= FOUR.upper))


def test_bad_input() -> None:
    case = problem(FOUR)
    with pytest.raises(InputError, match="at least 2"):
        grid(case, 1)
    with pytest.raises(InputError, match=r"allowed: \(N, 4\)"):
        listed_candidates(case, np.zeros((3, 5)))
    with pytest.raises(InputError, match="row 2"):
        listed_candidates(case, np.array([[0.0] * 4, [np.nan] * 4]))
    with pytest.raises(InputError, match="0 of 2"):
        listed_candidates(case, np.full((2, 4), 3.1))
    with pytest.raises(InputError, match="0 of "):
        grid(problem(FOUR, constraints=(Halfplane(2, 9.0),)), 3)


def test_a_hundred_million_candidates_take_no_memory() -> None:
    made = grid(problem(FOUR), 465)
    assert len(made) == 465**3
    last = made.take(np.array([len(made) - 1]))[0]
    assert last[1:] == pytest.approx(FOUR.upper[1:], abs=0.0)
    some = well_spread(made, 100)
    assert 50 < len(some) <= 102
    assert np.all((some >= FOUR.lower) & (some <= FOUR.upper))
