"""The marginal likelihood of penalized columns against normal distributions written out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from identification.gap.curves.curve_fit import SPACING, Basis, Penalized, bases_of

RNG = np.random.default_rng(8)
ANGLES = RNG.uniform(-1.0, 1.5, (40, 2))
BASES = tuple(Basis(j, *(ANGLES[:, j].min(), ANGLES[:, j].max()), 12 + j) for j in range(2))
FLAT = RNG.normal(size=(40, 3))
COLUMNS = np.concatenate([b.at(ANGLES[:, b.joint]) for b in BASES], axis=1) * RNG.uniform(50.0, 150.0, (40, 1))
MEASURED = RNG.normal(size=40) + 3.0 * np.sin(5.0 * ANGLES[:, 0])
LOGS = np.log([0.02, 0.3, 0.01, 0.8])


def _problem(flat: np.ndarray = FLAT) -> Penalized:
    basis = np.linalg.qr(flat)[0]
    off = np.eye(len(flat)) - basis @ basis.T
    return Penalized(BASES, off @ COLUMNS, off @ MEASURED, len(flat) - flat.shape[1])


def _oracle(logs: np.ndarray) -> float:
    """-2 log of the restricted likelihood, noise integrated out: y' (S^-1 - S^-1 F (F' S^-1 F)^-1 F' S^-1) y."""
    variances = np.concatenate([b.variances(*np.exp(p))[0] for b, p in zip(BASES, logs.reshape(2, 2), strict=True)])
    inverse = np.linalg.inv(np.eye(40) + COLUMNS * variances @ COLUMNS.T)
    flat = FLAT.T @ inverse @ FLAT
    left = MEASURED @ (inverse - inverse @ FLAT @ np.linalg.inv(flat) @ FLAT.T @ inverse) @ MEASURED
    determinants = np.linalg.slogdet(inverse)[1] - np.linalg.slogdet(flat)[1] + np.linalg.slogdet(FLAT.T @ FLAT)[1]
    return float(37.0 * np.log(left / 37.0) - determinants)


def test_cost_is_the_restricted_likelihood() -> None:
    for logs in (LOGS, LOGS + np.array([0.5, -0.3, -2.0, 0.4])):
        assert _problem().evidence(logs).cost == pytest.approx(_oracle(logs), rel=1e-10)


def test_slope_is_the_derivative() -> None:
    numeric = approx_fprime(LOGS, _oracle, 1e-6)
    np.testing.assert_allclose(_problem().evidence(LOGS).slope, numeric, rtol=1e-4, atol=1e-4)


def test_coefficients_and_covariance_are_the_posterior() -> None:
    variances = np.concatenate([b.variances(*np.exp(p))[0] for b, p in zip(BASES, LOGS.reshape(2, 2), strict=True)])
    both = np.concatenate([FLAT, COLUMNS], axis=1)
    inverse = np.linalg.inv(both.T @ both + np.diag(np.r_[np.zeros(3), 1.0 / variances]))
    found = _problem().evidence(LOGS)
    np.testing.assert_allclose(found.coefficients, (inverse @ both.T @ MEASURED)[3:], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.covariance, inverse[3:, 3:], rtol=1e-7, atol=1e-14)
    assert found.effective == pytest.approx(np.trace(both @ inverse @ both.T) - 3.0)


def test_few_rows_give_the_same_by_the_other_formula() -> None:
    few = Penalized(BASES, COLUMNS[:20], MEASURED[:20], 20)
    by_rows = few._by_rows(np.full(25, 1e-3))
    by_columns = few._by_columns(np.full(25, 1e-3))
    for part in ("coefficients", "variances", "covariance", "log_shrunk"):
        np.testing.assert_allclose(getattr(by_rows, part), getattr(by_columns, part), rtol=1e-8, atol=1e-12)


def test_best_is_a_maximum() -> None:
    logs, found = _problem().best()
    inside = np.abs(found.slope) < 1e-3  # the shortest length may be a bound
    assert inside.sum() >= 2
    for k in range(4):
        for step in (-0.05, 0.05) if inside[k] else (-0.05 * np.sign(found.slope[k]) * -1.0,):
            moved = logs.copy()
            moved[k] += step
            assert _oracle(moved) > found.cost


def test_cosines_are_orthonormal_and_variances_have_their_mean() -> None:
    basis = BASES[0]
    np.testing.assert_allclose(basis.cosines.T @ basis.cosines, np.eye(12), atol=1e-13)
    variances, slope = basis.variances(0.3, 0.7)
    assert variances.mean() == pytest.approx(0.09)
    numeric = (basis.variances(0.3, 0.7 * np.exp(1e-6))[0] - basis.variances(0.3, 0.7 * np.exp(-1e-6))[0]) / 2e-6
    np.testing.assert_allclose(slope, numeric, rtol=1e-6, atol=1e-12)


def test_curve_of_coefficients_is_what_the_basis_computes() -> None:
    coefficients = RNG.normal(size=12)
    curve, q = BASES[0].curve(coefficients), np.linspace(-1.2, 1.7, 300)
    np.testing.assert_allclose(curve.at(q), BASES[0].at(q) @ coefficients, atol=1e-12)


def test_nodes_follow_the_range() -> None:
    """Joints that stand still have none; a range of 100 degrees has one each two degrees, and one at the end."""
    postures = np.column_stack([np.linspace(0.0, np.radians(100.0), 9), np.zeros(9)])
    (basis,) = bases_of(postures, [0, 1])
    assert (basis.joint, basis.count) == (0, 51)
    assert basis.spacing == pytest.approx(SPACING)
    many = np.tile(np.linspace(-np.pi, np.pi, 9)[:, None], (1, 6))
    assert 720 <= sum(b.count for b in bases_of(many, range(6))) <= 726
