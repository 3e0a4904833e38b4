"""Marginal likelihoods of blocks against covariances of all rows, quadrature over sigma, and least squares."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import gammaln
from scipy.stats import norm

from identification.gap import likelihood
from identification.gap.likelihood import SIZES, Products

N, WIDTHS = 30, (1, 2, 1, 3, 7)
STARTS = np.concatenate([[0], np.cumsum(WIDTHS)])


def products_of(columns: np.ndarray, target: np.ndarray, freedom: int, *rest: np.ndarray) -> Products:
    """Of columns (N, P) with y (N,)."""
    return Products(columns.T @ columns, target @ columns, float(target @ target), freedom, *rest)


def problem(seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray, Products]:
    """J (N, 3), columns Z (N, P) of which two blocks are nearly alike, y, and their products projected off J."""
    rng = np.random.default_rng(seed)
    j, z = rng.normal(size=(N, 3)), rng.normal(size=(N, STARTS[-1])) / np.sqrt(N)
    z[:, 3] = z[:, 0] + 0.2 * z[:, 3]
    y = j @ [3.0, -2.0, 1.0] + 12.0 * z[:, 1] - 9.0 * z[:, 4] + rng.normal(size=N)
    q = np.linalg.qr(j)[0]
    left, rest = z - q @ (q.T @ z), y - q @ (q.T @ y)
    return j, z, y, products_of(left, rest, N - 3, STARTS, np.array([True, False, False, False, False]))


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
    pairs = [(b, size) for b, size in zip(blocks, (0, 2, 1, 4, 3), strict=False)]
    own = products.columns_of(blocks)
    scales = np.repeat([SIZES[size] for _, size in pairs], [WIDTHS[b] for b in blocks])
    nothing = log_density(z[:, :0], y, np.zeros(0))
    assert products.state(pairs).ratio == pytest.approx(log_density(z[:, own], y, scales) - nothing, abs=1e-7)
    assert nothing == pytest.approx(gammaln(len(y) / 2) - np.log(2) - len(y) / 2 * np.log(0.5 * float(y @ y)), abs=1e-7)


def test_a_block_added_to_a_set_is_the_larger_set() -> None:
    products = problem()[3]
    for pairs in ((), ((1, 2),), ((0, 1), (3, 3))):
        state = products.state(pairs)
        added, chosen = products.added(state), {block for block, _ in pairs}
        for b in range(1, len(WIDTHS)):  # the first has a sign: below
            if b not in chosen:
                whole = np.array([products.state((*pairs, (b, size))).ratio for size in range(len(SIZES))])
                np.testing.assert_allclose(added[b], whole - state.ratio, atol=1e-8)


@pytest.mark.parametrize("apart", [1e-5, 1.0])
def test_sets_that_change_by_one_block_lose_no_digits(apart: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Columns, also such as are nearly combinations of five, of large sizes, against QR of all rows, without products.

    A rounding of the products by 1e-16 counts with s^2 < 1e9, and in a ratio with N: 3e-6.
    """
    monkeypatch.setattr(likelihood, "CHANGED", 5)  # columns, so that sets are often made anew
    rng, count = np.random.default_rng(0), STARTS[-1]
    z = rng.normal(size=(N, 5)) @ rng.normal(size=(5, count)) + apart * rng.normal(size=(N, count))
    z /= np.linalg.norm(z, axis=0)
    y = 1e3 * z[:, :5] @ rng.normal(size=5) + rng.normal(size=N)
    products = products_of(z, y, N, STARTS, np.zeros(len(WIDTHS), dtype=bool))
    state, every = products.state([(b, 13) for b in range(5)]), np.pad(np.c_[z, y], ((0, count), (0, 0)))
    for _ in range(60):
        block = int(rng.integers(len(WIDTHS)))
        state = state.without(block) if block in state.blocks else state
        if rng.random() < 0.7:
            state = state.with_block((block, int(rng.integers(8, len(SIZES)))))
        ridge = np.eye(count)[:, : len(state.columns)]
        q, r = np.linalg.qr(np.vstack([z[:, state.columns] * state.sizes, ridge]))
        rest = every - q @ (q.T @ every)
        left, volume = rest.T @ rest, np.log(np.abs(np.diag(r))).sum()
        assert state.ratio == pytest.approx(-volume - 0.5 * N * np.log(left[-1, -1] / (y @ y)), abs=3e-6)
        np.testing.assert_allclose(state.remaining[0], left[:-1, -1], rtol=0.0, atol=1e-8)
        for index, own in zip(products.alike, state.remaining[1], strict=True):
            np.testing.assert_allclose(own, left[index[:, :, None], index[:, None, :]], rtol=0.0, atol=1e-11)


def test_a_set_with_look_alikes_serves_others_without_one_of_them() -> None:
    z = np.linalg.qr(np.random.default_rng(0).normal(size=(N, STARTS[-1])))[0]
    z[:, 3] = z[:, 0] + 1e-5 * z[:, 3]  # block 2 is nearly block 0
    products = products_of(z, z @ np.ones(STARTS[-1]), N, STARTS, np.zeros(len(WIDTHS), dtype=bool))
    near = products.state([(b, 13) for b in range(5)]).near
    assert near.blocks in ((0, 1, 3, 4), (1, 2, 3, 4))
    assert near.near is near


def test_a_set_has_the_coefficients_of_ridge_regression() -> None:
    j, z, y, products = problem()
    q = np.linalg.qr(j)[0]
    z, y = z - q @ (q.T @ z), y - q @ (q.T @ y)
    state = products.state([(1, 2), (4, 1)])
    scales = np.repeat([SIZES[2], SIZES[1]], [2, 7])
    inverse = np.linalg.inv(np.eye(N) + (z[:, state.columns] * scales**2) @ z[:, state.columns].T)
    assert state.squares == pytest.approx(y @ inverse @ y, rel=1e-10)
    np.testing.assert_allclose(state.remaining[0], z.T @ inverse @ y, atol=1e-9)
    precision = z[:, state.columns].T @ z[:, state.columns] + np.diag(scales**-2.0)
    np.testing.assert_allclose(state.covariance, np.linalg.inv(precision), rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(state.mean, np.linalg.solve(precision, z[:, state.columns].T @ y), atol=1e-9)


def test_a_block_of_one_sign_has_twice_the_mass_on_its_side() -> None:
    j, z, y, _ = problem()
    q = np.linalg.qr(j)[0]
    for sign in (1.0, -1.0):
        x = sign * (z[:, :1] - q @ (q.T @ z[:, :1]))
        rest = y + 9.0 * z[:, 0] - q @ (q.T @ (y + 9.0 * z[:, 0]))
        two, one = (products_of(x, rest, N - 3, np.array([0, 1]), np.array([s])) for s in (False, True))
        either, positive = (p.added(p.state())[0] for p in (two, one))
        fits = [two.state([(0, size)]) for size in range(14)]
        variances = [fit.covariance[0, 0] * fit.squares / two.freedom for fit in fits]
        above = [2.0 * norm.cdf(float(fit.mean[0] / np.sqrt(v))) for fit, v in zip(fits, variances, strict=True)]
        np.testing.assert_allclose(positive - either, np.log(above), atol=1e-6)
        np.testing.assert_allclose([one.state([(0, size)]).signed for size in range(14)], np.log(above), atol=1e-9)
