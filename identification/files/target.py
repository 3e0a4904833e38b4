"""Files of targets and of joint commands, for compensation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array
from identification.errors import InputError
from identification.files.csv import read_table
from identification.files.io import PathLike
from identification.files.measurement_columns import (
    JointTypes,
    angle_columns,
    csv_text,
    joint_columns,
    orientation_columns_of,
    posture_columns,
    read_orientations,
    read_positions,
    read_postures,
    warn_unknown,
)


@dataclass(frozen=True)
class Targets:
    """What the tip is to reach: positions (k, d) [mm], or the nominal tips of postures (k, n) [rad]; one is None.

    orientations : (k, 3, 3) of the tool beside positions, None: any will do
    """

    positions: Array | None
    postures: Array | None
    orientations: Array | None = None


def load_targets(path: PathLike, links: int | Arm) -> Targets:
    """The targets of a CSV file with `x_mm, y_mm` (or `x_m, y_m`), or with `q1_deg..qn_deg` of nominal postures.

    links : how many the planar arm has, or the arm; targets of a spatial one have `z_mm` too, and may have orientations

    With both, positions are the targets and postures say which of the many solutions to stay near.
    Raises `InputError` with file, row and column.
    """
    table = read_table(path)
    types, axes = (links.joint_types, "xyz"[: links.dimension]) if isinstance(links, Arm) else (links, "xy")
    lengths = [f"{axis}_{unit}" for axis in axes for unit in ("mm", "m")]
    has_positions, joints = any(column in table for column in lengths), joint_columns(table, types)
    if not has_positions and not joints:
        count = types if isinstance(types, int) else len(types)
        columns = " and ".join(", ".join(f"{axis}_mm" for axis in axes).rsplit(", ", 1))
        allowed = f"{columns}, or q1_deg..q{count}_deg"
        raise InputError(f"{path}: found columns {', '.join(table.columns)}, allowed: {allowed}")
    positions = read_positions(table, axes) if has_positions else None
    postures = read_postures(table, types) if joints else None
    poses = has_positions and len(axes) == 3
    warn_unknown(table, ["run", *lengths, *joints, *(orientation_columns_of(table) if poses else ())])
    return Targets(positions, postures, read_orientations(table) if poses else None)


def commands_text(
    commands: Array,
    targets: Array,
    errors: Array,
    joint_types: JointTypes = None,
    orientations: Array | None = None,
    angles: Array | None = None,
    reached: NDArray[np.bool_] | None = None,
    messages: Sequence[str] = (),
) -> str:
    """CSV `q1_deg..qn_deg, x_mm, y_mm, error_mm`: joint commands, the targets, and what is left between [mm].

    orientations, angles : of poses (k, 3, 3) that are wanted, and (k,) what is left [rad]: `rx_deg..`, `error_deg`
    reached : (k,) `reachable`, 1 or 0;  messages : (k,) `message`, why not, where any is not
    commands : NaN where none may be driven to: empty cells
    """
    wanted = {f"{axis}_mm": column for axis, column in zip("xyz", targets.T, strict=False)}
    wanted |= {} if orientations is None else angle_columns(orientations)
    left = {"error_mm": errors} | ({} if angles is None else {"error_deg": np.degrees(angles)})
    if reached is not None:
        left["reachable"] = reached.astype(int)
    if any(messages):
        left["message"] = np.array(messages)
    return csv_text({**posture_columns(commands, joint_types), **wanted, **left})
