"""The wild bootstrap: its parts by algebra, its level by simulation."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from scipy.linalg import sqrtm

from identification.gap.hypotheses.f_tests import Columns, Dictionary, dictionary
from identification.gap.hypotheses.omnibus_test import Draws, leverage_corrected, omnibus_test, wild_draws
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


def beside(jacobian: np.ndarray, columns: list[np.ndarray]) -> Dictionary:
    count = len(columns)
    return dictionary(basis(jacobian), Columns.of(columns, len(jacobian)), np.zeros(count, dtype=bool), np.ones(count))


def joined(parts: Iterable[Draws]) -> Draws:
    """All draws, of more than one part."""
    listed = list(parts)
    return Draws(*(np.concatenate(arrays, axis=-1) for arrays in zip(*listed, strict=True)))


def _scores(tested: Dictionary, drawn: np.ndarray) -> np.ndarray:
    """Of vectors (N, B), from the bases themselves."""
    return np.vstack([tested.block(k).T @ drawn for k in range(len(tested))])


def test_wild_draws_are_projected_residuals_with_one_sign_per_posture() -> None:
    rng = np.random.default_rng(2)
    jacobian, residual = rng.normal(size=(12, 3)), rng.normal(size=12)
    tested = beside(jacobian, [rng.normal(size=(12, d)) for d in (1, 2)])
    q = basis(jacobian)
    corrected = leverage_corrected(residual, q, 2)
    drawn = joined(wild_draws(corrected, tested, 50, rng))
    every = np.array([1.0 - 2.0 * np.array(list(f"{k:06b}"), dtype=float) for k in range(64)])  # (64, postures)
    flipped = corrected.ravel()[:, None] * np.repeat(every, 2, axis=1).T
    flipped -= q @ (q.T @ flipped)
    possible = np.vstack([_scores(tested, flipped), np.square(flipped).sum(axis=0)])
    for column in np.vstack([drawn.scores, drawn.squares]).T:
        assert np.abs(possible - column[:, None]).max(axis=0).min() < 1e-10


def test_of_many_postures_the_scores_are_normal_with_the_covariance_of_the_sign_flips(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """1,000 postures, noise four times larger at some: quantiles of the smallest p-value of both ways to draw agree.

    Empirical probabilities of 4000 draws each: standard error sqrt(2 p (1 - p) / 4000); within 4 of them.
    """
    rng = np.random.default_rng(6)
    scale = np.repeat(np.linspace(0.5, 2.0, 1000), 2)[:, None]
    tested = beside(rng.normal(size=(2000, 6)), [scale * rng.normal(size=(2000, 1 + k % 2)) for k in range(20)])
    corrected = (scale[:, 0] * rng.normal(size=2000)).reshape(1000, 2)
    normal = joined(wild_draws(corrected, tested, 4000, rng))
    monkeypatch.setattr("identification.gap.hypotheses.omnibus_test.MANY", 1001)
    flips = joined(wild_draws(corrected, tested, 4000, rng))
    smallest = [tested.smallest_weighted(d.scores, d.squares) for d in (normal, flips)]
    for p in (0.01, 0.05, 0.2, 0.5):
        limit = np.quantile(smallest[1], p)
        assert abs(np.mean(smallest[0] <= limit) - p) < 4.0 * np.sqrt(2.0 * p * (1.0 - p) / 4000)
    assert np.mean(normal.squares) == pytest.approx(np.mean(flips.squares), rel=1e-4)


def _rejections(scale: np.ndarray, sets: int) -> float:
    """Fraction of null data sets that the test rejects at 5 %, with noise of the given size per posture."""
    rng = np.random.default_rng(3)
    count = 0
    for _ in range(sets):
        jacobian = rng.normal(size=(60, 6)) * np.repeat(scale, 2)[:, None]  # leverage and noise grow together
        columns = [rng.normal(size=(60, d)) * np.repeat(scale, 2)[:, None] for d in (1, 1, 1, 2, 2, 2, 4)]
        tested = beside(jacobian, columns)
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
    tested = beside(jacobian, columns)
    y = rng.normal(size=60) + 8.0 * columns[5][:, 0] / np.linalg.norm(columns[5])
    result = omnibus_test(y - tested.model_basis @ (tested.model_basis.T @ y), tested, 2, 499, rng)
    assert int(np.argmin(result.p)) == 5
    assert result.smallest <= 0.01
