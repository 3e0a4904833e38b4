"""Files of measurements, plans, targets and commands: CSV or Parquet in millimetres and degrees <-> arrays in
millimetres and radians."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

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
    measurement_columns,
    measurement_fields,
    orientation_columns_of,
    posture_columns,
    read_conditions,
    read_orientations,
    read_positions,
    read_postures,
    warn_unknown,
)
from identification.measurements import Measurements

if TYPE_CHECKING:
    from identification.instruments import Instrument

DECIMAL = re.compile(r"\s*[-+]?[\d.,]+([eE][-+]?\d+)?\s*")


def load_measurements(path: PathLike, links: int | Arm | None = None) -> Measurements:
    """The measurements of a CSV or Parquet file, of an arm with `links` links if given.

    links : or the arm itself: a spatial one has positions of three coordinates, markers, and may have sliding joints

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    return Measurements(**measurement_fields(read_table(path), links))


def measurement_text(
    measurements: Measurements, joint_types: JointTypes = None, instrument: Instrument | None = None
) -> str:
    """The text of a measurement file; `load_measurements` reads the same from it, to rounding (1e-14 rad).

    instrument : that measured; None: one of positions or lengths
    """
    return csv_text(measurement_columns(measurements, joint_types, instrument), measurements.fit)


# -- plans -------------------------------------------------------------------------------------------------------------
class PlanFile(NamedTuple):
    """What a plan file says, rows in the order of measurement.

    postures : (m, n) [rad, mm];  weights : (m,) shares, None: every row is one measurement
    fit : how the measurements are to be fitted, as options of `armcal identify`
    cells : column of the file, but for `run` -> its texts, with decimal points
    conditions : `payload` (m,) [kg], `temperature` (m,) [deg C], `directions` (m, n), None where the file has none;
        empty where they were not asked for
    """

    postures: Array
    weights: Array | None
    fit: str
    cells: dict[str, list[str]]
    conditions: dict[str, Array | None]


def read_plan(
    path: PathLike, joints: JointTypes = None, *, conditions: bool = False, carried_out: bool = False
) -> PlanFile:
    """The CSV file `run,q1_deg,...,qn_deg[,weight]`, `# fit: ...` above, with or without conditions of the rows.

    joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`
    conditions : read them too;  carried_out : the file is one of measurements, and has other columns

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    table = read_table(path)
    postures = read_postures(table, joints)
    n = postures.shape[1]
    weights = None
    if not carried_out:
        further = ["weight", "payload_kg", "temperature_C", "cup", *(f"direction{j}" for j in range(1, n + 1))]
        warn_unknown(table, ["run", *joint_columns(table, joints), *further])
        if "weight" in table:
            weights = table.floats("weight", "a number >= 0", lambda v: v >= 0.0)
            if abs((total := float(np.sum(weights))) - 1.0) > 1e-6:
                wrong = f"found a sum of {total:.9g}, allowed: 1 (within 1e-06)"
                raise InputError(f"{table.path}: column weight: {wrong}")
    cells = {name: table.frame[name].fill_null("").to_list() for name in table.columns if name != "run"}
    if table.decimal_commas:
        for texts in cells.values():
            texts[:] = [text.replace(",", ".") if DECIMAL.fullmatch(text) else text for text in texts]
    rows = read_conditions(table, n if joints is None else joints) if conditions else {}
    return PlanFile(postures, weights, table.fit, cells, rows)


def plan_file_text(
    postures: Array,
    weights: Array | None = None,
    fit: str = "",
    joint_types: JointTypes = None,
    further: Mapping[str, Sequence[str]] | None = None,
) -> str:
    """The text of a plan file; `read_plan` reads the same from it, to rounding (1e-14 rad).

    further : columns of names, (m,) each
    """
    columns = {"run": np.arange(1, len(postures) + 1), **posture_columns(postures, joint_types)}
    columns |= {name: np.array(texts, dtype=np.str_) for name, texts in (further or {}).items()}
    return csv_text(columns if weights is None else columns | {"weight": weights}, fit)


# -- targets and commands ----------------------------------------------------------------------------------------------
class Targets(NamedTuple):
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
