"""Plan files: postures to measure, what else holds there, and how the rows are to be fitted."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.files.csv import Table, read_table
from identification.files.io import PathLike
from identification.files.measurement_columns import (
    JointTypes,
    csv_text,
    joint_columns,
    posture_columns,
    read_conditions,
    read_postures,
    warn_unknown,
)

SUM_TOLERANCE = 1e-6
DECIMAL = re.compile(r"\s*[-+]?[\d.,]+([eE][-+]?\d+)?\s*")


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
    if not carried_out:
        further = ["weight", "payload_kg", "temperature_C", *(f"direction{j}" for j in range(1, n + 1))]
        warn_unknown(table, ["run", *joint_columns(table, joints), *further])
    rows = read_conditions(table, n if joints is None else joints) if conditions else {}
    return PlanFile(postures, None if carried_out else _weights(table), table.fit, _cells(table), rows)


def _cells(table: Table) -> dict[str, list[str]]:
    texts = {name: table.frame[name].fill_null("").to_list() for name in table.columns if name != "run"}
    if not table.decimal_commas:
        return texts
    return {
        name: [text.replace(",", ".") if DECIMAL.fullmatch(text) else text for text in column]
        for name, column in texts.items()
    }


def plan_file_text(postures: Array, weights: Array | None = None, fit: str = "", joint_types: JointTypes = None) -> str:
    """The text of a plan file; `read_plan` reads the same from it, to rounding (1e-14 rad)."""
    columns = {"run": np.arange(1, len(postures) + 1), **posture_columns(postures, joint_types)}
    return csv_text(columns if weights is None else columns | {"weight": weights}, fit)


def _weights(table: Table) -> Array | None:
    """(m,) shares of the measurements, as they stand in the file."""
    if "weight" not in table:
        return None
    weights = table.floats("weight", "a number >= 0", lambda v: v >= 0.0)
    total = float(np.sum(weights))
    if abs(total - 1.0) > SUM_TOLERANCE:
        raise InputError(
            f"{table.path}: column weight: found a sum of {total:.9g}, allowed: 1 (within {SUM_TOLERANCE:g})"
        )
    return weights
