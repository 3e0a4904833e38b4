"""Which noise the rows have."""

import numpy as np

from identification import Arm, Measurements, Model, diagnose


def test_what_drifts_is_no_noise() -> None:
    """Ten times the noise, fast at first and slowly back: 40 rows tell it from serial correlation."""
    arm, generator = Arm([260.0, 180.0, 120.0, 100.0], sigma=0.1), np.random.default_rng(0)
    t, q = np.linspace(0.0, 1.0, 40), generator.uniform(-1.6, 1.6, (40, 4))
    drift = (1.0 - np.exp(-t / 0.05)) - 0.9 * (1.0 - np.exp(-t / 0.6))
    moved = np.outer(drift / np.ptp(drift), [0.6, -0.8]) + 0.1 * generator.standard_normal((40, 2))
    found = diagnose(arm, Measurements(q, Model(arm).position(q) + moved)).to_json()
    assert "base_drift" in found["effects"]
    assert not found["scatter"]
