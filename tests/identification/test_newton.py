"""Climbs to maxima in a box, against SciPy's bounded quasi-Newton method; away from a saddle; walls; a search that is
cut."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from identification import Array
from identification.newton import Rows, newton_ascent

WAVES = np.array([[1.0, 0.3], [-0.4, 1.2], [0.7, -0.9]])
PHASES, SIZES, UNITS = np.array([0.2, 1.0, -0.5]), np.array([1.0, 2.0, 0.5]), np.array([1.0, 0.5])
LIMITS = np.array([-2.0, -1.0]), np.array([2.5, 1.5])


def height(q: Array, rows: Rows) -> Array:
    """A sum of waves."""
    return np.cos(q @ WAVES.T + PHASES) @ SIZES


def slopes(q: Array, rows: Rows) -> tuple[Array, Array]:
    angle = q @ WAVES.T + PHASES
    bend = -np.einsum("kw,wi,wj->kij", SIZES * np.cos(angle), WAVES, WAVES)
    return -(SIZES * np.sin(angle)) @ WAVES, bend


def test_ends_are_maxima_within_the_box() -> None:
    starts = np.random.default_rng(0).uniform(*LIMITS, (40, 2))
    ends = newton_ascent(starts, height, slopes, LIMITS, UNITS)
    rows = np.arange(40)
    assert np.all(height(ends, rows) >= height(starts, rows))
    assert np.all((ends >= LIMITS[0]) & (ends <= LIMITS[1]))
    again = [
        minimize(lambda q: -height(q[None], rows)[0], end, bounds=np.transpose(LIMITS), options={"ftol": 1e-15})
        for end in ends
    ]
    np.testing.assert_allclose(height(ends, rows), [-end.fun for end in again], atol=1e-12)
    assert len(np.unique(np.round(ends, 4), axis=0)) < 5


def test_a_saddle_is_left_and_a_wall_is_not_crossed() -> None:
    """cos x - cos y between the walls |y| <= 2 and below x = 0.5, where climbs from the right may not go."""

    def walled(q: Array, rows: Rows) -> Array:
        return np.where(q[:, 0] <= 0.5, np.cos(q[:, 0]) - np.cos(q[:, 1]), -np.inf)

    def bend(q: Array, rows: Rows) -> tuple[Array, Array]:
        second = np.stack([-np.cos(q[:, 0]), np.cos(q[:, 1])], axis=1)
        return np.stack([-np.sin(q[:, 0]), np.sin(q[:, 1])], axis=1), second[:, :, None] * np.eye(2)

    starts, box = np.array([[0.3, 0.01], [0.4, -0.5], [2.0, 1.0]]), (np.full(2, -2.0), np.full(2, 2.0))
    ends = newton_ascent(starts, walled, bend, box, np.ones(2))
    np.testing.assert_allclose(ends, [[0.0, 2.0], [0.0, -2.0], [2.0, 1.0]], atol=1e-7)
    np.testing.assert_array_equal(newton_ascent(starts, walled, bend, box, np.ones(2), stop=lambda: True), starts)
