"""The prior against ridge regression, written from its closed form on a model that is linear in what is estimated."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import EffectSpec
from identification.errors import InputError
from identification.estimation.prior import Prior
from identification.estimation.problem import Problem, damped_gauss_newton
from identification.information import covariance, effective_count
from identification.measurements import Measurements
from identification.model import Model
from tests.identification.estimation.cases import LENGTHS, SIGMA, arm, plan

M = 12
DEVIATIONS = {"length_error:1": 0.3, "length_error:3": 0.05, "base_offset.x0": 0.02, "nowhere.else": 1.0}


def _linear_model() -> tuple[Model, np.ndarray]:
    """Known joint offsets leave lengths and base offset, in which the position is linear; (2 M, 6) its columns."""
    known = {f"joint_offset:{j}": 0.0 for j in range(1, 5)}
    theta = np.cumsum(plan(M), axis=1)
    links = np.stack([np.cos(theta), np.sin(theta)], axis=1)  # (M, 2, 4)
    base = np.tile(np.eye(2), (M, 1, 1))
    return Model(arm(EffectSpec("base_offset")), known), np.concatenate([links, base], axis=2).reshape(2 * M, 6)


def _measured(columns: np.ndarray) -> tuple[Measurements, np.ndarray]:
    """Data, and what is measured less what the nominal arm computes (2 M,)."""
    beyond = columns @ [0.4, -0.2, 0.1, 0.3, 0.05, -0.1] + SIGMA * np.random.default_rng(7).normal(size=2 * M)
    nominal = columns[:, :4] @ LENGTHS
    return Measurements(plan(M), (nominal + beyond).reshape(M, 2)), beyond


def _ridge(columns: np.ndarray, beyond: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the posterior."""
    precision = np.diag([0.3**-2, 0.0, 0.05**-2, 0.0, 0.02**-2, 0.0])
    inverse = np.linalg.inv(columns.T @ columns / sigma**2 + precision)
    return inverse @ columns.T @ beyond / sigma**2, inverse


def test_problem_with_a_prior_is_ridge_regression() -> None:
    model, columns = _linear_model()
    measurements, beyond = _measured(columns)
    plain, problem = (Problem.of(model, measurements, SIGMA, prior=prior) for prior in (None, Prior(DEVIATIONS)))
    found = damped_gauss_newton(problem).parameters[0]
    mean, posterior = _ridge(columns, beyond, SIGMA)
    np.testing.assert_allclose(found, mean, rtol=1e-9, atol=1e-12)
    _, jacobian = problem.linearize(found[None], np.arange(1))
    assert jacobian.shape == (1, 2 * M + 3, 6)
    np.testing.assert_allclose(covariance(jacobian[0], model.scales), posterior, rtol=1e-9, atol=1e-15)
    assert np.max(np.abs(damped_gauss_newton(plain).parameters[0] - mean)) > 0.01  # it does something


def test_effective_count_without_data_of_a_parameter() -> None:
    """One parameter known by the prior only, one by both equally, one by the data only: 0 + 1/2 + 1."""
    jacobian = np.diag([0.0, 2.0, 3.0])
    rows = np.array([[5.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert effective_count(jacobian, rows, np.ones(3)) == pytest.approx(1.5)


@pytest.mark.parametrize("deviation", [0.0, -1.0, np.inf, np.nan])
def test_wrong_deviation(deviation: float) -> None:
    with pytest.raises(InputError, match="prior: length_error:1 has standard deviation"):
        Prior({"length_error:1": deviation})
