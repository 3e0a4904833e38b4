"""A ball bar beside a planar arm: distances of sums of complex numbers, of which the fit gets the drawing alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, Array, EffectSpec, Measurements, Model, Status, diagnose, planar_chain, spectrum
from identification.estimation import Identification, estimate
from identification.instruments import PlanarDistance
from identification.sessions import with_sessions
from identification.simulate import simulate
from identification.validate import validate

LENGTHS = np.array([300.0, 250.0, 150.0])
ERRORS, OFFSETS = np.array([1.2, -0.7, 0.4]), np.array([0.0, 4e-3, -6e-3])
CENTERS = np.array([400.0 + 300.0j, -350.0 + 420.0j])
SIGMA = 0.02
BLANK = Arm(replace(planar_chain(LENGTHS), instrument=PlanarDistance()), sigma=SIGMA)


def tips(q: Array) -> np.ndarray:
    return np.exp(1j * np.cumsum(q + OFFSETS, axis=1)) @ (LENGTHS + ERRORS)


def data(count: int, noise: float, seed: int, turn: float = 0.0) -> Measurements:
    """Of two centers in turns; the whole cell turned about joint 1, which no distance shows."""
    generator = np.random.default_rng(seed)
    q, number = generator.uniform(-2.5, 2.5, (count, 3)), np.arange(count) % 2
    read = np.abs(tips(q) - CENTERS[number]) + noise * generator.standard_normal(count)
    q[:, 0] += turn
    label = np.array(["left", "right"])[number]
    return Measurements(q, read[:, None], marker=label)


def fitted(rows: Measurements) -> Identification:
    return estimate(Model(with_sessions(BLANK, rows)), rows)


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_without_noise_all_comes_back(turn: float) -> None:
    """Lengths and zeros, and the centers but for the turn."""
    fit = fitted(data(40, 0.0, 1, turn))
    assert fit.status is Status.converged
    np.testing.assert_allclose(fit.length_errors, ERRORS, atol=1e-8)
    np.testing.assert_allclose(fit.joint_offsets, OFFSETS, atol=1e-10)
    values = fit.model.parameters.mapping(fit.parameters)
    rows = {row.name: row.corrected for row in fit.corrected_values}
    assert rows["center left x"] == values["center[left].x"]
    for name, center in zip(("left", "right"), CENTERS * np.exp(1j * turn), strict=True):
        found = complex(values[f"center[{name}].x"], values[f"center[{name}].y"])
        assert found == pytest.approx(center, abs=1e-7)


def test_what_distances_show() -> None:
    """Three lengths, two zeros and two centers; of two links and one center 5, as counted in tests/identification/
    test_lengths.py. That of joint 1 turns the arm as its center would be turned."""
    rows = data(60, 0.0, 2)
    model = fitted(rows).model
    assert len(model.names) == 3 + 2 + 4
    assert "joint_offset:1" not in model.names
    assert spectrum(model.jacobian(rows.postures, None, rows.conditions), model.scales).rank == 9
    two = replace(planar_chain([300.0, 200.0]), instrument=PlanarDistance((("1", (350.0, 120.0)),)))
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (50, 2))
    assert spectrum(Model(Arm(two)).jacobian(q), Model(Arm(two)).scales).rank == len(Model(Arm(two)).names) == 5


def test_intervals_hold() -> None:
    scores = []
    for seed in range(20):
        fit = fitted(data(40, SIGMA, 100 + seed))
        truth = dict(zip((f"length_error:{j}" for j in (1, 2, 3)), ERRORS, strict=True))
        truth |= {"joint_offset:2": OFFSETS[1], "joint_offset:3": OFFSETS[2]}
        deviations = np.sqrt(np.diag(fit.covariance))
        values = zip(fit.names, fit.parameters, deviations, strict=True)
        scores += [(x - truth[name]) / std for name, x, std in values if name in truth]
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.35  # 100 correlated ones, as if 30 were independent


def test_an_effect_is_named_and_holds_elsewhere() -> None:
    """Joint 2 reads what an encoder off center does; another session has a center of its own."""
    chain = replace(planar_chain(LENGTHS), instrument=PlanarDistance((("1", (400.0, 300.0)),)))
    truth = Arm(chain, sigma=SIGMA, effects=(EffectSpec("encoder_eccentricity", 2, {"a": 6e-4, "b": 3e-4}),))
    generator = np.random.default_rng(5)
    rows = simulate(truth, generator.uniform(-2.5, 2.5, (80, 3)), generator)
    found = diagnose(BLANK, rows)
    assert found.named.effects == ("encoder_eccentricity:2",)
    assert "center 1" not in str(found)  # which is averaged over, and of which the arm says where fits start
    moved = replace(chain, instrument=PlanarDistance((("1", (-300.0, 500.0)),)))
    fresh = simulate(replace(truth, chain=moved), generator.uniform(-2.5, 2.5, (40, 3)), generator)
    again = validate(found.extended_arm(), fresh)
    assert again.model.rms < 1.5 * SIGMA < 3.0 * SIGMA < again.nominal.rms
