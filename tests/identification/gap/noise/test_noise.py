"""Screening of the scatter, and the noise models that whiten it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification.arm import Arm
from identification.gap.fits.fit import fit
from identification.gap.fits.whitening import Rows
from identification.gap.noise.noise import Finding, holm, outliers, screen, variance_forms, whitened
from identification.measurements import Measurements
from identification.model import Model

ARM = Arm([300.0, 200.0, 150.0])


def _measured(seed: int, m: int = 60, kind: str = "white") -> Measurements:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-np.pi, np.pi, (m, 3))
    position, jacobian = Model(ARM).linearize(q)
    e = 0.1 * rng.normal(size=(m, 2))
    if kind == "joint":
        e += jacobian[:, :, 3 + 1] * (0.002 * rng.normal(size=m))[:, None]  # joint 2
    if kind == "serial":
        for i in range(1, m):
            e[i] = 0.7 * e[i - 1] + np.sqrt(0.51) * e[i]
    if kind == "late":
        e *= np.exp(1.5 * np.linspace(-0.5, 0.5, m))[:, None]
    return Measurements(q, position + e)


def _screened(measurements: Measurements, seed: int) -> tuple[Finding, ...]:
    rows, model = Rows.of(measurements), Model(ARM)
    return screen(fit(model, rows), rows, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("kind", "name"), [("joint", "joint_noise:2"), ("serial", "serial_correlation"), ("late", "time_noise")]
)
def test_finds_what_the_scatter_does(kind: str, name: str) -> None:
    found = [[f.name for f in _screened(_measured(seed, kind=kind), seed)] for seed in range(10)]
    # power above 0.95 at these sizes: 8 of 10 or more with probability 0.99
    assert sum(names == [name] for names in found) >= 7


def test_finds_noise_of_an_arm_with_many_joints() -> None:
    """12 joints make 15 tests: after Holm's correction 999 draws could never reach the level 0.01 (15 / 1000)."""
    rng = np.random.default_rng(3)
    model = Model(Arm(np.linspace(300.0, 80.0, 12)))
    q = rng.uniform(-np.pi, np.pi, (200, 12))
    position, jacobian = model.linearize(q)
    shaking = jacobian[:, :, 12] * (0.002 * rng.normal(size=200))[:, None]  # joint 1, some 10 times the common noise
    rows = Rows.of(Measurements(q, position + 0.1 * rng.normal(size=(200, 2)) + shaking))
    assert [f.name for f in screen(fit(model, rows), rows, rng)] == ["joint_noise:1"]


def test_white_noise_is_left_alone() -> None:
    found = [_screened(_measured(seed), seed) for seed in range(60)]
    # level 0.01 for all findings together: 5 or more of 60 have probability 0.0004
    assert sum(bool(f) for f in found) < 5


@pytest.mark.parametrize("correlation", [0.7, -0.4])
def test_whitening_makes_an_autoregression_white(correlation: float) -> None:
    rows = replace(Rows.of(_measured(1, 8)), correlation=correlation, order=np.random.default_rng(0).permutation(8))
    rank = np.argsort(np.argsort(rows.order))
    covariance = np.kron(correlation ** np.abs(rank[:, None] - rank[None, :]), np.eye(2))
    whitener = rows.whiten(np.eye(16).reshape(8, 2, 16))
    np.testing.assert_allclose(whitener @ covariance @ whitener.T, np.eye(16), atol=1e-12)
    assert rows.log_determinant == pytest.approx(np.linalg.slogdet(covariance)[1])


def test_noise_model_of_a_finding_whitens_it() -> None:
    measurements = _measured(2)
    rows, model = Rows.of(measurements), Model(ARM)
    found = fit(model, rows)
    noisy = whitened(rows, found, (Finding("joint_noise:2", 0.001, 2.5),))
    lever = model.jacobian(rows.postures, found.values)[:, :, 4]
    form = lever[:, :, None] * lever[:, None, :]
    form *= 2.0 / np.mean(np.einsum("mii->m", form))
    assert noisy.spread is not None
    np.testing.assert_allclose(noisy.spread @ noisy.spread, np.eye(2) + 2.5 * form, atol=1e-10)
    whitener = noisy.whiten(np.tile(np.eye(2), (60, 1, 1))).reshape(60, 2, 2)
    for i in range(60):
        np.testing.assert_allclose(whitener[i] @ (np.eye(2) + 2.5 * form[i]) @ whitener[i].T, np.eye(2), atol=1e-10)


def test_outliers_are_found_and_only_they() -> None:
    hits, false = 0, 0
    for seed in range(30):
        measurements = _measured(seed, 40)
        rng = np.random.default_rng([seed, 1])
        wrong = rng.choice(40, 3, replace=False)
        angle = rng.uniform(0, 2 * np.pi, 3)
        positions = measurements.positions.copy()
        positions[wrong] += 1.5 * np.column_stack([np.cos(angle), np.sin(angle)])  # 15 sigma
        rows, model = Rows.of(replace(measurements, positions=positions)), Model(ARM)
        found = fit(model, rows)
        flagged = outliers(found, rows)
        hits += flagged[wrong].all()
        false += flagged.sum() - flagged[wrong].sum()
    assert hits == 30  # 15 sigma against a limit of 6
    assert false <= 1


def test_holm_by_hand() -> None:
    assert holm({"a": 0.01, "b": 0.04, "c": 0.03}) == pytest.approx({"a": 0.03, "b": 0.06, "c": 0.06})


def test_a_joint_that_does_not_move_the_tip_has_no_noise() -> None:
    """As the last joint of an arm whose measured point lies on its axis."""
    generator = np.random.default_rng(1)
    data = Measurements(generator.uniform(-1.0, 1.0, (9, 2)), generator.standard_normal((9, 2)))
    levers = np.stack([generator.standard_normal((9, 2)), np.zeros((9, 2))], axis=2)
    forms = variance_forms(Rows.of(data), data.positions, levers)
    assert sorted(forms) == ["joint_noise:1", "reach_noise", "time_noise"]
    for form in forms.values():
        assert np.einsum("mii->", form) == pytest.approx(18.0)
