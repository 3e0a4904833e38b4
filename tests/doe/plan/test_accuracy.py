"""Expected deviations, against the closed forms of an optimal plan and against simulated least squares."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from doe.bounds.certificate import Bound
from doe.design import score
from doe.plan.accuracy import error_at_poses, expected_deviations
from doe.problem.uncertain import average_error
from identification.arm import Arm
from identification.model import Model
from tests.doe.arms import ECCENTRICITY, FOUR, OFFSET, problem


def fourier(runs: int, links: int) -> np.ndarray:
    return np.diff(2 * np.pi * np.outer(np.arange(runs), np.arange(1, links + 1)) / runs, axis=1, prepend=0.0)


@pytest.mark.parametrize("runs", [4, 20])
def test_optimal_plan(runs: int) -> None:
    sigma = 0.1
    arm = Arm(FOUR.lengths, sigma=sigma)
    found = expected_deviations(problem(arm), fourier(runs, 4))
    assert found is not None
    lengths = arm.lengths
    np.testing.assert_allclose(found.length, sigma / np.sqrt(runs))  # eq. 24, corrected
    np.testing.assert_allclose(found.orientation, sigma / np.sqrt(runs) / lengths)
    # identification/README.md, "Covariance and intervals"
    offsets = np.r_[1 / lengths[0], np.hypot(1 / lengths[1:], 1 / lengths[:-1])]
    np.testing.assert_allclose(found.joint_offset, sigma / np.sqrt(runs) * offsets)


def test_the_papers_table() -> None:
    found = expected_deviations(problem(Arm(FOUR.lengths, sigma=0.1)), fourier(20, 4))
    assert found is not None
    np.testing.assert_allclose(found.length, 0.022, atol=5e-4)  # Table III, 20 points, to its printed digits
    np.testing.assert_allclose(np.degrees(found.orientation), [0.005, 0.007, 0.011, 0.013], atol=5e-4)


def test_agrees_with_simulated_least_squares_on_any_plan() -> None:
    generator = np.random.default_rng(5)
    plan = generator.uniform(FOUR.lower, FOUR.upper, (9, 4))
    case = problem(FOUR, OFFSET)
    jacobian = case.model.jacobian(plan).reshape(18, 10)
    estimates = (np.linalg.pinv(jacobian) @ generator.normal(0.0, 0.1, (18, 20_000))).T
    offsets = estimates[:, 4:8]
    found = expected_deviations(case, plan)
    assert found is not None
    # relative standard error of a standard deviation from 20,000 samples is 0.5 %; alert 3, fail 6 of it
    np.testing.assert_allclose(found.length, estimates[:, :4].std(axis=0), rtol=0.03)
    np.testing.assert_allclose(found.joint_offset, offsets.std(axis=0), rtol=0.03)
    np.testing.assert_allclose(found.orientation, np.cumsum(offsets, axis=1).std(axis=0), rtol=0.03)


def test_value_of_criterion_i_in_mm() -> None:
    """Root mean over poses of tr(J cov J^T), from unscaled Jacobians of new and measured postures."""
    generator = np.random.default_rng(8)
    plan, kept, poses = (generator.uniform(FOUR.lower, FOUR.upper, (k, 4)) for k in (9, 3, 50))
    plain = problem(FOUR, kept=kept)
    case = replace(plain, criterion=average_error(plain, poses))
    rows = case.model.jacobian(np.concatenate([plan, kept])).reshape(24, 8)
    covariance = 0.1**2 * np.linalg.inv(rows.T @ rows)
    at = case.model.jacobian(poses).reshape(50, 2, 8)
    expected = np.sqrt(np.mean([np.trace(j @ covariance @ j.T) for j in at]))
    found = score(case, plan, Bound(case.objective(plan), "grid")).expected_error
    assert found == pytest.approx({"plan": expected, "bound": expected}, rel=1e-9)
    assert error_at_poses(plain, -1.0, 9) is None  # criterion D
    assert error_at_poses(case, -np.inf, 9) is None
    assert score(plain, plan).to_json()["expected_error_mm"] is None


def test_none_without_sigma_or_enough_runs() -> None:
    assert expected_deviations(problem(Arm(FOUR.lengths)), fourier(4, 4)) is None
    assert expected_deviations(problem(FOUR), np.zeros((4, 4))) is None


def test_zero_for_what_is_known() -> None:
    model = Model(FOUR, held={"length_error:2": 0.0, "joint_offset:1": 0.0})
    from doe.problem.problem import DesignProblem

    found = expected_deviations(DesignProblem.of(model), fourier(8, 4))
    assert found is not None
    assert found.length[1] == 0.0
    assert found.joint_offset[0] == 0.0
    assert np.all(found.length[[0, 2, 3]] > 0.0)
    assert np.all(found.joint_offset[1:] > 0.0)


def test_measured_postures_help() -> None:
    kept = np.random.default_rng(0).uniform(FOUR.lower, FOUR.upper, (6, 4))
    plan = fourier(8, 4)
    together = expected_deviations(problem(FOUR), np.vstack([plan, kept]))
    apart = expected_deviations(problem(FOUR, kept=kept), plan)
    assert together is not None
    assert apart is not None
    np.testing.assert_allclose(apart.length, together.length)


def test_weights_share_the_runs_out() -> None:
    plan = np.random.default_rng(1).uniform(FOUR.lower, FOUR.upper, (6, 4))
    weights = np.array([3, 1, 1, 1, 1, 1]) / 8
    shared = expected_deviations(problem(FOUR), plan, weights)
    repeated = expected_deviations(problem(FOUR), plan[[0, 0, 0, 1, 2, 3, 4, 5]])
    assert shared is not None
    assert repeated is not None
    # six runs instead of eight, shared out in the same way
    np.testing.assert_allclose(shared.length, repeated.length * np.sqrt(8 / 6))
    np.testing.assert_allclose(shared.joint_offset, repeated.joint_offset * np.sqrt(8 / 6))


def test_none_where_only_rounding_makes_the_information_regular() -> None:
    # two angles half a turn apart tell an eccentric encoder from a joint offset by rounding only, yet numpy inverts M
    half_turn = (-1.2, np.pi - 1.2)
    plan = np.array(list(product((-1.0, 1.0), half_turn, (-1.0, 1.0), (-1.0, 0.5))))
    assert expected_deviations(problem(Arm(FOUR.lengths, sigma=0.1), ECCENTRICITY), plan) is None
    assert expected_deviations(problem(Arm(FOUR.lengths, sigma=0.1)), plan) is not None
