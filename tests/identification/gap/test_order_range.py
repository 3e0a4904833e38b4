"""Waves that a narrow range cannot tell apart, against likenesses from complex numbers."""

from __future__ import annotations

import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.gap.fit import Rows, fit
from identification.gap.hypotheses.detectability import NEAR
from identification.gap.order_range import order_clauses, order_ranges
from identification.measurements import Measurements
from identification.model import Model

LENGTHS = np.array([300.0, 200.0])
SIZE, K = 0.002, 20  # [rad], periods per turn


def likeness(q: np.ndarray, joint: int, one: float, other: float) -> float:
    """Of two waves in a joint after projection off lengths and offsets; the tip is a complex number."""
    links = LENGTHS * np.exp(1j * np.cumsum(q, axis=1))
    lever = 1j * links[:, joint:].sum(axis=1)
    base = np.column_stack([links, 1j * links.sum(axis=1), 1j * links[:, 1]])
    real = lambda z: np.concatenate([z.real, z.imag])  # noqa: E731
    q_base, _ = np.linalg.qr(real(base))

    def space(k: float) -> np.ndarray:
        wave = real(lever[:, None] * np.column_stack([np.cos(k * q[:, joint]), np.sin(k * q[:, joint])]))
        return np.linalg.qr(wave - q_base @ (q_base.T @ wave))[0]

    return float(np.linalg.norm(space(one).T @ space(other)) / np.sqrt(2.0))


@pytest.mark.parametrize("degrees", [40.0, 70.0, 110.0, 150.0, 360.0])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_wave_is_a_shape_where_its_neighbor_is_alike(degrees: float, joint: int) -> None:
    generator = np.random.default_rng(3)
    q = generator.uniform(-np.pi, np.pi, (150, 2))
    q[:, joint] *= degrees / 360.0
    bent = q.copy()
    bent[:, joint] += SIZE * np.cos(K * q[:, joint])
    z = (LENGTHS * np.exp(1j * np.cumsum(bent, axis=1))).sum(axis=1)
    positions = np.column_stack([z.real, z.imag]) + generator.normal(0.0, 0.01, (150, 2))
    spec = EffectSpec("transmission_ripple", joint + 1, {"k": K})
    rows = Rows.of(Measurements(q, positions))
    found = fit(Model(Arm(LENGTHS, effects=(spec,))), rows)
    label = f"transmission_ripple:{joint + 1}[k={K}]"
    shapes = order_ranges(found, rows, (label,))
    alike = max(likeness(q, joint, K, K - 1), likeness(q, joint, K, K + 1))
    assert abs(alike - NEAR) > 0.005  # the linear columns of model and oracle differ by the size of the effect
    assert len(shapes) == (alike >= NEAR)
    assert order_ranges(found, rows, ()) == ()
    if shapes:
        apart = 2.0 * np.pi / np.sqrt(12.0 * np.var(q[:, joint]))
        entry = shapes[0].to_json()
        assert entry["effect"] == label
        assert entry["orders"] == [max(1, np.ceil(K - apart)), np.floor(K + apart)]
        np.testing.assert_allclose(entry["range_deg"], np.degrees([q[:, joint].min(), q[:, joint].max()]))
        assert (
            f"over the {np.degrees(np.ptp(q[:, joint])):.0f} deg that joint {joint + 1} moved"
            in order_clauses(shapes)[0]
        )


def test_other_effects_are_no_waves() -> None:
    q = np.random.default_rng(4).uniform(-0.3, 0.3, (40, 2))
    arm = Arm(LENGTHS, effects=(EffectSpec("gear_ratio", 1), EffectSpec("base_drift")))
    z = (LENGTHS * np.exp(1j * np.cumsum(q, axis=1))).sum(axis=1)
    rows = Rows.of(Measurements(q, np.column_stack([z.real, z.imag])))
    assert order_ranges(fit(Model(arm), rows), rows, ("gear_ratio:1", "base_drift")) == ()
