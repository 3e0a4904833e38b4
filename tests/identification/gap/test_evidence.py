"""Marginal likelihoods of blocks against covariances of all rows, quadrature over sigma, and least squares."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gammaln, logsumexp
from scipy.stats import norm

from identification.gap.evidence import SIZES, Products

N, WIDTHS = 30, (1, 2, 1, 3, 7)
STARTS = np.concatenate([[0], np.cumsum(WIDTHS)])


def problem(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, Products]:
    """J (N, 3), columns Z (N, P) of which two blocks are nearly alike, y, and their products projected off J."""
    rng = np.random.default_rng(seed)
    j, z = rng.normal(size=(N, 3)), rng.normal(size=(N, STARTS[-1])) / np.sqrt(N)
    z[:, 3] = z[:, 0] + 0.2 * z[:, 3]
    y = j @ [3.0, -2.0, 1.0] + 12.0 * z[:, 1] - 9.0 * z[:, 4] + rng.normal(size=N)
    q = np.linalg.qr(j)[0]
    left, rest = z - q @ (q.T @ z), y - q @ (q.T @ y)
    signs = np.array([True, False, False, False, False])
    return j, z, y, Products(left, rest, N - 3, STARTS, signs, np.array([14, 14, 14, 14, 3]))


def off(j: np.ndarray, z: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and data in coordinates orthogonal to J, where its flat parameters are integrated out."""
    free = np.linalg.svd(j)[0][:, j.shape[1] :]
    return free.T @ z, free.T @ y


def log_density(z: np.ndarray, y: np.ndarray, scales: np.ndarray) -> float:
    """Of y ~ N(0, sigma^2 (I + Z D^2 Z^T)) with sigma integrated out by quadrature over its logarithm."""
    covariance = np.eye(len(y)) + (z * scales**2) @ z.T
    square = float(y @ np.linalg.solve(covariance, y))
    volume = np.linalg.slogdet(covariance)[1]
    peak = 0.5 * np.log(square / len(y))

    def density(t: float) -> float:
        return float(np.exp(-len(y) * (t - peak) - 0.5 * square * (np.exp(-2 * t) - np.exp(-2 * peak))))

    area = quad(density, peak - 3.0, peak + 6.0, epsabs=0.0, epsrel=1e-10)[0]
    return float(-0.5 * volume - len(y) * peak - 0.5 * square * np.exp(-2 * peak) + np.log(area))


@pytest.mark.parametrize("blocks", [(1,), (0, 3), (1, 4), (0, 1, 2, 3, 4)])
def test_the_ratio_is_that_of_densities_of_all_rows(blocks: tuple[int, ...]) -> None:
    j, z, y, products = problem()
    z, y = off(j, z, y)
    sizes = np.array([3.0, 12.0, 6.0, 48.0, 24.0])[: len(blocks)]
    own = products.places(blocks)
    scales = np.repeat(sizes, [WIDTHS[b] for b in blocks])
    nothing = log_density(z[:, :0], y, np.zeros(0))
    expected = log_density(z[:, own], y, scales) - nothing
    assert products.ratio(blocks, sizes) == pytest.approx(expected, abs=1e-7)
    assert nothing == pytest.approx(gammaln(len(y) / 2) - np.log(2) - len(y) / 2 * np.log(0.5 * float(y @ y)), abs=1e-7)


def test_a_block_added_to_a_set_is_the_larger_set() -> None:
    products = problem()[3]
    for blocks, sizes in (((), ()), ((1,), (12.0,)), ((0, 3), (6.0, 24.0))):
        added = products.added(products.left(blocks, np.array(sizes)))
        there = products.ratio(blocks, np.array(sizes))
        for b in range(1, len(WIDTHS)):  # the first has a sign: below
            if b not in blocks:
                whole = np.array([products.ratio((*blocks, b), np.array([*sizes, s])) for s in SIZES])
                allowed = np.arange(len(SIZES)) < products.limits[b]
                np.testing.assert_allclose(added[b], np.where(allowed, whole - there, -np.inf), atol=1e-9)


def test_what_a_set_leaves_is_what_ridge_regression_leaves() -> None:
    products = problem()[3]
    blocks, sizes = (1, 4), np.array([12.0, 6.0])
    own, scales = products.places(blocks), np.repeat(sizes, [2, 7])
    z, left = products.columns[:, own], products.left(blocks, sizes)
    inverse = np.linalg.inv(np.eye(N) + (z * scales**2) @ z.T)
    assert left.squares == pytest.approx(products.target @ inverse @ products.target, rel=1e-10)
    explained = products.columns.T @ (np.eye(N) - inverse) @ np.column_stack([products.columns, products.target])
    np.testing.assert_allclose(left.rows.T @ np.column_stack([left.rows, left.scores]), explained, atol=1e-9)


def test_a_few_blocks_alone_have_the_same_likelihoods() -> None:
    products = problem()[3]
    few = products.of((1, 3, 4))
    sizes = np.array([3.0, 12.0])
    assert few.ratio((0, 2), sizes) == pytest.approx(products.ratio((1, 4), sizes), abs=1e-10)
    assert few.limits.tolist() == [14, 14, 3]


def test_a_block_of_one_sign_has_twice_the_mass_on_its_side() -> None:
    j, z, y, _ = problem()
    q = np.linalg.qr(j)[0]
    for sign in (1.0, -1.0):
        x = sign * (z[:, :1] - q @ (q.T @ z[:, :1]))
        rest = y + 9.0 * z[:, 0] - q @ (q.T @ (y + 9.0 * z[:, 0]))
        two, one = (Products(x, rest, N - 3, np.array([0, 1]), np.array([s]), np.array([14])) for s in (False, True))
        either, positive = (p.added(p.left((), np.zeros(0)))[0] for p in (two, one))
        fits = [two.estimates([0], np.array([s])) for s in SIZES]
        above = [2.0 * norm.cdf(float(mean[0] / np.sqrt(covariance[0, 0]))) for mean, covariance in fits]
        np.testing.assert_allclose(positive - either, np.log(above), atol=1e-6)


@pytest.mark.parametrize(("seed", "start"), [(4, 0), (4, 5), (5, 13)])
def test_likeliest_sizes_average_and_drops_are_those_of_single_evaluations(seed: int, start: int) -> None:
    products = problem(seed)[3]
    blocks = (1, 2, 4)
    found = products.likeliest(blocks, (start,) * 3)
    there = expected = products.ratio(blocks, SIZES[list(found.sizes)])
    for k, block in enumerate(blocks):
        profile = []
        for s in SIZES[: products.limits[block]]:
            sizes = SIZES[list(found.sizes)]
            sizes[k] = s
            profile.append(products.ratio(blocks, sizes))
        assert int(np.argmax(profile)) == found.sizes[k]
        around = logsumexp(profile) - there - np.log(len(profile))
        expected += around
        fewer = products.ratio(np.delete(blocks, k).tolist(), np.delete(SIZES[list(found.sizes)], k))
        assert found.fewer[k] == pytest.approx(fewer - there - around, abs=1e-8)
    assert found.ratio == pytest.approx(expected, abs=1e-8)


def test_estimates_are_ridge_regression() -> None:
    j, z, y, products = problem()
    blocks, sizes = (0, 1, 4), np.array([6.0, 12.0, 24.0])
    own, scales = products.places(blocks), np.repeat(sizes, [1, 2, 7])
    rows = np.block([[j, z[:, own]], [np.zeros((len(own), 3)), np.diag(1.0 / scales)]])
    expected = np.linalg.lstsq(rows, np.concatenate([y, np.zeros(len(own))]), rcond=None)[0]
    mean, covariance = products.estimates(blocks, sizes)
    np.testing.assert_allclose(mean, expected[3:], atol=1e-9)
    left = float(np.sum((np.concatenate([y, np.zeros(len(own))]) - rows @ expected) ** 2))
    full = np.linalg.inv(rows.T @ rows)[3:, 3:] * left / (N - 3)
    np.testing.assert_allclose(covariance, full, rtol=1e-8, atol=1e-12)
