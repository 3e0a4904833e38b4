"""Columns of orientations in measurement and target files: three angles, or a quaternion."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from identification.arm import LARGEST_ANGLE
from identification.arrays import Array
from identification.errors import InputError
from identification.files.csv import Table

QUATERNION = ("qw", "qx", "qy", "qz")
NEARLY_ONE = 0.01  # by which a quaternion's length may be off: files have few digits
_COLUMN = re.compile(r"r[xyz]_(deg|rad)|q[wxyz]")


def orientation_columns_of(table: Table) -> list[str]:
    """The columns of an orientation that a table has."""
    return [column for column in table.columns if _COLUMN.fullmatch(column)]


def read_orientations(table: Table) -> Array | None:
    """(m, 3, 3) axes of the measured frame, from `rx_deg, ry_deg, rz_deg` (about own axes, x, then y, then z; or in
    `_rad`) or from a quaternion `qw, qx, qy, qz`; None if the table has none of these columns."""
    if not (found := orientation_columns_of(table)):
        return None
    from identification.kinematics.orientations import from_angles, from_quaternions  # CasADi, which few files need

    kinds = {column[0] + column[2:] if column[0] == "r" else "q" for column in found}
    if len(kinds) > 1:
        raise InputError(f"{table.path}: found {', '.join(found)}, allowed: three angles of one unit, or a quaternion")
    if "q" in kinds:
        table.require(QUATERNION)
        return from_quaternions(_of_length_one(table))
    unit = kinds.pop().removeprefix("r_")
    table.require(f"r{axis}_{unit}" for axis in "xyz")
    most = LARGEST_ANGLE if unit == "deg" else float(np.radians(LARGEST_ANGLE))
    allowed = f"a finite angle, up to {most:g}, in every row"
    columns = [table.floats(f"r{axis}_{unit}", allowed, lambda values: np.abs(values) <= most) for axis in "xyz"]
    angles = np.column_stack(columns)
    return from_angles(np.radians(angles) if unit == "deg" else angles)


def _of_length_one(table: Table) -> Array:
    """(m, 4) quaternions, the real part first."""
    found = np.column_stack([table.floats(name) for name in QUATERNION])
    lengths = np.linalg.norm(found, axis=1)
    if (bad := np.abs(lengths - 1.0) > NEARLY_ONE).any():
        row = int(np.argmax(bad))
        allowed = f"length 1 to {NEARLY_ONE:g}"
        raise InputError(
            f"{table.place(row, 'qw..qz')}: found a quaternion of length {lengths[row]:.4g}, allowed: {allowed}"
        )
    return found


def angle_columns(orientations: Array) -> dict[str, NDArray[np.generic]]:
    """Columns `rx_deg, ry_deg, rz_deg` of orientations (m, 3, 3)."""
    from identification.kinematics.orientations import to_angles

    angles = np.round(np.degrees(to_angles(orientations)), 12) + 0.0
    return {f"r{axis}_deg": column for axis, column in zip("xyz", angles.T, strict=True)}
