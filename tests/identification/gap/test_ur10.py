"""Real data: the planar cut of a UR10. A sample, in tests/data/ur10_planar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification import Arm, Diagnosis, EffectSpec, Measurements, Model, diagnose, estimate

SAMPLE = Path(__file__).parents[2] / "data" / "ur10_planar" / "measurements.csv"
FILE = Path(__file__).parents[4] / "shared" / "data" / "ur10_planar" / "measurements.csv"  # for benchmarks

ARM = Arm([612.0, 572.3, 115.7], effects=(EffectSpec("base_offset"),), name="ur10")


def load(file: Path = SAMPLE) -> Measurements:
    table = np.genfromtxt(file, delimiter=",", names=True)
    q = np.radians(np.column_stack([table[f"q{j}_deg"] for j in (1, 2, 3)]))
    xy = np.column_stack([table["x_mm"], table["y_mm"]])
    return Measurements(q, xy, table["order"], temperature=table["temperature_C"])


def waves(found: Diagnosis) -> set[tuple[int, float]]:
    """(joint, periods per turn) of the ripples that are named, and of those that error curves are made of."""
    named = {(s.joint, s.values["k"]) for s in found.named.specs if s.name == "transmission_ripple" and s.joint}
    return named | {(curve.joint, wave["order"]) for curve in found.curves for wave in curve.described[1]}


def real(columns: np.ndarray) -> np.ndarray:
    """(2m, ...) real parts, then imaginary parts."""
    return np.concatenate([columns.real, columns.imag])


def base_columns(data: Measurements) -> np.ndarray:
    """(2m, 8) of u_j = (l_j + dl_j) exp(i dtheta_j) and of the base's offset: the model is linear in them."""
    z = np.exp(1j * np.cumsum(data.postures, axis=1))
    one = np.ones((len(z), 1))
    return real(np.hstack([z, 1j * z, one, 1j * one]))


def nominal_rms(data: Measurements) -> float:
    """RMS distance [mm] of the arm as drawn."""
    z = np.exp(1j * np.cumsum(data.postures, axis=1))
    return float(np.sqrt(np.mean(np.abs(data.positions @ [1.0, 1.0j] - z @ ARM.lengths) ** 2)))


def predicted_rms(columns: np.ndarray, positions: np.ndarray, there: np.ndarray, held_out: np.ndarray) -> float:
    """RMS distance [mm] on other rows of the least-squares fit of some."""
    values = np.linalg.lstsq(columns, real(positions @ [1.0, 1.0j]), rcond=None)[0]
    return float(np.sqrt(np.sum((real(held_out @ [1.0, 1.0j]) - there @ values) ** 2) / len(held_out)))


def wave_columns(data: Measurements, joint: int, k: int) -> np.ndarray:
    """(2m, 2) of a wave of k periods per turn in a joint's angle, through its lever on the nominal arm."""
    z = np.exp(1j * np.cumsum(data.postures, axis=1))
    lever = 1j * np.cumsum((z * ARM.lengths)[:, ::-1], axis=1)[:, ::-1][:, joint - 1, None]
    angle = k * data.postures[:, joint - 1]
    return real(lever * np.column_stack([np.cos(angle), np.sin(angle)]))


def best_waves(data: Measurements) -> tuple[int, int, int]:
    """Periods per turn of the two waves at joint 1 and the one at joint 2, of 15 to 32, that leave least."""
    base = np.linalg.qr(base_columns(data))[0]
    rest = real(data.positions @ [1.0, 1.0j])
    rest = rest - base @ (base.T @ rest)
    every = np.hstack([wave_columns(data, joint, k) for joint in (1, 2) for k in range(15, 33)])
    every = every - base @ (base.T @ every)
    gram, products = every.T @ every, every.T @ rest

    def explained(orders: tuple[int, int, int]) -> float:
        first = [2 * (orders[0] - 15), 2 * (orders[1] - 15), 36 + 2 * (orders[2] - 15)]
        rows = [column for k in first for column in (k, k + 1)]
        return float(products[rows] @ np.linalg.solve(gram[np.ix_(rows, rows)], products[rows]))

    orders = range(15, 33)
    return max(((k, other, third) for k in orders for other in orders if other > k for third in orders), key=explained)


def test_what_is_said_of_the_real_robot_holds_on_the_sample() -> None:
    """README.md and notebook 5, checked against plain numpy: the gap of lengths, offsets and base, the waves that
    `diagnose` names on a quarter of the rows, and that they explain more than half of the squares on the others."""
    sample = load(SAMPLE)
    quarter = np.arange(len(sample)) % 4 == 0
    data, others = sample.rows(quarter), sample.rows(~quarter)
    fitted = estimate(Model(ARM), data)
    assert fitted.rms_before == pytest.approx(nominal_rms(data), rel=1e-6)
    columns, there = base_columns(data), base_columns(others)
    alone = predicted_rms(columns, data.positions, columns, data.positions)
    assert fitted.rms_after == pytest.approx(alone, rel=1e-6)
    found = diagnose(ARM, data, others)
    named = waves(found)
    # 60 deg of joint 1 tell whole numbers of periods apart to one or two
    first, second, third = best_waves(data)
    for joint, k in ((1, first), (1, second), (2, third)):
        assert any(at == joint and abs(other - k) <= 2 for at, other in named), (joint, k)
    # outliers are left out of the diagnosis: a few of 278 rows
    before = predicted_rms(columns, data.positions, there, others.positions)
    assert found.gap.held_out_before == pytest.approx(before, rel=0.02)
    orders = ((1, first), (1, second), (2, third))
    wide, far = (np.hstack([base, *(wave_columns(rows, j, k) for j, k in orders)])
                 for base, rows in ((columns, data), (there, others)))  # fmt: skip
    assert found.gap.held_out_after < 1.03 * predicted_rms(wide, data.positions, far, others.positions)
    assert (found.gap.held_out_after / found.gap.held_out_before) ** 2 < 0.5
