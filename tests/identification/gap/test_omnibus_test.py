"""The wild bootstrap: its parts by algebra, its level by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import sqrtm

from identification.gap.f_tests import dictionary
from identification.gap.omnibus_test import leverage_corrected, omnibus_test, wild_draws
from identification.information import column_space


def basis(jacobian: np.ndarray) -> np.ndarray:
    return column_space(jacobian, np.ones(jacobian.shape[1]))


@pytest.mark.parametrize("d", [2, 3])
def test_leverage_correction_is_the_inverse_square_root_of_each_block(d: int) -> None:
    rng = np.random.default_rng(1)
    jacobian, residual = rng.normal(size=(10 * d, 5)), rng.normal(size=10 * d)
    hat = jacobian @ np.linalg.inv(jacobian.T @ jacobian) @ jacobian.T
    corrected = leverage_corrected(residual, basis(jacobian), d)
    for i in range(10):
        own = slice(d * i, d * i + d)
        block = np.eye(d) - hat[own, own]
        np.testing.assert_allclose(corrected[i], np.linalg.inv(sqrtm(block).real) @ residual[own])


def test_draws_are_orthogonal_to_the_model_and_keep_each_postures_direction() -> None:
    rng = np.random.default_rng(2)
    jacobian, residual = rng.normal(size=(12, 3)), rng.normal(size=12)
    q = basis(jacobian)
    drawn = wild_draws(residual, q, q, 2, 50, rng)
    np.testing.assert_allclose(q.T @ drawn, 0.0, atol=1e-12)
    corrected = leverage_corrected(residual, q, 2).ravel()
    project = np.eye(12) - q @ q.T
    # every draw is the projection of the corrected residuals with one sign per posture
    for b in range(50):
        signs = [np.repeat(1.0 - 2.0 * np.array(list(f"{k:06b}"), dtype=float), 2) for k in range(64)]
        distance = min(np.abs(project @ (corrected * s) - drawn[:, b]).max() for s in signs)
        assert distance < 1e-10


def _rejections(scale: np.ndarray, sets: int) -> float:
    """Fraction of null data sets that the test rejects at 5 %, with noise of the given size per posture."""
    rng = np.random.default_rng(3)
    count = 0
    for _ in range(sets):
        jacobian = rng.normal(size=(60, 6)) * np.repeat(scale, 2)[:, None]  # leverage and noise grow together
        columns = [rng.normal(size=(60, d)) * np.repeat(scale, 2)[:, None] for d in (1, 1, 1, 2, 2, 2, 4)]
        tested = dictionary(basis(jacobian), columns, np.zeros(7, dtype=bool), np.ones(7))
        noise = rng.normal(size=60) * np.repeat(scale, 2)
        residual = noise - tested.model_basis @ (tested.model_basis.T @ noise)
        count += omnibus_test(residual, tested, 2, 199, rng).smallest <= 0.05
    return count / sets


def test_level_holds_for_equal_and_for_unequal_noise() -> None:
    # 400 sets at a true level of 0.05: standard error 0.011; fail beyond 4.5 of them
    assert _rejections(np.ones(30), 400) < 0.10
    # noise that is 4 times larger where leverage is: the plain F test gives 0.2 or more here
    assert _rejections(np.linspace(0.5, 2.0, 30), 400) < 0.10


def test_a_clear_effect_is_significant() -> None:
    rng = np.random.default_rng(4)
    jacobian, columns = rng.normal(size=(60, 6)), [rng.normal(size=(60, 1)) for _ in range(8)]
    tested = dictionary(basis(jacobian), columns, np.zeros(8, dtype=bool), np.ones(8))
    y = rng.normal(size=60) + 8.0 * columns[5][:, 0] / np.linalg.norm(columns[5])
    result = omnibus_test(y - tested.model_basis @ (tested.model_basis.T @ y), tested, 2, 499, rng)
    assert int(np.argmin(result.p)) == 5
    assert result.smallest <= 0.01
