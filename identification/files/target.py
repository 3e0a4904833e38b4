"""Files of targets and of joint commands, for compensation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.files.csv import read_table
from identification.files.io import PathLike
from identification.files.measurement import csv_text, joint_columns, posture_columns, read_postures, warn_unknown


@dataclass(frozen=True)
class Targets:
    """What the tip is to reach: positions (k, 2) [mm], or the nominal tips of postures (k, n) [rad]; one is None."""

    positions: Array | None
    postures: Array | None


def load_targets(path: PathLike, links: int) -> Targets:
    """The targets of a CSV file with `x_mm, y_mm`, or with `q1_deg..qn_deg` of nominal postures.

    With both, positions are the targets and postures say which of the many solutions to stay near.
    Raises `InputError` with file, row and column.
    """
    table = read_table(path)
    has_positions, joints = "x_mm" in table or "y_mm" in table, joint_columns(table)
    if not has_positions and not joints:
        raise InputError(
            f"{path}: found columns {', '.join(table.columns)}, allowed: x_mm and y_mm, or q1_deg..q{links}_deg"
        )
    positions = np.column_stack([table.floats(name) for name in ("x_mm", "y_mm")]) if has_positions else None
    postures = read_postures(table, links) if joints else None
    warn_unknown(table, ["run", "x_mm", "y_mm", *joints])
    return Targets(positions, postures)


def commands_text(commands: Array, targets: Array, errors: Array) -> str:
    """CSV `q1_deg..qn_deg, x_mm, y_mm, error_mm`: joint commands, the targets, and what is left between [mm]."""
    return csv_text({**posture_columns(commands), "x_mm": targets[:, 0], "y_mm": targets[:, 1], "error_mm": errors})
