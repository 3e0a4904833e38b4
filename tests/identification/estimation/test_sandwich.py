"""The clustered sandwich against textbook formulas, dense matrices from the definition, and exact expectations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import sqrtm

from identification.estimation.uncertainty import sandwich

GROUPS = np.array([0, 0, 0, 1, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5, 6, 7])  # of 16 rows, of different sizes


def problem(seed: int = 0, d: int = 2, p: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(m, d, p) Jacobian, (m, d) residuals of a fit and (p, p) root of the covariance (not triangular, any will do)."""
    rng = np.random.default_rng(seed)
    jacobian = rng.standard_normal((len(GROUPS), d, p))
    flat = jacobian.reshape(-1, p)
    hat = flat @ np.linalg.pinv(flat)
    residual = (np.eye(len(flat)) - hat) @ rng.standard_normal(len(flat))
    return jacobian, residual.reshape(-1, d), np.linalg.cholesky(np.linalg.inv(flat.T @ flat))


def dense(jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance and degrees of freedom from the definition, with (N, N) matrices."""
    m, d, p = jacobian.shape
    j, e, member = jacobian.reshape(-1, p), residual.reshape(-1), np.repeat(GROUPS, d)
    bread = np.linalg.inv(j.T @ j)
    rest = np.eye(m * d) - j @ bread @ j.T
    added, products = [], []
    for g in range(GROUPS.max() + 1):
        own = member == g
        root = np.linalg.inv(np.real(sqrtm(rest[np.ix_(own, own)])))
        added.append(bread @ j[own].T @ root @ e[own])
        products.append(rest[:, own] @ root @ j[own] @ bread)  # (N, p): column k is P_g of parameter k
    freedom = []
    for k in range(p):
        rows = np.stack([one[:, k] for one in products])
        values = np.linalg.eigvalsh(rows @ rows.T)
        freedom.append(values.sum() ** 2 / np.sum(values**2))
    return np.stack(added).T @ np.stack(added), np.array(freedom)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_equals_the_definition(d: int) -> None:
    jacobian, residual, root = problem(d, d)
    found = sandwich(jacobian, residual, root, GROUPS)
    assert found is not None
    covariance, freedom = dense(jacobian, residual)
    np.testing.assert_allclose(found.covariance, covariance, rtol=1e-9)
    np.testing.assert_allclose(found.freedom, freedom, rtol=1e-9)


def with_prior(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(m, d, p) Jacobian, (2, p) rows of a prior of two combinations, and root of the posterior covariance."""
    jacobian, _, _ = problem(seed)
    rows = np.random.default_rng(seed + 1).standard_normal((2, 3)) * 3.0
    flat = jacobian.reshape(-1, 3)
    return jacobian, rows, np.linalg.cholesky(np.linalg.inv(flat.T @ flat + rows.T @ rows))


def test_with_a_prior_it_is_the_covariance_of_the_errors_if_the_model_is_complete() -> None:
    """The mean over white noise and over values drawn from the prior, exactly, is the posterior covariance, of whatever
    size the noise is; and the degrees of freedom are those of the matrix of the quadratic form."""
    jacobian, rows, root = with_prior(8)
    flat, (m, d, p) = np.concatenate([jacobian.reshape(-1, 3), rows]), jacobian.shape
    bread = np.linalg.inv(flat.T @ flat)
    rest, total = np.eye(len(flat)) - flat @ bread @ flat.T, np.zeros((p, p))
    fixed = bread @ rows.T @ rows @ bread  # what the prior's own errors add
    for column in rest.T:  # residuals of the data after a fit to one error of one, of the data or of the prior
        found = sandwich(jacobian, 0.2 * column[: m * d].reshape(-1, d), root, GROUPS, 0.04)
        assert found is not None
        total += found.covariance - 0.04 * fixed
    np.testing.assert_allclose(total + 0.04 * fixed, 0.04 * bread, rtol=1e-9)
    added = np.zeros((p, len(flat), GROUPS.max() + 1))
    for g in range(GROUPS.max() + 1):
        own = np.flatnonzero(np.repeat(GROUPS, d) == g)
        half = np.linalg.inv(np.real(sqrtm(rest[np.ix_(own, own)])))
        added[:, :, g] = (rest[:, own] @ half @ flat[own] @ bread).T
    for k in range(p):
        values = np.linalg.eigvalsh(added[k].T @ added[k])
        assert found.freedom[k] == pytest.approx((values.sum() + fixed[k, k]) ** 2 / np.sum(values**2), rel=1e-9)


def test_of_two_means_it_is_welch() -> None:
    """A constant and a difference between two samples of 5 and 12: their variances add (Welch)."""
    rng = np.random.default_rng(7)
    one, two = rng.standard_normal(5), 9.0 * rng.standard_normal(12)
    columns = np.column_stack([np.ones(17), np.repeat([0.0, 1.0], [5, 12])])
    residual = np.r_[one - one.mean(), two - two.mean()]
    root = np.linalg.cholesky(np.linalg.inv(columns.T @ columns))
    found = sandwich(columns[:, None, :], residual[:, None], root, np.arange(17))
    assert found is not None
    variances = np.array([np.var(one, ddof=1) / 5.0, np.var(two, ddof=1) / 12.0])
    assert found.covariance[1, 1] == pytest.approx(variances.sum())
    assert found.covariance[0, 0] == pytest.approx(variances[0])
    # degrees of freedom under equal variances
    shares = np.array([1.0 / 5.0, 1.0 / 12.0])
    assert found.freedom[1] == pytest.approx(shares.sum() ** 2 / np.sum(shares**2 / np.array([4.0, 11.0])))
    assert found.freedom[0] == pytest.approx(4.0)


def test_a_group_that_alone_determines_a_parameter_gives_none() -> None:
    jacobian = np.concatenate([np.ones((5, 1, 1)), np.zeros((5, 1, 1))], axis=2)
    jacobian[0, 0, 1] = 1.0
    root = np.linalg.cholesky(np.linalg.inv(jacobian[:, 0].T @ jacobian[:, 0]))
    assert sandwich(jacobian, np.zeros((5, 1)), root, np.arange(5)) is None
