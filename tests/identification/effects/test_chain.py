"""What every effect has, how effects add up along the chain, loads and torques against potential energies, settings."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from identification import PRISMATIC, Arm, Conditions, EffectSpec, Gravity, InputError
from identification.conditions import condition_columns
from identification.effects import Chain, Scope, Setting, build
from identification.effects.base import clock
from identification.gap.blocks import hypotheses
from identification.kinematics.chain import DHRow, chain_of

LENGTHS, MASSES, CENTERS = np.array([400.0, 300.0]), np.array([5.0, 3.0]), np.array([0.5, 0.4])
ARM = Arm(LENGTHS, gravity=Gravity([2.0, -9.0], MASSES, CENTERS))
POSTURE, PAYLOAD = np.array([0.7, -1.9]), 4.0


def chain(arm: Arm = ARM) -> Chain:
    return Chain.of(arm, ca.SX(POSTURE), ca.SX([PAYLOAD, 1.5, -0.25, 2.0, 1.0, -1.0]), condition_columns(2))


def number(expression: ca.SX) -> np.ndarray:
    return np.array(ca.DM(expression)).ravel()


def test_loads_beyond_a_link() -> None:
    """In the axes of the first link: what hangs on the second, and nothing beyond it."""
    pull = (3.0 + PAYLOAD) * (2.0 - 9.0j) * np.exp(-1j * POSTURE[0])
    np.testing.assert_allclose(number(chain().weight(1, 0)), [pull.real, pull.imag, 0.0], atol=1e-13)
    np.testing.assert_allclose(number(chain().weight(2, 0)), [0.0, 0.0, 0.0])
    # moment about joint 2 of the link's mass, at 0.4 of it, and the payload at the tip
    along = np.array([np.cos(POSTURE.sum()), np.sin(POSTURE.sum())])  # of the second link, 0.3 m long
    lever = 0.3 * (0.4 * 3.0 + PAYLOAD) * along
    np.testing.assert_allclose(number(chain().moment(1)), [0.0, 0.0, lever[0] * -9.0 - lever[1] * 2.0], atol=1e-13)


def test_without_gravity_there_are_no_torques() -> None:
    with pytest.raises(InputError, match=r"needs gravity torques, add a \[gravity\] table"):
        _ = chain(Arm(LENGTHS)).torques


def test_what_a_sliding_joint_is_off_by_is_a_length() -> None:
    """Newtons bend it by millimetres; of the turning joint beside it torques and angles are as ever."""
    rows = [DHRow(300.0, np.pi / 2, 0.0), replace(DHRow(0.0, 0.0, 100.0), type=PRISMATIC, limits=(0.0, 200.0))]
    slider = chain_of(rows)
    each = (EffectSpec(name, j) for name in ("joint_compliance", "backlash") for j in (1, 2))
    keys = [p.toml_key for spec in each for p in build(spec, slider).parameters]
    assert keys == ["c_rad_per_N_m", "c_mm_per_N", "b_deg", "b_mm"]
    every = build(EffectSpec("joint_compliance"), slider).parameters
    assert [p.file_unit for p in every] == ["rad/(N m)", "mm/N"]
    for name in ("encoder_eccentricity", "transmission_ripple", "joint_hysteresis", "axis_runout"):
        with pytest.raises(InputError, match=f"{name} at joint 2, which slides, allowed: at joints that turn"):
            build(EffectSpec(name, 2), slider)
    members = hypotheses(Arm(slider, sigma=0.05), frozenset()).members
    assert {b.spec.name for b in members if b.spec and b.spec.joint == 2} >= {"gear_ratio"}


SCOPE = Scope(Arm([300.0, 200.0]), 2, np.zeros((3, 2)), Conditions(time=np.array([-0.5, 0.1234567, 0.5])))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((0.3, 0.1, 0.3, 9.0), [0.1, 0.3]),  # in order, each once, none that is not allowed
        (lambda scope: scope.conditions.time, [-0.5, 0.123457, 0.5]),  # as labels and files hold them
        (lambda scope: scope.arm.lengths / 1000.0 + scope.joint / 10.0, [0.4, 0.5]),
    ],
)
def test_values_are_listed_or_computed(values: object, expected: list[float]) -> None:
    assert Setting(-0.5, 0.5, values).scan(SCOPE) == expected  # type: ignore[arg-type]
    assert Setting(1, 3, whole=True).scan(SCOPE) == [1.0, 2.0, 3.0]
    assert Setting(1, 3, (0.0, 2.0, 2.5), whole=True).scan(SCOPE) == [2.0]


def test_steps_are_tried_between_rows_and_between_sessions() -> None:
    time = np.linspace(-0.5, 0.5, 9)
    one = Scope(SCOPE.arm, 1, np.zeros((9, 2)), Conditions(time=time)).step_times()
    np.testing.assert_allclose(one, time[1:-2] + 0.0625)  # between rows, but for the first and the last
    two = Conditions(time=np.tile(time, 2), session=np.repeat([0.0, 1.0], 9))
    both = Scope(SCOPE.arm, 1, np.zeros((18, 2)), two).step_times()
    assert both[-1] == pytest.approx(0.55)
    assert max(both) == pytest.approx(1.1 + 0.5 - 0.1875)
    assert clock(0.5, 0) < 0.55 < clock(-0.5, 1)
