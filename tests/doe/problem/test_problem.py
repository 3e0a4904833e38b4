"""What is known before the new runs enters every information matrix: against the mean over all rows."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from doe.problem.constraints import Expression
from doe.problem.postures import grid, listed_candidates, well_spread
from doe.problem.problem import PriorInformation
from identification import InputError
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem


def test_information_with_measured_postures_is_the_information_of_all_runs() -> None:
    """k kept and m new runs: M of the weighted plan equals the mean over all k + m rows."""
    generator = np.random.default_rng(0)
    kept, new = generator.uniform(FOUR.lower, FOUR.upper, (2, 5, 4))
    case = problem(FOUR, OFFSET, ECCENTRICITY, kept=kept)
    prior = case.prior.per_new_run(10)
    weights = np.array([0.1, 0.2, 0.3, 0.3, 0.1])  # ten runs: 1, 2, 3, 3, 1
    rows = np.concatenate([kept, np.repeat(new, [1, 2, 3, 3, 1], axis=0)])
    expected = problem(FOUR, OFFSET, ECCENTRICITY).information(rows)
    information = prior.mixture(case.scaled_jacobians(new), weights)
    assert information == pytest.approx(expected, rel=1e-12, abs=1e-12)
    gradient = np.linalg.inv(information)
    jacobians = case.scaled_jacobians(new)
    g = prior.sensitivities(jacobians, gradient)
    assert weights @ g == pytest.approx(case.parameters, abs=1e-9)  # tr(G M) = p
    assert g == pytest.approx(
        [np.sum(gradient * f) for f in prior.information(np.swapaxes(jacobians, 1, 2) @ jacobians)], rel=1e-12
    )


def test_measured_postures_need_the_number_of_runs() -> None:
    case = problem(FOUR, kept=np.zeros((2, 4)))
    for runs in (None, 0):
        with pytest.raises(InputError, match="runs"):
            case.prior.per_new_run(runs)


def test_a_prior_without_runs_adds_to_the_sum_and_leaves_the_number_of_runs() -> None:
    """A calibration's covariance C, as it would be added: inverse of C times sigma^2, no run of this plan."""
    case = problem(FOUR, OFFSET)
    jacobians = case.scaled_jacobians(np.random.default_rng(2).uniform(FOUR.lower, FOUR.upper, (5, 4)))
    known = 3.0 * np.eye(case.parameters)
    total = sum(b.T @ b for b in jacobians)
    prior = PriorInformation(known)
    assert not prior.empty
    assert prior.information(total, 5) == pytest.approx((total + known) / 5, rel=1e-12, abs=1e-12)
    assert prior.per_new_run(5).mixture(jacobians, np.full(5, 0.2)) == pytest.approx(
        (total + known) / 5, rel=1e-12, abs=1e-12
    )


# -- grids and lists ---------------------------------------------------------------------------------------------------
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
    with pytest.raises(InputError, match=r"^criterion: 'A', allowed: an object with value\(\)"):
        replace(case, criterion="A")  # type: ignore[arg-type]
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
