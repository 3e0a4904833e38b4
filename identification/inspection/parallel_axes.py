"""Joints of an arm that turn about parallel axes, one after the other."""

from __future__ import annotations

import numpy as np

from identification.arm import Arm
from identification.kinematics.parameters import REVOLUTE

PARALLEL = np.cos(np.radians(1.0))  # of drawings, whose angles may be rounded


def parallel_joints(arm: Arm) -> list[tuple[int, tuple[int, ...]]]:
    """Runs of two or more such joints: the first (from 0), and of each whether it turns as the first does (1) or the
    other way (-1)."""
    found: list[tuple[int, list[int]]] = []
    before = None
    for j, axis in enumerate(_axes(arm)):
        along = 0.0 if axis is None or before is None else float(axis @ before)
        if abs(along) > PARALLEL:
            found[-1][1].append(found[-1][1][-1] * int(np.sign(along)))
        else:
            found.append((j, [1]))
        before = axis
    return [(first, tuple(senses)) for first, senses in found if len(senses) > 1]


def _axes(arm: Arm) -> list[np.ndarray | None]:
    """(n) directions (3,) in the frame of the base where all joints are at zero, None of a sliding joint."""
    if arm.chain is None:
        return [np.array([0.0, 0.0, 1.0])] * arm.links
    found, turned = list[np.ndarray | None](), np.eye(3)
    for joint in arm.chain.joints:
        turned = turned @ joint.origin[:3, :3]
        found.append(turned @ joint.axis if joint.type == REVOLUTE else None)
    return found
