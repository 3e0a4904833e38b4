"""What is known before the new runs enters every information matrix: against the mean over all rows."""

from __future__ import annotations

import numpy as np
import pytest

from doe.problem.problem import PriorInformation
from identification.errors import InputError
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
    assert g == pytest.approx([np.sum(gradient * f) for f in prior.posture_information(jacobians)], rel=1e-12)


def test_measured_postures_need_the_number_of_runs() -> None:
    case = problem(FOUR, kept=np.zeros((2, 4)))
    for runs in (None, 0):
        with pytest.raises(InputError, match="runs"):
            case.prior.per_new_run(runs)


def test_no_measured_postures_are_an_empty_array_and_tell_nothing() -> None:
    new = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (6, 4))
    for kept in (None, np.empty((0, 4)), []):
        case = problem(FOUR, kept=kept)
        assert case.kept.shape == (0, 4)
        assert case.prior.empty
        assert case.prior.per_new_run(None) is case.prior
        assert np.array_equal(case.information(new), problem(FOUR).information(new))
    with pytest.raises(InputError, match=r"kept: shape \(2, 3\), allowed: \(k, 4\)"):
        problem(FOUR, kept=np.zeros((2, 3)))


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
