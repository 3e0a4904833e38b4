"""Names of curves: waves, sawtooth, step, none."""

from __future__ import annotations

import numpy as np
import pytest

from identification.gap.average import Wave, shape_text, waves

ANGLES = np.linspace(-np.pi, np.pi, 361)
STD = np.full(361, 1e-5)


def radians(wave: Wave) -> tuple[float, float]:
    """Amplitude and phase."""
    return float(np.radians(wave.amplitude_deg)), float(np.radians(wave.phase_deg))


def test_waves_with_amplitude_and_phase() -> None:
    error = 3e-4 * np.cos(17.0 * ANGLES - 0.7) + 1e-4 * np.cos(3.0 * ANGLES + 2.0) + 5e-4
    first, second = waves(ANGLES, error, STD)
    assert (first.order, second.order) == (17.0, 3.0)
    assert radians(first) == pytest.approx((3e-4, 0.7))
    assert radians(second) == pytest.approx((1e-4, -2.0))
    assert first.share == pytest.approx(0.9, abs=0.01)
    text = shape_text(ANGLES, error, STD, (first, second))
    assert text.startswith("waves: 17 (16.5 to 17.5) per turn, 0.017 deg; 3 (")


def test_a_narrow_range_says_which_orders_fit() -> None:
    q = np.radians(np.linspace(0.0, 60.0, 121))
    (wave,) = waves(q, 1e-4 * np.sin(21.0 * q), STD[:121])
    assert wave.order == 21.0
    assert wave.orders == pytest.approx((18.0, 24.0))


def test_sawtooth_and_step() -> None:
    saw = 1e-4 * (np.mod(5.0 * ANGLES / (2.0 * np.pi) + 0.1, 1.0) - 0.5)
    assert shape_text(ANGLES, saw, STD, waves(ANGLES, saw, STD)) == "sawtooth, 5 per turn, over -180 to 180 deg"
    step = np.where(np.radians(40.5) < ANGLES, 2e-4, -2e-4)
    text = shape_text(ANGLES, step, STD, waves(ANGLES, step, STD))
    assert text == "step of 0.023 deg at 40 deg over -180 to 180 deg"


def test_nothing_and_no_name() -> None:
    assert waves(ANGLES, np.zeros(361), STD) == ()
    assert shape_text(ANGLES, np.zeros(361), STD, ()) == "smooth curve over -180 to 180 deg"
    bump = 1e-4 * np.exp(-0.5 * (ANGLES / 0.1) ** 2)
    assert shape_text(ANGLES, bump, STD, waves(ANGLES, bump, STD)).startswith(("in part waves: ", "smooth curve"))


def test_angles_without_data_do_not_count() -> None:
    """Where the curve is not known it is zero, with a wide band."""
    error = np.where(ANGLES > 0.0, 3e-4 * np.cos(17.0 * ANGLES), 0.0)
    std = np.where(ANGLES > 0.0, 1e-5, 1e-2)
    assert radians(waves(ANGLES, error, std)[0])[0] == pytest.approx(3e-4, rel=0.02)
