"""Which noise the rows have."""

import numpy as np
from scipy.signal import lfilter

from identification import Arm, Measurements, Model, diagnose

ARM = Arm([260.0, 180.0, 120.0, 100.0], sigma=0.1)


def test_what_drifts_is_no_noise() -> None:
    """Ten times the noise, fast at first and slowly back: 40 rows tell it from serial correlation."""
    generator, t = np.random.default_rng(0), np.linspace(0.0, 1.0, 40)
    q = generator.uniform(-1.6, 1.6, (40, 4))
    drift = (1.0 - np.exp(-t / 0.05)) - 0.9 * (1.0 - np.exp(-t / 0.6))
    moved = np.outer(drift / np.ptp(drift), [0.6, -0.8]) + 0.1 * generator.standard_normal((40, 2))
    found = diagnose(ARM, Measurements(q, Model(ARM).position(q) + moved)).to_json()
    assert "base_drift" in found["effects"]
    assert not found["scatter"]


def test_noise_that_lasts_is_no_effect_beside_that_of_each_row() -> None:
    """Along a path, where a controller lags and an instrument scatters."""
    q = 1.5 * np.sin(np.outer(np.arange(400.0), [0.05, 0.08, 0.11, 0.06]))
    slow, fast = np.random.default_rng(0).standard_normal((2, 400, 2))
    moved = 0.05 * fast + lfilter([0.06 * np.sqrt(1.0 - 0.95**2)], [1.0, -0.95], slow, axis=0)
    found = diagnose(ARM, Measurements(q, Model(ARM).position(q) + moved)).to_json()
    assert (found["verdict"], found["scatter"][0]["finding"]) == ("none", "serial_correlation")
