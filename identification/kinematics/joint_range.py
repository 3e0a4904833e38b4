"""The range of each joint over some postures, as a calibration keeps it: of revolute joints under `joint_range_deg`, of
slides under `joint_range_mm`, each in the order of the joints, as the limits of an arm file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from identification.arrays import Array
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, PRISMATIC, REVOLUTE

KEYS: Mapping[str, str] = {REVOLUTE: "joint_range_deg", PRISMATIC: "joint_range_mm"}


def joint_range(postures: Array, joint_types: Sequence[str]) -> dict[str, list[list[float]]]:
    """Smallest and largest position of each joint, [deg] and [mm], of postures (m, n) [rad, mm]; no key without such
    joints."""
    limits = np.stack([np.min(postures, axis=0), np.max(postures, axis=0)], axis=1)
    ranges: dict[str, list[list[float]]] = {}
    for kind, pair in zip(joint_types, limits, strict=True):
        in_file = pair * FILE_UNITS[JOINT_UNITS[kind]][1]
        ranges.setdefault(KEYS[kind], []).append([float(f"{end:.9g}") for end in in_file])
    return ranges


def range_of(provenance: Mapping[str, Any], joint_types: Sequence[str]) -> Array | None:
    """(2, n) least and largest positions [rad, mm] that `joint_range` wrote; None where they are not there.

    Files written before slides had a key of their own list all joints in the other one, a slide's millimetres times
    180 / pi.
    """
    slides = np.array([kind == PRISMATIC for kind in joint_types], dtype=bool)
    if KEYS[PRISMATIC] not in provenance:
        slides = np.zeros_like(slides)
    ends = np.empty((2, len(slides)))
    for kind, of_kind in ((REVOLUTE, ~slides), (PRISMATIC, slides)):
        count = int(of_kind.sum())
        limits = np.array(provenance.get(KEYS[kind], []), dtype=float) if count else np.empty((0, 2))
        if limits.shape != (count, 2):
            return None
        ends[:, of_kind] = limits.T / FILE_UNITS[JOINT_UNITS[kind]][1]
    return ends
