"""Denavit-Hartenberg tables as chains of joints, in the standard and in the modified convention.

    standard (Denavit and Hartenberg 1955)    A_j = Rz(theta_j) Tz(d_j) Tx(a_j) Rx(alpha_j)
    modified (Craig 1986)                     A_j = Rx(alpha_j) Tx(a_j) Rz(theta_j) Tz(d_j)

with theta_j = q_j + offset_j for a revolute joint, d_j + q_j in the place of d_j for a prismatic one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from identification.errors import InputError
from identification.kinematics.chain import Joint, KinematicChain
from identification.kinematics.frames import pose, rotation_about
from identification.kinematics.parameters import REVOLUTE

STANDARD, MODIFIED = "standard", "modified"
X, Z = np.eye(3)[0], np.eye(3)[2]


@dataclass(frozen=True)
class DHRow:
    """One joint: a, d [mm], alpha, offset [rad]; lower and upper limits [rad, mm], None: -pi to pi."""

    a: float
    alpha: float
    d: float
    offset: float = 0.0
    type: str = REVOLUTE
    limits: tuple[float, float] | None = None


def chain_of(rows: Sequence[DHRow], convention: str = STANDARD) -> KinematicChain:
    """The chain of a table; every joint moves about or along its own z axis.

    Raises `InputError` for another convention, no rows, and prismatic joints without limits.
    """
    if convention not in (STANDARD, MODIFIED):
        raise InputError(f"dh: convention {convention!r}, allowed: {STANDARD} or {MODIFIED}")
    joints, before = [], np.eye(4)
    for j, row in enumerate(rows, start=1):
        link = pose((row.a, 0.0, 0.0), rotation_about(X, row.alpha))  # Tx Rx = Rx Tx
        rise, turn = pose((0.0, 0.0, row.d)), pose(rotation=rotation_about(Z, row.offset))
        before, after = (before @ turn, rise @ link) if convention == STANDARD else (before @ link @ turn, rise)
        if row.limits is None and row.type != REVOLUTE:
            allowed = "lower and upper in [joint_limits_mm]"
            raise InputError(f"dh[{j}]: a prismatic joint without limits, allowed: {allowed}")
        joints.append(Joint(f"joint_{j}", before, Z, row.type, *(row.limits or (-np.pi, np.pi))))
        before = after
    if not joints:
        raise InputError("dh: no rows, allowed: one for each joint")
    return KinematicChain(tuple(joints), before)
