"""Servo errors: the difference between the commanded angle of a joint and the one that is read.

Positions are explained from the joints as read. What `compensate` finds is to be asked for, so that each joint comes to
rest, and is read, where the model wants it: the servo error that was measured is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.information import RANK_TOLERANCE
from identification.kinematics.parameters import REVOLUTE
from identification.measurements import Measurements

SERVO = "servo_error"


@dataclass(frozen=True)
class FollowingError:
    """Read less commanded position of one joint [rad, mm]: offset + reversal s + rest, s the sign of the last motion.

    joint : from 1;  rms, largest : of all of it;  rest : RMS of the rest
    """

    joint: int
    kind: str
    offset: float
    reversal: float
    rms: float
    largest: float
    rest: float

    @property
    def spec(self) -> EffectSpec:
        """As it stands in an arm file."""
        return EffectSpec(SERVO, self.joint, {"b": self.offset, "h": self.reversal})

    def to_json(self) -> dict[str, Any]:
        """An entry of `servo_error` (identification/files/README.md, "JSON keys")."""
        names = ("offset", "reversal", "rms", "largest", "rest")
        factor = 180.0 / np.pi if self.kind == REVOLUTE else 1.0
        figures = {name: getattr(self, name) * factor for name in names}
        return {"joint": self.joint, "unit": "deg" if self.kind == REVOLUTE else "mm", **figures}


def following_errors(measurements: Measurements, kinds: Sequence[str]) -> tuple[FollowingError, ...]:
    """Of every joint, by least squares; empty where no commands are given or they are the readings.

    kinds : (n) `revolute` or `prismatic`
    """
    if measurements.commanded is None or np.array_equal(measurements.commanded, measurements.postures):
        return ()
    errors, signs = measurements.postures - measurements.commanded, measurements.conditions.directions
    assert signs is not None  # measurements know it
    of_joints = []
    for j, (kind, error, sign) in enumerate(zip(kinds, errors.T, signs.T, strict=True), start=1):
        columns = np.column_stack([np.ones(len(error)), sign])
        (offset, reversal), *_ = np.linalg.lstsq(columns, error, rcond=RANK_TOLERANCE)
        rest = error - columns @ [offset, reversal]
        figures = np.sqrt(np.mean(error**2)), np.max(np.abs(error)), np.sqrt(np.mean(rest**2))
        of_joints.append(FollowingError(j, kind, float(offset), float(reversal), *map(float, figures)))
    return tuple(of_joints)


def with_servo_errors(arm: Arm, measurements: Measurements) -> Arm:
    """The arm with the servo errors that the measurements show, instead of its own, where they have commands."""
    if not (errors := following_errors(measurements, arm.joint_types)):
        return arm
    others = (spec for spec in arm.effects if spec.name != SERVO)
    return arm.with_effects(*others, *(error.spec for error in errors if error.largest > 0.0))


def servo_shift(arm: Arm, directions: Array) -> Array:
    """(k, n) what is read beyond a command [rad, mm], for directions of approach (k, n)."""
    shift = np.zeros(directions.shape)
    for spec in arm.effects:
        if spec.name == SERVO and spec.joint is not None:
            sign = directions[:, spec.joint - 1]
            shift[:, spec.joint - 1] = spec.values.get("b", 0.0) + spec.values.get("h", 0.0) * sign
    return shift
