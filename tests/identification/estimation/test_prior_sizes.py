"""The likelihood of a prior's sizes, by whichever products of matrices it is computed, against dense covariances."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import null_space

from identification.estimation.prior_sizes import Effects

Array = NDArray[np.float64]
SHARES = (1.0, 0.25)
NOISES = np.array([0.2, 0.7, 3.0])


def problem(rows: int, several: bool) -> tuple[Array, Array, Array, Array]:
    """(N,) residuals and a (N, 9) Jacobian, both orthogonal to two columns without a prior, the factor (9, 7) of the
    prior's covariance, each column of one parameter or the last two of two (`several`), and the two columns."""
    generator = np.random.default_rng([3, rows, several])
    factor = np.zeros((9, 7))
    factor[np.arange(2, 9), np.arange(7)] = generator.uniform(0.3, 2.0, 7)
    if several:
        factor[7, 6] = 0.4
    free = generator.standard_normal((rows, 2))
    outside = null_space(free.T) @ null_space(free.T).T
    jacobian, noise = generator.standard_normal((rows, 9)), generator.standard_normal(rows)
    return outside @ (jacobian @ factor @ generator.standard_normal(7) + noise), outside @ jacobian, factor, free


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize("rows", [6, 40])
def test_likelihood_is_that_of_dense_matrices(rows: int, several: bool, share: float) -> None:
    """-2 log of the normal density of what is orthogonal to the columns without a prior, where effects and residuals of
    all rows stand for a share of their squares; directions that this leaves no equations for are noise alone."""
    target, jacobian, factor, free = problem(rows, several)
    sizes = np.random.default_rng(9).uniform(0.5, 4.0, 9)
    spare = max(round(share * (rows - 2)), 7 if rows > 7 else rows - 2)
    found = Effects.of(target, jacobian, factor).restricted(sizes, share, spare)
    basis = null_space(free.T)
    effects = np.sqrt(share) * basis.T @ (jacobian * sizes) @ factor
    left = np.sqrt(share) * basis.T @ target
    for noise, value in zip(NOISES, found.minus_log(NOISES, np.ones(3)), strict=True):
        covariance = effects @ effects.T + noise**2 * np.eye(rows - 2)
        log_det = np.linalg.slogdet(covariance)[1] + (spare - (rows - 2)) * 2.0 * np.log(noise)
        assert value == pytest.approx(log_det + left @ np.linalg.solve(covariance, left), rel=1e-10)


def test_products_are_made_once_where_effects_are_fewer_than_residuals() -> None:
    few, many = (Effects.of(*problem(rows, several=False)[:3]) for rows in (40, 6))
    assert few.normal is not None
    assert few.normal == pytest.approx(few.effects.T @ few.effects)
    assert many.normal is None
    assert Effects.of(*problem(40, several=True)[:3]).own is None  # a column of two parameters has no one factor
