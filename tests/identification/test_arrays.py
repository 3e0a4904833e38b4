"""Arms, plans and measurements as values: equality, hash, copies, pickles, frames; limits in the wrong unit."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from identification import Arm, Calibration, Conditions, EffectSpec, Gravity, Measurements, Model, Plan, estimate
from identification.arrays import eigen_of_pairs
from identification.simulate import simulate
from identification.workspace import WorkspaceBox

EFFECT = EffectSpec("encoder_eccentricity", 2, MappingProxyType({"a": 0.001, "b": 0.0}))


def gravity(payload: float = 0.0) -> Gravity:
    return Gravity([0.0, -9.81], [3.0, 2.0], [0.5, 0.5], payload)


def calibration(error: float = 0.3) -> Calibration:
    return Calibration.of(
        [error, 0.1], [0.01, 0.02], {"base_offset.x": 1.0}, ("length_error:1",), [[0.5]], {"by": ["me"]}
    )


def arm(lower: float = -2.0) -> Arm:
    box = WorkspaceBox((0.0, 1.0), (0.0, 1.0))
    return Arm([200.0, 100.0], [lower, -1.0], [2.0, 1.0], 0.1, "two", gravity(), (box,), (EFFECT,), calibration())


def measured(x: float = 1.0) -> Measurements:
    return Measurements([[0.1, 0.2], [0.3, 0.4]], [[x, 2.0], [3.0, 4.0]], sigma=[0.1, 0.2])


CASES: list[tuple[Callable[..., Any], Any]] = [
    (gravity, 1.0),
    (calibration, 0.4),
    (arm, -1.5),
    (measured, 2.0),
    (lambda t=0.0: Conditions(time=np.array([t, 1.0])), 0.5),
    (lambda q=0.1: Plan([[q, 0.2]]), 0.3),
    (lambda w=0.5: Plan([[0.1, 0.2], [0.3, 0.4]], [w, 1.0 - w]), 0.4),
    (lambda lower=-2.0: Model(arm(lower)), -1.5),
]


@pytest.mark.parametrize(("make", "other"), CASES)
def test_equal_by_value(make: Callable[..., Any], other: Any) -> None:
    assert make() == make()
    assert hash(make()) == hash(make())
    assert make() != make(other)
    assert len({make(), make(), make(other)}) == 2
    assert make() != "text"


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda item: pickle.loads(pickle.dumps(item))])
def test_copies_and_pickles(again: Callable[[Any], Any]) -> None:
    for make, _ in CASES:
        assert again(make()) == make()
    truth = Arm([200.0, 100.0], sigma=0.1)
    data = simulate(truth, np.random.default_rng(1).uniform(-2.0, 2.0, (9, 2)), np.random.default_rng(2))
    found = estimate(Model(truth), data)
    copied = again(found)
    np.testing.assert_array_equal(copied.parameters, found.parameters)
    np.testing.assert_array_equal(copied.covariance, found.covariance)
    assert copied.model == found.model
    np.testing.assert_array_equal(copied.model.position(data.postures), found.model.position(data.postures))
    assert str(copied) == str(found)


def test_limits_that_look_like_degrees_warn() -> None:
    with pytest.warns(UserWarning, match=r"limit 180 of joint 1 is 29 turns and looks like degrees.*radians") as caught:
        Arm([200.0, 100.0], lower=[-180.0, -90.0], upper=[180.0, 90.0])
    assert caught[0].filename == __file__
    with pytest.warns(UserWarning, match=r"limit -90 of joint 2"):
        Arm([200.0, 100.0], lower=[-3.0, -90.0])
    Arm([200.0], lower=[-10.0 * np.pi], upper=[10.0 * np.pi])  # five turns either way: no warning


def test_eigenvalues_of_pairs_are_those_of_lapack() -> None:
    generator = np.random.default_rng(5)
    halves = generator.standard_normal((300, 2, 2)) * 10.0 ** generator.uniform(-5.0, 0.0, (300, 1, 1))
    special = [np.zeros((2, 2)), np.eye(2), np.diag([1.0, 2.0]), np.diag([2.0, 1.0]), np.ones((2, 2))]
    matrices = np.concatenate([halves @ halves.transpose(0, 2, 1), special, [[[1.0, -1.0], [-1.0, 1.0]]]])
    values, vectors = eigen_of_pairs(matrices)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices), rtol=0, atol=1e-14 * np.abs(matrices).max())
    np.testing.assert_allclose(vectors * values[:, None, :] @ vectors.transpose(0, 2, 1), matrices, atol=1e-14)
    np.testing.assert_allclose(vectors.transpose(0, 2, 1) @ vectors - np.eye(2), 0.0, atol=1e-14)


def test_a_plan_and_an_arm_in_a_notebook() -> None:
    found = Plan(np.radians([[10.0, 20.0], [30.0, 40.0]]), np.array([0.5, 0.5]))
    assert found.to_frame().rows() == [
        (1, *map(pytest.approx, (10.0, 20.0, 0.5))),
        (2, *map(pytest.approx, (30.0, 40.0, 0.5))),
    ]
    assert "q2_deg" in found._repr_html_()
    shown = Arm([260.0, 180.0], name="a<b", sigma=0.1, effects=(EffectSpec("backlash", 2),))._repr_html_()
    assert "a&lt;b" in shown
    assert "backlash:2" in shown
    assert shown.count("<tr>") == 3
    assert "-180 deg" in shown
