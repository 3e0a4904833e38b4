"""Plan files: CSV in degrees <-> `Plan` in radians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from doe.plan.plan import Plan
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


def load_plan(path: PathLike, joints: JointTypes = None) -> Plan:
    """The plan of a CSV file `run,q1_deg,...,qn_deg[,weight]`, rows in the order of measurement, `# fit: ...` above.

    joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`

    Raises `InputError`, one line naming file, row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    table = read_table(path)
    plan = Plan(read_postures(table, joints), _weights(table), fit=table.fit)
    conditions = ["payload_kg", "temperature_C", *(f"direction{j}" for j in range(1, plan.links + 1))]
    warn_unknown(table, ["run", *joint_columns(table, joints), "weight", *conditions])
    return plan


def load_plan_conditions(path: PathLike, joints: int | Sequence[str]) -> dict[str, Array | None]:
    """What else a plan may say of its rows: `payload` (m,) [kg], `temperature` (m,) [deg C], `directions` (m, n)."""
    return read_conditions(read_table(path), joints)


def plan_text(plan: Plan, joint_types: JointTypes = None) -> str:
    """The text of a plan file; `load_plan` reads the same from it, to rounding (1e-14 rad)."""
    columns = {"run": np.arange(1, len(plan) + 1), **posture_columns(plan.postures, joint_types)}
    if plan.weights is not None:
        columns["weight"] = plan.weights
    return csv_text(columns, plan.fit)


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
