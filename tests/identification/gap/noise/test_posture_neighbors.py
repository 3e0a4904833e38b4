"""Serial correlation that posture explains is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm
from identification.gap.fits.fit import fit
from identification.gap.fits.whitening import Rows
from identification.gap.noise.noise import likely_correlation, screen
from identification.gap.noise.posture_neighbors import lag_of, neighbor_means
from identification.gap.noise.quadratic_forms import LagForm, SparseForm, ratio, ratio_moments
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0, 150.0])


def grid(seed: int, rho: float = 0.0, wave: float = 0.4) -> Measurements:
    """Four passes over a grid of 5 x 5 x 3 postures in serpentines, each in another direction, with an error of `wave`
    mm that depends on posture only, and noise of 0.1 mm with this lag-1 correlation."""
    rng = np.random.default_rng(seed)
    q1, q2, q3 = np.linspace(-1.0, 1.0, 5), np.linspace(0.3, 1.6, 5), np.linspace(-0.8, 0.8, 3)
    place = [[a, b if i % 2 == 0 else -b + 1.9, c if k % 2 == 0 else -c] for k, b in enumerate(q2) for i, c in
             enumerate(q3) for a in (q1 if (i + k) % 2 == 0 else q1[::-1])]  # fmt: skip
    q = np.concatenate([place, place[::-1], place, place[::-1]]) + 1e-3 * rng.normal(size=(300, 3))
    smooth = wave * np.column_stack([np.sin(2.5 * q[:, 0] + q[:, 1]), np.cos(1.5 * q[:, 1] - 2.0 * q[:, 2])])
    noise = rng.normal(size=(300, 2))
    for i in range(1, 300):
        noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho**2) * noise[i]
    return Measurements(q, Model(ARM).position(q) + smooth + 0.1 * noise)


def serial(data: Measurements, seed: int) -> float | None:
    rows, model = Rows.of(data), Model(ARM)
    found = [
        f.size for f in screen(fit(model, rows), rows, np.random.default_rng(seed)) if f.name == "serial_correlation"
    ]
    return found[0] if found else None


def test_neighbors_on_a_grid_are_no_serial_correlation() -> None:
    rows, model = Rows.of(grid(0)), Model(ARM)
    left = (rows.positions - model.position(rows.postures, fit(model, rows).values)).ravel()
    assert ratio(LagForm(rows.sequence, 2), left[:, None])[0] > 0.4  # what the plain lag-1 correlation would say
    # level 0.01: 3 or more of 12 have probability 0.0002
    assert sum(serial(grid(seed), seed) is not None for seed in range(12)) < 3


def test_correlated_noise_on_a_grid_is_found() -> None:
    found = [serial(grid(seed, rho=0.8), seed) for seed in range(6)]
    assert all(size is not None for size in found)
    # of the noise (0.1 mm) relative to all that is left (0.3 mm): well below 0.8
    assert all(size < 0.5 for size in found)  # type: ignore[operator]


def test_mean_over_near_postures_of_another_time() -> None:
    data = grid(1)
    rows = replace(Rows.of(data), order=np.random.default_rng(2).permutation(300).astype(float))
    means = neighbor_means(rows).toarray()
    np.testing.assert_allclose(means.sum(axis=1), 1.0)
    distance = np.linalg.norm(data.postures[:, None] - data.postures[None], axis=2)
    apart = np.abs(rows.order[:, None] - rows.order[None]) >= 30.0
    for i in range(0, 300, 17):
        allowed = np.flatnonzero(apart[i])
        expected = allowed[np.argsort(distance[i, allowed], kind="stable")[:4]]
        assert set(np.flatnonzero(means[i])) == set(expected)


def test_form_and_its_moments() -> None:
    """Against dense matrices, and draws: 20,000 of them give a mean to 1 % of the standard deviation."""
    rows = Rows.of(grid(3))
    left = (rows.positions - Model(ARM).position(rows.postures)).ravel()
    form, size = lag_of(rows, left)
    assert size is not None
    assert ratio(form, left[:, None])[0] == pytest.approx(0.0, abs=1e-12)  # as large as what is seen
    assert isinstance(form, SparseForm)
    dense = np.kron(form.matrix.toarray(), np.eye(2))
    np.testing.assert_allclose(dense, dense.T, atol=1e-12)
    v = np.random.default_rng(0).normal(size=(600, 3))
    np.testing.assert_allclose(form.times(v), dense @ v, atol=1e-10)
    assert form.trace == pytest.approx(np.trace(dense))
    assert form.squared_trace == pytest.approx(np.sum(dense**2))
    basis = np.linalg.qr(np.random.default_rng(1).normal(size=(600, 6)))[0]
    drawn = np.random.default_rng(2).normal(size=(600, 20_000))
    drawn -= basis @ (basis.T @ drawn)
    mean, deviation = ratio_moments(form, basis)
    values = ratio(form, drawn)
    assert np.mean(values) == pytest.approx(mean, abs=4.0 * deviation / np.sqrt(20_000))
    assert np.std(values) == pytest.approx(deviation, rel=4.0 / np.sqrt(40_000))


def test_residuals_that_posture_explains_to_the_last_digit_have_no_correlation() -> None:
    """All alike, as of contacts whose ball is as far from everything: nothing is left to be correlated (found by the
    fuzz: not a number, and a decomposition that ended in a traceback)."""
    rows = Rows.of(grid(0))
    assert lag_of(rows, np.full(2 * len(rows), 1.0)).size == 0.0


def test_random_postures_are_tested_as_they_are() -> None:
    rng = np.random.default_rng(5)
    rows = Rows.of(Measurements(rng.uniform(-3.0, 3.0, (60, 3)), rng.normal(size=(60, 2))))
    assert isinstance(lag_of(rows, rows.positions.ravel()).form, LagForm)


def test_the_likely_correlation_is_that_of_the_noise() -> None:
    """Restricted likelihood against the plain formula with dense matrices, and its mean over 20 sets of 60 rows."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        q, noise = rng.uniform(-3.0, 3.0, (60, 3)), rng.normal(size=(60, 2))
        for i in range(1, 60):
            noise[i] = 0.6 * noise[i - 1] + 0.8 * noise[i]
        model = Model(ARM)
        rows = Rows.of(Measurements(q, model.position(q) + 0.1 * noise))
        best = fit(model, rows)
        found.append(likely_correlation(best, rows))
        if seed == 0:
            position, jacobian = model.linearize(q, best.values)
            x, y = jacobian.reshape(120, -1) / model.scales, (rows.positions - position).ravel()
            costs = []
            for rho in np.linspace(0.0, 0.95, 20):
                v = np.kron(rho ** np.abs(np.subtract.outer(np.arange(60), np.arange(60))), np.eye(2))
                w = np.linalg.inv(v)
                normal = x.T @ w @ x
                left = y - x @ np.linalg.solve(normal, x.T @ w @ y)
                freedom = 120 - x.shape[1]
                costs.append(freedom * np.log(left @ w @ left) + np.linalg.slogdet(v)[1] + np.linalg.slogdet(normal)[1])
            assert found[0] == pytest.approx(np.linspace(0.0, 0.95, 20)[np.argmin(costs)])
    # one estimate of 120 numbers scatters by sqrt(1 - 0.6^2) / sqrt(120) = 0.07; the mean of 20 by 0.02
    assert np.mean(found) == pytest.approx(0.6, abs=0.06)
