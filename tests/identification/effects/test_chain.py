"""Loads and torques of the nominal chain against potential energies."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from identification.arm import Arm, Gravity
from identification.effects import Chain
from identification.errors import InputError

LENGTHS, MASSES, CENTERS = np.array([400.0, 300.0]), np.array([5.0, 3.0]), np.array([0.5, 0.4])
ARM = Arm(LENGTHS, gravity=Gravity([2.0, -9.0], MASSES, CENTERS))
POSTURE, PAYLOAD = np.array([0.7, -1.9]), 4.0


def chain(arm: Arm = ARM) -> Chain:
    return Chain.of(arm, ca.SX(POSTURE), ca.SX([PAYLOAD, 1.5, -0.25, 2.0, 1.0, -1.0]))


def number(expression: ca.SX) -> np.ndarray:
    return np.array(ca.DM(expression)).ravel()


def energy(q: np.ndarray) -> float:
    """-m g . r [J] of both links' masses and the payload at the tip."""
    ends = np.cumsum(LENGTHS / 1000.0 * np.exp(1j * np.cumsum(q)))
    places = [CENTERS[0] * ends[0], ends[0] + CENTERS[1] * (ends[1] - ends[0]), ends[1]]
    return -sum(m * (2.0 * z.real - 9.0 * z.imag) for m, z in zip([*MASSES, PAYLOAD], places, strict=True))


def test_torques_are_minus_the_gradient_of_the_energy() -> None:
    h = 1e-4  # differences err by h^2 / 6 of some 50 N m: 1e-7
    expected = [-(energy(POSTURE + h * e) - energy(POSTURE - h * e)) / (2.0 * h) for e in np.eye(2)]
    np.testing.assert_allclose(number(chain().torques), expected, rtol=0, atol=1e-6)


def test_loads_beyond_a_link() -> None:
    """In the axes of the first link: what hangs on the second, and nothing beyond it."""
    pull = (3.0 + PAYLOAD) * (2.0 - 9.0j) * np.exp(-1j * POSTURE[0])
    np.testing.assert_allclose(number(chain().weight(1, 0)), [pull.real, pull.imag, 0.0], atol=1e-13)
    np.testing.assert_allclose(number(chain().weight(2, 0)), [0.0, 0.0, 0.0])
    # moment about joint 2 of the link's mass, at 0.4 of it, and the payload at the tip
    along = np.array([np.cos(POSTURE.sum()), np.sin(POSTURE.sum())])  # of the second link, 0.3 m long
    lever = 0.3 * (0.4 * 3.0 + PAYLOAD) * along
    np.testing.assert_allclose(number(chain().moment(1)), [0.0, 0.0, lever[0] * -9.0 - lever[1] * 2.0], atol=1e-13)


def test_conditions_stand_where_their_table_has_them() -> None:
    made = chain()
    values = [
        number(part).tolist() for part in (made.payload, made.temperature, made.time, made.session, made.directions)
    ]
    assert values == [[PAYLOAD], [1.5], [-0.25], [2.0], [1.0, -1.0]]


def test_without_gravity_there_are_no_torques() -> None:
    with pytest.raises(InputError, match=r"needs gravity torques, add a \[gravity\] table"):
        _ = chain(Arm(LENGTHS)).torques
