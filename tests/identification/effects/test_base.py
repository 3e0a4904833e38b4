"""What every effect has, and how effects add up along the chain."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from identification.arm import Arm, EffectSpec
from identification.effects import Chain, build, measured_position
from identification.errors import InputError

ARM = Arm([300.0, 200.0])


def test_the_joint_from_zero() -> None:
    assert build(EffectSpec("backlash", 2), ARM.chain).joint_index == 1
    assert build(EffectSpec("backlash", 2), ARM.chain).link_length == 200.0
    with pytest.raises(InputError, match="thermal_growth needs a joint, allowed: 1 to 2"):
        _ = build(EffectSpec("thermal_growth"), ARM.chain).joint_index


def test_parameters_know_their_joint_and_kind() -> None:
    a, b = build(EffectSpec("encoder_eccentricity", 2), ARM.chain).parameters
    assert (a.name, a.kind, a.joint, b.short) == ("encoder_eccentricity:2.a", "effect", 2, "b")
    assert build(EffectSpec("base_offset"), ARM.chain).parameters[0].joint is None


def test_effects_act_in_the_order_of_the_chain() -> None:
    """Joint angle, then tool, then rotation and shift of the base, then the instrument, in complex numbers."""
    q = np.array([0.4, -1.2])
    specs = [EffectSpec("base_offset"), EffectSpec("base_rotation"), EffectSpec("gear_ratio", 2)]
    specs += [EffectSpec("tool_offset"), EffectSpec("axes_skew")]
    effects = [build(spec, ARM.chain) for spec in specs]
    base, angle, ratio, tool, skew = 3.0 + 4.0j, 0.2, 0.01, 5.0 - 6.0j, 0.001 + 0.002j
    values = [1.0, 2.0, 0.01, 0.02, base.real, base.imag, angle, ratio, tool.real, tool.imag, skew.real, skew.imag]
    first = q[0] + 0.01
    second = first + q[1] + 0.02 + ratio * q[1]
    tip = 301.0 * np.exp(1j * first) + (202.0 + tool) * np.exp(1j * second)
    placed = tip * np.exp(1j * angle) + base
    expected = placed + skew * np.conj(placed)
    chain = Chain.of(ARM, ca.SX(q), ca.SX([0.0, 0.0, 0.0, 1.0, 1.0]))
    found = np.array(ca.DM(measured_position(chain, effects, ca.SX(values)))).ravel()
    np.testing.assert_allclose(found, [expected.real, expected.imag], rtol=1e-13)
