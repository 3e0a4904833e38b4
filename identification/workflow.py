"""The commands of identification."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from identification.errors import InputError
from identification.estimation.corrected_values import Calibrated, CorrectedValue, dh_places, dh_values
from identification.files.arm_chain import dh_rows
from identification.kinematics.frames import point_table, pose_table


def dh_table(
    calibrated: Calibrated, values: Sequence[CorrectedValue], arm: Path
) -> tuple[tuple[CorrectedValue, ...], list[str]]:
    """The corrected Denavit-Hartenberg table of an arm file that has one, and lines of base, measured points and the
    radius of a sphere beside it; else empty.

    values : corrected ones, the radius among them
    """
    if (table := dh_rows(arm)) is None:
        return (), []
    try:
        rows, places = dh_values(calibrated, *table), dh_places(calibrated, *table)
    except InputError:  # prismatic joints, or axes that are one
        return (), []
    lines = []
    for name, at in places:
        figures = (pose_table(at) if at.ndim == 2 else point_table(at)).items()
        lines.append(f"{name}: " + ", ".join(f"{key.replace('_', ' [')}] {value:z.3f}" for key, value in figures))
    own = {p.name for p in calibrated.geometry.chain.instrument.parameters}
    touched = [f"{v.name} [{v.unit}]: {v.corrected:z.3f} +- {v.std:.3f}" for v in values if v.parameter in own]
    return rows, [*lines, *touched]
