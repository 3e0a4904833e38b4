"""Real data: the planar cut of a UR10. A sample, in tests/data/ur10_planar."""

from pathlib import Path

import numpy as np
import pytest

from identification import Arm, EffectSpec, Measurements, Model, diagnose, estimate, load_measurements

SAMPLE = Path(__file__).parents[2] / "data" / "ur10_planar" / "measurements.csv"
FILE = Path(__file__).parents[4] / "shared" / "data" / "ur10_planar" / "measurements.csv"  # for benchmarks

ARM = Arm([612.0, 572.3, 115.7], effects=(EffectSpec("base_offset"),), name="ur10")
Waves = tuple[tuple[int, int], ...]  # joint and periods per turn of each


def columns(data: Measurements, waves: Waves = ()) -> np.ndarray:
    """(2m, ..) real, then imaginary parts: the model is linear in u_j = (l_j + dl_j) exp(i dtheta_j), in the base's
    offset, and in waves in the angles of joints through their levers on the nominal arm."""
    z, one = np.exp(1j * np.cumsum(data.postures, axis=1)), np.ones((len(data), 1))
    levers, parts = 1j * np.cumsum((z * ARM.lengths)[:, ::-1], axis=1)[:, ::-1], [z, 1j * z, one, 1j * one]
    for joint, k in waves:
        turned = np.exp(1j * k * data.postures[:, joint - 1, None])
        parts.append(levers[:, joint - 1, None] * np.hstack([turned.real, turned.imag]))
    return np.concatenate([np.hstack(parts).real, np.hstack(parts).imag])


def predicted_rms(data: Measurements, others: Measurements, waves: Waves = ()) -> float:
    """RMS distance [mm] on other rows of the least-squares fit of some."""
    values = np.linalg.lstsq(columns(data, waves), data.positions.T.ravel(), rcond=None)[0]
    return float(np.sqrt(np.sum((others.positions.T.ravel() - columns(others, waves) @ values) ** 2) / len(others)))


def test_what_is_said_of_the_real_robot_holds_on_the_sample() -> None:
    """README.md and notebook 5, checked against plain numpy: the gap of lengths, offsets and base, the waves that
    `diagnose` names on a quarter of the rows, and that they explain more than half of the squares on the others."""
    sample = load_measurements(SAMPLE, 3)
    quarter = np.arange(len(sample)) % 4 == 0
    data, others = sample.rows(quarter), sample.rows(~quarter)
    assert estimate(Model(ARM), data).rms_after == pytest.approx(predicted_rms(data, data), rel=1e-6)
    gap = (diagnosis := diagnose(ARM, data, others)).gap
    named = {(s.joint, s.values["k"]) for s in diagnosis.named.specs if s.name == "transmission_ripple"}
    named |= {(curve.joint, wave["order"]) for curve in diagnosis.curves for wave in curve.described[1]}
    waves: Waves = ()
    for joint in (1, 1, 2):  # of 15 to 32 periods a turn that which leaves least beside those before
        each = [(*waves, (joint, k)) for k in range(15, 33)]
        waves = min(each, key=lambda more: predicted_rms(data, data, more))
    for joint, k in waves:  # 60 deg of joint 1 tell whole numbers of periods apart to one or two
        assert any(at == joint and abs(other - k) <= 2 for at, other in named), (joint, k, named)
    # outliers are left out of the diagnosis: a few of 278 rows
    assert gap.held_out_before == pytest.approx(predicted_rms(data, others), rel=0.02)
    assert gap.held_out_after < 1.03 * predicted_rms(data, others, waves)
    assert (gap.held_out_after / gap.held_out_before) ** 2 < 0.5
