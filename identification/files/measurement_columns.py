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

from identification.arm import LARGEST_ANGLE, LARGEST_LENGTH, LARGEST_MASS, LENGTH_RANGE, MAX_LINKS, SIGMA_RANGE, Arm
from identification.arrays import Array
from identification.conditions import gaps_of
from identification.errors import InputError, close_names, suggestion
from identification.files.csv import KNOWN, Table, Test
from identification.kinematics.chain import planar_chain
from identification.kinematics.counting import counting_in, in_columns, in_joints
from identification.kinematics.parameters import PRISMATIC

if TYPE_CHECKING:
    from identification.instruments import Instrument
    from identification.measurements import Measurements

JointTypes = int | Sequence[str] | None  # of each joint; a number: so many that turn; None: as many as the table has
LENGTH, ANGLE, PIXEL = "length", "angle", "pixel"
# units that a column may have, the one to write first -> factor to [mm] or [rad]; and the largest value then
UNITS = {LENGTH: {"mm": 1.0, "m": 1000.0}, ANGLE: {"deg": float(np.radians(1.0)), "rad": 1.0}, PIXEL: {"px": 1.0}}
MOST = {LENGTH: LARGEST_LENGTH, ANGLE: float(np.radians(LARGEST_ANGLE)), PIXEL: LARGEST_LENGTH}
QUATERNION = ("qw", "qx", "qy", "qz")
_WHOLE = 2.0**53  # above it a float cannot count
_JOINT = re.compile(r"q([1-9]\d*)_(deg|rad|mm|m)")
_DIRECTION = re.compile(r"direction([1-9]\d*)")
_COMMANDED = re.compile(r"commanded[1-9]")
_ORIENTATION = re.compile(r"r[xyz]_(deg|rad)|q[wxyz]")


def measurement_fields(table: Table, links: int | Arm | None = None) -> dict[str, Any]:
    """The arguments of `Measurements` that a table has, of an arm with `links` links if given, or of an arm.

    Raises `InputError`, one line naming row and column, what was found and what is allowed. Warns (`UserWarning`)
    once about columns that are not used.
    """
    types: JointTypes = links.joint_types if isinstance(links, Arm) else links
    chain = links.chain if isinstance(links, Arm) else planar_chain([1.0])  # has the columns of every planar arm
    instrument, in_space = chain.instrument, not chain.planar
    read: list[tuple[str, str]] = [(axis, LENGTH) for axis in chain.axes]
    labels = ["session"]
    if not instrument.reads_positions:
        read = [coordinate[:2] for coordinate in instrument.coordinates]
        # each target that is touched has a place of its own, as each session has
        labels += filter(None, [instrument.target])
    postures = read_postures(table, types)
    n = postures.shape[1]
    poses = chain.angle_scale is not None
    names = [table.texts(column) for column in labels if column in table]
    targets = np.array(["/".join(parts) for parts in zip(*names, strict=True)]) if names else None
    session, marker = targets, table.texts("marker") if in_space and "marker" in table else None
    if instrument.own_targets:
        session, marker = table.texts("session") if "session" in table else None, targets
    commanded = [column for column in table.columns if _COMMANDED.match(column)]
    has_sigma = any(f"sigma_{unit}" in table for unit in UNITS[LENGTH])
    fields: dict[str, Any] = {
        "postures": postures,
        "positions": read_positions(table, chain.axes) if instrument.reads_positions else _readings(table, instrument),
        "order": _order(table),
        **read_conditions(table, n if types is None else types),
        "sigma": read_column(table, "sigma", LENGTH, SIGMA_RANGE) if has_sigma else None,
        "repeats": _repeats(table),
        "session": session,
        "gaps": _gaps(table, session) if "order" in table else None,
        "marker": marker,
        "orientations": read_orientations(table) if poses else None,
        "commanded": _joints(table, "commanded", n, types) if commanded else None,
        "fit": table.fit,
        "provenance": MappingProxyType({"file": table.file_name, "sha256": table.sha256}),
    }
    used = [f"{name}_{unit}" for name, quantity in (*read, ("sigma", LENGTH)) for unit in UNITS[quantity]]
    used += ["order", "time_s", "temperature_C", "payload_kg", "posture", "run", *labels]
    used += [*joint_columns(table, types), *(f"direction{j}" for j in range(1, n + 1)), *commanded]
    used += ["marker"] if in_space and not instrument.own_targets else []
    used += orientation_columns_of(table) if poses else []
    hint = ""
    if not instrument.reads_positions and "x_mm" in table:
        hint = f"[instrument] {instrument.kind} of the arm file reads no positions; for a tracker leave it out"
    elif instrument.reads_positions and in_space and not poses and orientation_columns_of(table):
        hint = "orientations are used where the arm file gives measurement.sigma_mm and sigma_deg"
    warn_unknown(table, used, hint)
    if instrument.contact and "run" in table and "order" not in table:
        planned = "has the column run and no order, as a plan does; contacts are joints as they were read"
        warnings.warn(f"{table.path}: {planned}", UserWarning, stacklevel=2)
    return fields


def measurement_columns(
    measurements: Measurements, joint_types: JointTypes = None, instrument: Instrument | None = None
) -> dict[str, NDArray[np.generic]]:
    """The columns of a measurement table; `measurement_fields` reads the same from it, to rounding (1e-14 rad).

    instrument : that measured; None: one of positions or lengths
    Raises `InputError` for positions that a file cannot have.
    """
    if (far := np.abs(measurements.positions).max(initial=0.0)) > LARGEST_LENGTH:
        raise InputError(f"measurements: found a position of {far:g} mm, allowed: up to {LARGEST_LENGTH:g}")
    columns = posture_columns(measurements.postures, joint_types)
    names = ["distance_mm"] if measurements.dimension == 1 else ["x_mm", "y_mm", "z_mm"]
    session, marker, target = "session", "marker", measurements.marker
    if instrument is not None and not instrument.reads_positions:
        names = [f"{name}_{next(iter(UNITS[quantity]))}" for name, quantity, _ in instrument.coordinates]
        if instrument.own_targets:
            marker = instrument.target or session
            if instrument.target and target is not None:
                target = np.array([name.rpartition("/")[2] for name in target.tolist()])
        else:
            session = instrument.target or session
    columns |= dict(zip(names, measurements.positions.T, strict=False))
    if measurements.commanded is not None:
        asked = posture_columns(measurements.commanded, joint_types)
        columns |= {name.replace("q", "commanded", 1): column for name, column in asked.items()}
    columns |= {} if measurements.orientations is None else angle_columns(measurements.orientations)
    columns |= _order_columns(measurements)
    directions, counting = measurements.directions, counting_in(joint_types)
    if directions is not None and counting is not None:
        directions = counting.signs_of_columns(directions)
    optional = {
        "temperature_C": measurements.temperature,
        "payload_kg": measurements.payload,
        **{f"direction{j}": column for j, column in enumerate(() if directions is None else directions.T, start=1)},
        "posture": measurements.repeats,
        marker: target,
        **({} if marker == session and target is not None else {session: measurements.session}),
        "sigma_mm": measurements.sigma,
    }
    return columns | {name: values for name, values in optional.items() if values is not None}


# -- reading -----------------------------------------------------------------------------------------------------------
def read_column(table: Table, name: str, kind: str, bounds: tuple[float, float] | None = None) -> Array:
    """(m,) lengths [mm] or angles [rad] of a column `name` in one of the `UNITS` of its kind.

    bounds : smallest and largest value, in [mm] or [rad]; None: any that is finite, up to `MOST`
    """
    columns = [f"{name}_{unit}" for unit in UNITS[kind]]
    present = [column for column in columns if column in table] or columns[:1]
    if len(present) > 1:
        raise InputError(f"{table.path}: found both {' and '.join(columns)}, allowed: one of them")
    unit = present[0].removeprefix(f"{name}_")
    factor = UNITS[kind][unit]
    low, high = bounds or (-MOST[kind], MOST[kind])
    allowed = f"a finite {kind}, up to {high / factor:g}"
    if bounds is not None:
        allowed = f"a number > 0 [{unit}], {low / factor:g} to {high / factor:g}"
    return table.floats(present[0], allowed, lambda v: (v * factor >= low) & (v * factor <= high)) * factor


def read_positions(table: Table, axes: str) -> Array:
    """(m, d) [mm] of columns `x_mm`, or `x_m` converted, ..."""
    return np.column_stack([read_column(table, axis, LENGTH) for axis in axes])


def _readings(table: Table, instrument: Instrument) -> Array:
    """(m, d) what an instrument read; of contacts what they stand for."""
    if instrument.contact:
        return np.full((len(table), instrument.dimension), instrument.touched)
    bounds = {True: LENGTH_RANGE, False: None}
    return np.column_stack(
        [read_column(table, name, kind, bounds[positive]) for name, kind, positive in instrument.coordinates]
    )


def joint_columns(table: Table, types: JointTypes = None) -> tuple[str, ...]:
    """The columns of joint positions a table has, `q1_deg` or `q1_rad`, in the order of the joints; of a prismatic
    joint `q1_mm` or `q1_m`."""
    matches = [match for column in table.columns if (match := _JOINT.fullmatch(column))]
    columns = [(int(match[1]), match.group()) for match in matches if match[2] in UNITS[_kind(types, int(match[1]))]]
    return tuple(column for _, column in sorted(columns, key=lambda item: item[0]))


def _kind(types: JointTypes, joint: int) -> str:
    """What the column of a joint, counted from 1, holds."""
    slides = isinstance(types, Sequence) and joint <= len(types) and types[joint - 1] == PRISMATIC
    return LENGTH if slides else ANGLE


def read_postures(table: Table, types: JointTypes = None) -> Array:
    """(m, n) joint positions [rad, mm] of the columns, which are as the controller counts (`JointKinds`); n as `types`
    say, or what the table has. Raises `InputError` for anything else."""
    columns = {column: int(column[1:].partition("_")[0]) for column in joint_columns(table, types)}
    n = max(columns.values(), default=1) if types is None else types if isinstance(types, int) else len(types)
    for column, joint in columns.items():
        if joint > n:
            first, last = (f"q{j}_{next(iter(UNITS[_kind(types, j)]))}" for j in (1, n))
            state = f"found column {column}, but the arm has {n} links"
            raise InputError(f"{table.path}: {state}, allowed: {first} to {last}")
        if joint > MAX_LINKS:
            raise InputError(f"{table.path}: found column {column}, allowed: 1 to {MAX_LINKS} joints")
    return _joints(table, "q", n, types)


def _joints(table: Table, name: str, n: int, types: JointTypes) -> Array:
    """(m, n) [rad, mm] of columns `name` 1 to n."""
    columns = [read_column(table, f"{name}{joint}", _kind(types, joint)) for joint in range(1, n + 1)]
    return in_joints(np.column_stack(columns), types)


def orientation_columns_of(table: Table) -> list[str]:
    """The columns of an orientation that a table has."""
    return [column for column in table.columns if _ORIENTATION.fullmatch(column)]


def read_orientations(table: Table) -> Array | None:
    """(m, 3, 3) axes of the measured frame, from `rx_deg, ry_deg, rz_deg` (about own axes, x, then y, then z; or in
    `_rad`) or from a quaternion `qw, qx, qy, qz`; None if the table has none of these columns."""
    if not (columns := orientation_columns_of(table)):
        return None
    from identification.kinematics.frames import from_angles, from_quaternions  # CasADi, which few files need

    if len({column[0] + column[2:] if column[0] == "r" else "q" for column in columns}) > 1:
        state = f"found {', '.join(columns)}"
        raise InputError(f"{table.path}: {state}, allowed: three angles of one unit, or a quaternion")
    if columns[0].startswith("r"):
        unit = columns[0].partition("_")[2]
        table.require(f"r{axis}_{unit}" for axis in "xyz")
        return from_angles(np.column_stack([read_column(table, f"r{axis}", ANGLE) for axis in "xyz"]))
    table.require(QUATERNION)
    quaternions = np.column_stack([table.floats(name) for name in QUATERNION])
    lengths = np.linalg.norm(quaternions, axis=1)
    if (bad := np.abs(lengths - 1.0) > 0.01).any():  # files have few digits
        row = int(np.argmax(bad))
        state = f"found a quaternion of length {lengths[row]:.4g}, allowed: length 1 to 0.01"
        raise InputError(f"{table.place(row, 'qw..qz')}: {state}")
    return from_quaternions(quaternions)


def read_conditions(table: Table, types: int | Sequence[str]) -> dict[str, Array | None]:
    """`payload` (m,) [kg], `temperature` (m,) [deg C] and `directions` (m, n) of the joints, each None if the table has
    none."""

    def optional(column: str, allowed: str, test: Test) -> Array | None:
        return table.floats(column, f"a number {allowed}", test) if column in table else None

    most = f">= 0 [kg], up to {LARGEST_MASS:g}"
    return {
        "payload": optional("payload_kg", most, lambda v: (v >= 0.0) & (v <= LARGEST_MASS)),
        "temperature": optional("temperature_C", ">= -273.15 [deg C]", lambda v: v >= -273.15),
        "directions": _directions(table, types),
    }


def _directions(table: Table, types: int | Sequence[str]) -> Array | None:
    """(m, n) +1 or -1 of the joints, NaN where the cell is empty: unknown; or where coupled joints leave it open."""
    n, counting = types if isinstance(types, int) else len(types), counting_in(types)
    columns = [column for column in table.columns if _DIRECTION.fullmatch(column)]
    if not columns:
        return None
    wanted = [f"direction{j}" for j in range(1, n + 1)]
    table.require(wanted)
    if beyond := [column for column in columns if column not in wanted]:
        state = f"found column {beyond[0]}, but there are {n} joints"
        raise InputError(f"{table.path}: {state}, allowed: direction1 to direction{n}")
    allowed = "+1 or -1, empty: unknown"
    signs = [table.floats(column, allowed, lambda v: np.abs(v) == 1.0, empty=np.nan) for column in wanted]
    directions = np.column_stack(signs)
    return directions if counting is None else counting.signs_of_joints(directions)


def _repeats(table: Table) -> NDArray[np.int64] | None:
    """(m,) whole numbers that are equal for repeats of a posture."""
    if "posture" not in table:
        return None
    whole = table.floats("posture", "a whole number", lambda v: (v == np.round(v)) & (np.abs(v) < _WHOLE))
    return whole.astype(np.int64)


def _order(table: Table) -> Array | None:
    """(m,) `time_s` or `order`; of both, the time says more, if it says the same."""
    order, time = (table.floats(c) if c in table else None for c in ("order", "time_s"))
    if order is None or time is None:
        return time if order is None else order
    by_order, by_time = np.argsort(order, kind="stable"), np.argsort(time, kind="stable")
    if np.array_equal(by_order, by_time):
        return time
    place = table.place(int(by_time[np.argmax(by_order != by_time)]), "time_s")
    state = "order and time_s put the rows in different orders"
    raise InputError(f"{place}: {state}, allowed: the same order, or one column")


def _gaps(table: Table, session: NDArray[np.str_] | None) -> NDArray[np.bool_] | None:
    """(m,) True where whole numbers of `order` are left out, in each session; None where nothing is, or nothing
    counts."""
    order = table.floats("order")
    if not np.all(order == np.round(order)):
        return None
    gaps = np.zeros(len(order), dtype=bool)
    for name in (None,) if session is None else np.unique(session):
        rows = np.ones(len(order), dtype=bool) if name is None else session == name
        gaps[rows] = gaps_of(order[rows])
    return gaps if gaps.any() else None


def warn_unknown(table: Table, known: Iterable[str], hint: str = "") -> None:
    """One `UserWarning` for all columns that are not `known`, with the nearest known one where there is one.

    hint : what else to say
    """
    known = list(known)
    free = [k for k in known if k not in table and not k.endswith(("_m", "_rad"))]  # the units to write first
    unknown = []
    for column in (column for column in table.columns if column not in known):
        near = "" if KNOWN.fullmatch(column) else suggestion(close_names(column, free)).strip()
        unknown.append(f"{column!r} ({near})" if near else f"{column!r}")
    if unknown:
        columns = "column is" if len(unknown) == 1 else "columns are"
        message = "; ".join(filter(None, [f"{columns} not used: {', '.join(unknown)}", hint]))
        warnings.warn(f"{table.path}: {message}", UserWarning, stacklevel=3)


# -- writing -----------------------------------------------------------------------------------------------------------
def posture_columns(postures: Array, types: JointTypes = None) -> dict[str, NDArray[np.generic]]:
    """Columns `q1_deg..qn_deg`, as the controller counts, of (m, n) joint positions [rad, mm]; `q1_mm` for a prismatic
    joint."""
    columns: dict[str, NDArray[np.generic]] = {}
    for j, column in enumerate(in_columns(postures, types).T, start=1):
        unit = next(iter(UNITS[_kind(types, j)]))
        # 30 rather than 29.999999999999996; 12 decimals are 2e-14 rad;  + 0: no -0
        columns[f"q{j}_{unit}"] = (np.round(np.degrees(column), 12) if unit == "deg" else column) + 0.0
    return columns


def angle_columns(orientations: Array) -> dict[str, NDArray[np.generic]]:
    """Columns `rx_deg, ry_deg, rz_deg` of orientations (m, 3, 3)."""
    from identification.kinematics.frames import to_angles

    angles = np.round(np.degrees(to_angles(orientations)), 12) + 0.0
    return {f"r{axis}_deg": column for axis, column in zip("xyz", angles.T, strict=True)}


def _order_columns(measurements: Measurements) -> dict[str, NDArray[np.generic]]:
    """`order` or `time_s`; both where the order, read again, would not have the same gaps."""
    if (order := measurements.order) is None:
        return {}
    gaps = np.zeros(len(order)) if measurements.gaps is None else measurements.gaps
    again, counts = np.zeros(len(order), dtype=bool), np.empty(len(order))
    for rows in measurements.session_rows:
        again[rows] = gaps_of(order[rows])
        sequence = rows[np.argsort(order[rows], kind="stable")]
        counts[sequence] = np.arange(len(rows)) + np.cumsum(gaps[sequence])
    if np.all(order == np.round(order)) and np.array_equal(again, gaps > 0.0):
        return {"order": order}
    columns: dict[str, NDArray[np.generic]] = {"time_s": order}
    return columns | ({"order": counts} if gaps.any() else {})


def csv_text(columns: dict[str, NDArray[np.generic]], fit: str = "") -> str:
    """CSV of columns of one length; whole floats that only count (`order`, directions) lose their `.0`.

    NaN is an empty cell;  fit : `Table.fit`, for the comment above the header
    """
    series = []
    for name, values in columns.items():
        column = pl.Series(name, values.tolist() if values.dtype.kind == "U" else np.ascontiguousarray(values))
        if (name == "order" and np.all(np.abs(values) < _WHOLE)) or _DIRECTION.fullmatch(name):
            column = column.fill_nan(None).cast(pl.Int64)
        series.append(column)
    return (f"# fit: {fit}\n" if fit else "") + pl.DataFrame(series).fill_nan(None).write_csv()
