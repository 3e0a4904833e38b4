"""Columns of measurement tables, in millimetres and degrees <-> what `Measurements` holds, millimetres and radians."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from identification.arm import LARGEST_ANGLE, LARGEST_LENGTH, LARGEST_MASS, MAX_LINKS, SIGMA_RANGE, Arm
from identification.arrays import Array
from identification.errors import InputError, suggestion
from identification.files.csv import KNOWN, Table, Test
from identification.files.length_columns import SURFACE, lengths_of, read_lengths, session_of_rows, unit_of
from identification.files.order_columns import order_columns, read_gaps, read_order
from identification.files.orientation import angle_columns, orientation_columns_of, read_orientations
from identification.kinematics.counting import counting_in, in_columns, in_joints
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.spelling import close_names

if TYPE_CHECKING:
    from identification.kinematics.spatial import SpatialChain
    from identification.measurements import Measurements

_JOINT = re.compile(r"q([1-9]\d*)_(deg|rad|mm|m)")
_UNITS = {REVOLUTE: ("deg", "rad"), PRISMATIC: ("mm", "m")}  # of a joint's column, the one to write first
JointTypes = int | Sequence[str] | None  # of each joint; a number: so many that turn; None: as many as the table has
_COMMANDED = re.compile(r"commanded[1-9]")
_DIRECTION = re.compile(r"direction([1-9]\d*)")
_OPTIONAL = ("order", "time_s", "temperature_C", "payload_kg", "posture", "session", "sigma_mm")
_OF_PLANS = ("run",)  # a plan with the positions added is a measurement file
_WHOLE = 2.0**53  # above it a float cannot count


def measurement_fields(table: Table, links: int | Arm | None = None) -> dict[str, Any]:
    """The arguments of `Measurements` that a table has, of an arm with `links` links if given, or of an arm.

    Raises `InputError`, one line naming row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    types: JointTypes = links.joint_types if isinstance(links, Arm) else links
    chain = links.chain if isinstance(links, Arm) else None
    instrument = None if chain is None or chain.instrument.whole else chain.instrument
    axes = ("x", "y") if chain is None else ("x", "y", "z") if instrument is None else lengths_of(instrument)
    postures = read_postures(table, types)
    n = postures.shape[1]
    poses = chain is not None and chain.angle_scale is not None
    found: dict[str, Any] = {
        "postures": postures,
        "positions": read_lengths(table, instrument)
        if instrument is not None
        else np.column_stack([millimetres(table, axis) for axis in axes]),
        "order": (order := read_order(table)),
        **read_conditions(table, n if types is None else types),
        "sigma": _sigma(table),
        "repeats": _repeats(table),
        "session": (session := session_of_rows(table, instrument)),
        "gaps": read_gaps(table, session) if order is not None and "order" in table else None,
        "marker": table.texts("marker") if chain is not None and "marker" in table else None,
        "orientations": read_orientations(table) if poses else None,
        "commanded": _commanded(table, types, n),
        "fit": table.fit,
        "provenance": MappingProxyType({"file": table.file_name, "sha256": table.sha256}),
    }
    _warn_unused(table, types, axes, chain)
    return found


def _warn_unused(table: Table, types: JointTypes, axes: Sequence[str], chain: SpatialChain | None) -> None:
    """One warning for the columns of measurements that are not used."""
    spatial, n = chain is not None, len(joint_columns(table, types))
    poses = chain is not None and chain.angle_scale is not None
    lengths = [f"{name}_{unit}" for name in (*axes, "sigma") for unit in ("mm", "m")]
    optional = [*_OPTIONAL, *(["marker"] if spatial else []), *_OF_PLANS, *(f"direction{j}" for j in range(1, n + 1))]
    optional += orientation_columns_of(table) if poses else []
    optional += [SURFACE] if chain is not None and chain.instrument.contact else []
    optional += [column for column in table.columns if _COMMANDED.match(column)]
    wanted = "orientations are used where the arm file gives measurement.sigma_mm and sigma_deg"
    hint = wanted if spatial and len(axes) == 3 and not poses and orientation_columns_of(table) else ""
    if chain is not None and not chain.instrument.whole and "x_mm" in table:
        hint = f"[instrument] {chain.instrument.kind} of the arm file reads no positions; for a tracker leave it out"
    warn_unknown(table, [*joint_columns(table, types), *lengths, *optional], hint)


def measurement_columns(measurements: Measurements, joint_types: JointTypes = None) -> dict[str, NDArray[np.generic]]:
    """The columns of a measurement table; `measurement_fields` reads the same from it, to rounding (1e-14 rad).

    Raises `InputError` for positions that a file cannot have.
    """
    if (far := np.abs(measurements.positions).max(initial=0.0)) > LARGEST_LENGTH:
        raise InputError(f"measurements: found a position of {far:g} mm, allowed: up to {LARGEST_LENGTH:g}")
    columns = posture_columns(measurements.postures, joint_types)
    axes = ("distance",) if measurements.dimension == 1 else "xyz"
    columns |= {f"{axis}_mm": column for axis, column in zip(axes, measurements.positions.T, strict=False)}
    if measurements.commanded is not None:
        asked = posture_columns(measurements.commanded, joint_types)
        columns |= {name.replace("q", "commanded", 1): column for name, column in asked.items()}
    columns |= {} if measurements.orientations is None else angle_columns(measurements.orientations)
    columns |= order_columns(measurements)
    directions = () if measurements.directions is None else _signs_of_columns(measurements.directions, joint_types).T
    optional = {
        "temperature_C": measurements.temperature,
        "payload_kg": measurements.payload,
        **{f"direction{j}": column for j, column in enumerate(directions, start=1)},
        "posture": measurements.repeats,
        "session": measurements.session,
        "marker": measurements.marker,
        "sigma_mm": measurements.sigma,
    }
    return columns | {name: values for name, values in optional.items() if values is not None}


# -- columns shared with plans ----------------------------------------------------------------------------------------
def joint_columns(table: Table, types: JointTypes = None) -> tuple[str, ...]:
    """The columns of joint positions a table has, `q1_deg` or `q1_rad`, in the order of the joints; of a prismatic
    joint `q1_mm` or `q1_m`."""
    found = [match for column in table.columns if (match := _JOINT.fullmatch(column))]
    own = [match for match in found if match.group(2) in _units(types, int(match.group(1)))]
    return tuple(match.group() for match in sorted(own, key=lambda match: int(match.group(1))))


def _units(types: JointTypes, joint: int) -> tuple[str, str]:
    """Units that the column of a joint, counted from 1, may have."""
    several = types is not None and not isinstance(types, int) and joint <= len(types)
    return _UNITS[types[joint - 1] if several else REVOLUTE]  # type: ignore[index]


def read_postures(table: Table, types: JointTypes = None) -> Array:
    """(m, n) joint positions [rad, mm] of the columns, which are as the controller counts (`JointKinds`); n as `types`
    say, or what the table has. Raises `InputError` for anything else."""
    columns = joint_columns(table, types)
    joints = [int(column[1:].partition("_")[0]) for column in columns]
    n = max(joints, default=1) if types is None else types if isinstance(types, int) else len(types)
    wanted = [f"q{j}_{_units(types, j)[0]}" for j in range(1, n + 1)]
    if not columns:
        table.require(wanted[:1])
    for column, joint, following in zip(columns, joints, [*joints[1:], 0], strict=True):
        if joint == following:
            names = " and ".join(f"q{joint}_{unit}" for unit in _units(types, joint))
            raise InputError(f"{table.path}: found both {names}, allowed: one of them")
        if joint > n:
            found = f"found column {column}, but the arm has {n} links"
            raise InputError(f"{table.path}: {found}, allowed: {wanted[0]} to {wanted[-1]}")
    if n > MAX_LINKS:
        raise InputError(f"{table.path}: found column {columns[-1]}, allowed: 1 to {MAX_LINKS} joints")
    table.require(wanted[j - 1] for j in range(1, n + 1) if j not in joints)
    return in_joints(np.column_stack([_joint_positions(table, column) for column in columns]), types)


def _joint_positions(table: Table, column: str) -> Array:
    """(m,) column `q1_rad` or `q1_mm`, or `q1_deg` or `q1_m` converted."""
    unit = column.rpartition("_")[2]
    if unit in _UNITS[PRISMATIC]:
        factor = 1000.0 if unit == "m" else 1.0
        return up_to(table, column, "a finite length", LARGEST_LENGTH / factor) * factor
    if unit == "rad":
        return up_to(table, column, "a finite angle", np.radians(LARGEST_ANGLE))
    return np.radians(up_to(table, column, "a finite angle", LARGEST_ANGLE))


def up_to(table: Table, column: str, allowed: str, most: float) -> Array:
    """(m,) finite numbers of at most this absolute value."""
    return table.floats(column, f"{allowed}, up to {most:g}", lambda values: np.abs(values) <= most)


def posture_columns(postures: Array, types: JointTypes = None) -> dict[str, NDArray[np.generic]]:
    """Columns `q1_deg..qn_deg`, as the controller counts, of (m, n) joint positions [rad, mm]; `q1_mm` for a prismatic
    joint."""
    found: dict[str, NDArray[np.generic]] = {}
    for j, column in enumerate(in_columns(postures, types).T, start=1):
        unit = _units(types, j)[0]
        # 30 rather than 29.999999999999996; 12 decimals are 2e-14 rad;  + 0: no -0
        found[f"q{j}_{unit}"] = (np.round(np.degrees(column), 12) if unit == "deg" else column) + 0.0
    return found


def csv_text(columns: dict[str, NDArray[np.generic]], fit: str = "") -> str:
    """CSV of columns of one length; whole floats that only count (`order`, directions) lose their `.0`.

    NaN is an empty cell;  fit : `Table.fit`, for the comment above the header
    """
    series = []
    for name, values in columns.items():
        counts = name == "order" or _DIRECTION.fullmatch(name)
        small = counts and bool(np.all(np.abs(values) < _WHOLE))
        if values.dtype.kind == "U":
            series.append(pl.Series(name, values.tolist()))
        elif counts and np.isnan(values).any():
            series.append(pl.Series(name, values).fill_nan(None).cast(pl.Int64))
        else:
            series.append(pl.Series(name, values.astype(np.int64) if small else np.ascontiguousarray(values)))
    return (f"# fit: {fit}\n" if fit else "") + pl.DataFrame(series).fill_nan(None).write_csv()


def warn_unknown(table: Table, known: Iterable[str], hint: str = "") -> None:
    """One `UserWarning` for all columns that are not `known`, with the nearest known one where there is one.

    hint : what else to say
    """
    known = list(known)
    unknown = []
    for column in table.columns:
        if column not in known:
            free = [k for k in known if k not in table and not k.endswith(("_m", "_rad"))]  # the units to write first
            near = "" if KNOWN.fullmatch(column) else suggestion(close_names(column, free)).strip()
            unknown.append(f"{column!r} ({near})" if near else f"{column!r}")
    if unknown:
        columns = "column is" if len(unknown) == 1 else "columns are"
        more = f"; {hint}" if hint else ""
        warnings.warn(f"{table.path}: {columns} not used: {', '.join(unknown)}{more}", UserWarning, stacklevel=3)


def read_conditions(table: Table, types: int | Sequence[str]) -> dict[str, Array | None]:
    """`payload` (m,) [kg], `temperature` (m,) [deg C] and `directions` (m, n) of the joints, each None if the table has
    none."""
    return {
        "payload": _optional(
            table, "payload_kg", f">= 0 [kg], up to {LARGEST_MASS:g}", lambda v: (v >= 0.0) & (v <= LARGEST_MASS)
        ),
        "temperature": _optional(table, "temperature_C", ">= -273.15 [deg C]", lambda v: v >= -273.15),
        "directions": _directions(table, types),
    }


# -- columns of measurements ------------------------------------------------------------------------------------------
def millimetres(table: Table, name: str) -> Array:
    """(m,) column `x_mm`, or `x_m` converted."""
    unit, factor = unit_of(table, name)
    return up_to(table, f"{name}_{unit}", "a finite length", LARGEST_LENGTH / factor) * factor


def _sigma(table: Table) -> Array | None:
    (unit, factor), (low, high) = unit_of(table, "sigma"), SIGMA_RANGE
    allowed = f"> 0 [{unit}], {low / factor:g} to {high / factor:g}"
    values = _optional(table, f"sigma_{unit}", allowed, lambda v: (v * factor >= low) & (v * factor <= high))
    return None if values is None else values * factor


def _optional(table: Table, column: str, allowed: str, test: Test) -> Array | None:
    return table.floats(column, f"a number {allowed}", test) if column in table else None


def _signs_of_columns(directions: Array, types: JointTypes) -> Array:
    """(m, n) signs of the columns' motions, of those of the joints."""
    counting = counting_in(types)
    return directions if counting is None else counting.signs_of_columns(directions)


def _directions(table: Table, types: int | Sequence[str]) -> Array | None:
    """(m, n) +1 or -1 of the joints, NaN where the cell is empty: unknown; or where coupled joints leave it open."""
    n, counting = types if isinstance(types, int) else len(types), counting_in(types)
    columns = [column for column in table.columns if _DIRECTION.fullmatch(column)]
    if not columns:
        return None
    table.require(f"direction{j}" for j in range(1, n + 1))
    for column in columns:
        if int(column.removeprefix("direction")) > n:
            allowed = f"direction1 to direction{n}"
            raise InputError(f"{table.path}: found column {column}, but there are {n} joints, allowed: {allowed}")
    allowed = "+1 or -1, empty: unknown"
    signs = [table.floats(f"direction{j}", allowed, lambda v: np.abs(v) == 1.0, empty=np.nan) for j in range(1, n + 1)]
    found = np.column_stack(signs)
    return found if counting is None else counting.signs_of_joints(found)


def _commanded(table: Table, types: JointTypes, n: int) -> Array | None:
    """(m, n) [rad, mm] of `commanded1_deg..`, for all joints or for none."""
    if not any(_COMMANDED.match(column) for column in table.columns):
        return None
    pairs = [[f"commanded{joint}_{unit}" for unit in _units(types, joint)] for joint in range(1, n + 1)]
    table.require(first for first, other in pairs if other not in table)
    found = [_joint_positions(table, other if other in table else first) for first, other in pairs]
    return in_joints(np.column_stack(found), types)


def _repeats(table: Table) -> NDArray[np.int64] | None:
    """(m,) whole numbers that are equal for repeats of a posture."""
    if "posture" not in table:
        return None
    whole = table.floats("posture", "a whole number", lambda v: (v == np.round(v)) & (np.abs(v) < _WHOLE))
    return whole.astype(np.int64)
