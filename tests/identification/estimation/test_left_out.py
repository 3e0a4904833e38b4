"""Postures left out by leverages, against fits without them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from identification import Arm, Measurements, Model, estimate
from identification.estimation.doubts import left_out_rms
from identification.estimation.problem import NO_PRIOR, Prior

ARM = Arm([260.0, 180.0], sigma=0.1)
MODEL = Model(ARM)


def data(m: int, seed: int, noise: float = 0.1) -> Measurements:
    generator = np.random.default_rng(seed)
    q = generator.uniform(-2.0, 2.0, (m, 2))
    truth = np.array([1.0, -0.5, 0.01, -0.008])
    return Measurements(q, MODEL.position(q, truth) + noise * generator.standard_normal((m, 2)))


def refitted(rows: Measurements, groups: list[list[int]], prior: Prior = NO_PRIOR) -> float:
    """Each group predicted by a fit to the others."""
    squares = []
    for group in groups:
        others = rows.rows(np.setdiff1d(np.arange(len(rows)), group))
        fit = estimate(MODEL, others, prior=prior, sigma="given")
        there = MODEL.position(rows.postures[group], fit.parameters)
        squares += np.sum((rows.positions[group] - there) ** 2, axis=1).tolist()
    return float(np.sqrt(np.mean(squares)))


ROWS = {
    "each posture": (data(8, 1), NO_PRIOR, 2e-3),
    "with a prior": (data(4, 4), Prior({"length_error:1": 0.3, "joint_offset:2": 1e-3}), 5e-3),
    "own weights": (replace(data(9, 5), sigma=np.where(np.arange(9) < 4, 0.05, 0.4)), NO_PRIOR, 5e-3),
}


@pytest.mark.parametrize("name", ROWS)
def test_each_posture_as_a_fit_without_it_predicts_it(name: str) -> None:
    """In the plane the model is linear in l_j cos and l_j sin of its angles: for small errors to second order in them,
    1e-2 rad here, of a change of the fit of 0.1 mm."""
    rows, prior, near = ROWS[name]
    fit = estimate(MODEL, rows, prior=prior, sigma="given")
    found = left_out_rms(fit, rows)
    assert found == pytest.approx(refitted(rows, [[k] for k in range(len(rows))], prior), rel=near)
    assert found > fit.rms_after


def test_repeats_of_a_posture_are_left_out_together() -> None:
    once, twice = data(6, 2), np.repeat(np.arange(6), 2)
    noise = 0.1 * np.random.default_rng(3).standard_normal((12, 2))
    rows = Measurements(once.postures[twice], once.positions[twice] + noise)
    found = left_out_rms(estimate(MODEL, rows), rows)
    assert found == pytest.approx(refitted(rows, [[2 * k, 2 * k + 1] for k in range(6)]), rel=2e-3)


def test_none_where_a_posture_alone_determines_something() -> None:
    same = data(5, 7).rows(np.zeros(5, dtype=int))  # four equations for four unknowns; one posture five times
    for rows in (data(2, 6), same):
        assert left_out_rms(estimate(MODEL, rows), rows) is None
