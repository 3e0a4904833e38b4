"""Whole turns of revolute joints: an angle beyond a limit may be one within the limits, read a turn away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identification.arrays import Array
from identification.kinematics.parameters import REVOLUTE

TURN = 2.0 * np.pi


def turned_into(postures: Array, lower: Array, upper: Array, joint_types: Sequence[str], slack: float = 0.0) -> Array:
    """(m, n) postures whose revolute joints beyond (n,) limits are moved by whole turns to where the limits allow them.

    slack : [rad] beyond a limit that does not count
    """
    lower, upper = lower - slack, upper + slack
    turned = lower + np.mod(postures - lower, TURN)
    beyond = (postures < lower) | (postures > upper)
    revolute = np.array([kind == REVOLUTE for kind in joint_types])
    return np.where(revolute & beyond & (turned <= upper), turned, postures)
