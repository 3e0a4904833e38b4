"""Effects on the scatter: what `simulate` does with them, against the formulas."""

from __future__ import annotations

import numpy as np
import pytest

from identification import PRISMATIC, Arm, EffectSpec, Model
from identification.instruments import Distance
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import pose
from identification.simulate import simulate

ARM = Arm([300.0, 200.0, 150.0], sigma=0.1)
POSTURES = np.random.default_rng(1).uniform(-np.pi, np.pi, (4000, 3))


def errors(*effects: EffectSpec, seed: int = 2, sigma: float | None = None) -> np.ndarray:
    exact = Model(ARM).position(POSTURES)
    return simulate(ARM.with_effects(*effects), POSTURES, np.random.default_rng(seed), sigma=sigma).positions - exact


def test_the_model_ignores_them() -> None:
    noisy = ARM.with_effects(EffectSpec("joint_noise", 2, {"std": 1e-3}), EffectSpec("outliers", None, {"share": 0.1}))
    assert Model(noisy).names == Model(ARM).names
    np.testing.assert_array_equal(Model(noisy).position(POSTURES), Model(ARM).position(POSTURES))


def test_joint_noise_moves_the_tip_about_its_joint() -> None:
    found = errors(EffectSpec("joint_noise", 2, {"std": 1e-3}), sigma=0.0)
    elbow = 300.0 * np.column_stack([np.cos(POSTURES[:, 0]), np.sin(POSTURES[:, 0])])
    arm = Model(ARM).position(POSTURES) - elbow
    across = (found[:, 1] * arm[:, 0] - found[:, 0] * arm[:, 1]) / np.sum(arm**2, axis=1)
    # 4000 draws: relative standard error of a deviation 1.1 %
    assert np.std(across) == pytest.approx(1e-3, rel=0.05)
    np.testing.assert_allclose(np.sum(found * arm, axis=1), 0.0, atol=1e-6)


def test_reach_and_time_noise_scale_the_errors() -> None:
    plain = errors()
    reach = np.linalg.norm(Model(ARM).position(POSTURES), axis=1) / 650.0
    scaled = errors(EffectSpec("reach_noise", None, {"g": 3.0}))
    np.testing.assert_allclose(scaled, plain * np.sqrt(1 + 9 * reach**2)[:, None], atol=1e-10)
    late = errors(EffectSpec("time_noise", None, {"g": 1.5}))
    np.testing.assert_allclose(late, plain * np.exp(1.5 * np.linspace(-0.5, 0.5, 4000))[:, None], atol=1e-10)


def test_outliers_have_their_size_and_share() -> None:
    moved = errors(EffectSpec("outliers", None, {"share": 0.01, "size": 15.0})) - errors()
    size = np.linalg.norm(moved, axis=1)
    assert np.sum(size > 1e-6) == 40
    np.testing.assert_allclose(size[size > 1e-6], 1.5, rtol=1e-6)


def test_serial_correlation_keeps_the_variance() -> None:
    found = errors(EffectSpec("serial_correlation", None, {"rho": 0.7}))
    lag = np.sum(found[1:] * found[:-1]) / np.sum(found**2)
    # 8000 numbers: standard error of the correlation 0.008, of the deviation (effective number 2700) 1.4 %
    assert lag == pytest.approx(0.7, abs=0.04)
    assert np.std(found) == pytest.approx(0.1, rel=0.06)


ELBOW = (
    Joint("j1", pose((0.0, 0.0, 400.0)), np.array([0.0, 0.0, 1.0])),
    Joint("j2", pose((100.0, 0.0, 0.0)), np.array([0.0, 1.0, 0.0]), PRISMATIC, 0.0, 300.0),
    Joint("j3", pose((0.0, 0.0, 200.0)), np.array([0.0, 1.0, 0.0])),
)
TOOLS = {"1": np.array([60.0, 0.0, 50.0]), "2": np.array([0.0, 700.0, 0.0])}
SETTINGS = np.random.default_rng(4).uniform([-3.0, 0.0, -1.0], [3.0, 300.0, 1.0], (1000, 3))


@pytest.mark.parametrize("angle_scale", [None, 500.0])
@pytest.mark.parametrize("tools", [{"1": TOOLS["1"]}, TOOLS], ids=["one tool", "two"])
def test_in_space_outliers_point_anywhere(tools: dict[str, np.ndarray], angle_scale: float | None) -> None:
    """Of the arm that slides, of every reflector, with orientations or without: `size` standard deviations each, the
    mean of their directions zero and of the squares of each coordinate 1/3."""
    arm = Arm(KinematicChain(ELBOW, np.eye(4), tools=tools, angle_scale=angle_scale), sigma=0.1)
    noisy = arm.with_effects(EffectSpec("outliers", None, {"share": 0.5, "size": 20.0}))
    exact, found = (simulate(one, SETTINGS, np.random.default_rng(5), sigma=0.1) for one in (arm, noisy))
    moved_by = (found.positions - exact.positions)[:, :3]
    size = np.linalg.norm(moved_by, axis=1)
    off = size > 1e-9
    assert off.sum() == 500 * len(tools)
    np.testing.assert_allclose(size[off], 2.0, rtol=1e-9)
    # 500 directions or more: standard errors of a mean .026, of a mean square .013
    np.testing.assert_allclose(moved_by[off].mean(axis=0) / 2.0, 0.0, atol=0.1)
    np.testing.assert_allclose((moved_by[off] ** 2).mean(axis=0) / 4.0, 1.0 / 3.0, atol=0.05)
    if angle_scale is not None:
        np.testing.assert_array_equal(found.orientations, exact.orientations)


def test_outliers_of_lengths_are_too_long_or_too_short() -> None:
    """A distance is one number: off by `size` standard deviations, either way equally often."""
    chain = KinematicChain(ELBOW, np.eye(4), tools={"1": TOOLS["1"]}, instrument=Distance())
    arm = Arm(chain, sigma=0.1)
    noisy = arm.with_effects(EffectSpec("outliers", None, {"share": 0.5, "size": 20.0}))
    exact, found = (simulate(one, SETTINGS, np.random.default_rng(5), sigma=0.1) for one in (arm, noisy))
    moved_by = (found.positions - exact.positions)[:, 0]
    off = np.abs(moved_by) > 1e-9
    assert off.sum() == 500
    np.testing.assert_allclose(np.abs(moved_by[off]), 2.0, rtol=1e-9)
    assert abs(np.sum(moved_by > 1e-9) - 250) < 45  # four standard deviations of a fair coin
