"""`[joints]` of arm files, and joint limits, which are those of the controller's columns, to those of the joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.files.arm_schema import JointsTable
from identification.files.schema import require_count
from identification.files.toml import Plain
from identification.kinematics.counting import Counting, check_kinds
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.workspace import ColumnLimits

TIDY = "{:.15g}"


def counting_of(table: JointsTable | None, kinds: Sequence[str]) -> Counting | None:
    """As `[joints]` says; what it leaves out is as usual. Raises `InputError` for what no controller can have."""
    if table is None:
        return None
    n, values = len(kinds), table.model_dump(exclude_none=True)
    for key, found in values.items():
        require_count(f"joints.{key}", found, n, whose="joints")
    sign, coupled = values.get("sign", [1] * n), values.get("coupled_to", [0] * n)
    counting = Counting(tuple(sign), tuple(coupled), tuple(np.radians(values.get("zero_deg", [0.0] * n)).tolist()))
    check_kinds(counting, kinds)
    return counting


def limits_of_joints(
    counting: Counting, kinds: Sequence[str], lower: Array, upper: Array
) -> tuple[Array, Array, list[ColumnLimits]]:
    """(n,) limits of the joints [rad, mm] from those of the columns (n,), and what these are of coupled joints."""
    for j, (low, high, kind) in enumerate(zip(lower.tolist(), upper.tolist(), kinds, strict=True), start=1):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        if low >= high:
            found = f"joint {j} has lower {low * factor:g} >= upper {high * factor:g}"
            raise InputError(f"joint_limits_{unit}: {found}, allowed: lower < upper")
    tied = []
    for j in counting.coupled:
        ends = sorted(counting.sign[j] * (end - counting.zero[j]) for end in (float(lower[j]), float(upper[j])))
        tied.append(ColumnLimits(j + 1, tuple(counting.sums[j].tolist()), ends[0], ends[1]))
    return *counting.joint_limits(lower, upper), tied


def joints_table(counting: Counting) -> Plain:
    """`[joints]`, complete."""
    zeros = [float(TIDY.format(angle)) for angle in np.degrees(counting.zero)]
    return {"sign": list(counting.sign), "coupled_to": list(counting.coupled_to), "zero_deg": zeros}
