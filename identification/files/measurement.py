"""Files of measurements, plans, targets and commands: columns in millimetres and degrees <-> arrays in millimetres and
radians. `identification.measurements` makes `Measurements` of them.

All that reads raises `InputError`, one line naming file, row and column, what was found and what is allowed, and warns
(`UserWarning`) once about columns that are not used.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from identification.arm import LARGEST, LARGEST_ANGLE, LENGTH_RANGE, MAX_LINKS, SIGMA_RANGE, Arm
from identification.arrays import Array, ByValue, readonly
from identification.document import Sheet, html, in_a_sentence
from identification.errors import InputError, require
from identification.files.csv import MEASURE, VIA, Table, csv_text, read_table
from identification.files.io import PathLike
from identification.instruments import TRACKER
from identification.kinematics.chain import planar_chain
from identification.kinematics.counting import JointKinds
from identification.kinematics.frames import from_angles, from_quaternions, to_angles
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.measurements import VALUES, Measurements, directions_from_order

if TYPE_CHECKING:
    from identification.instruments import Instrument

Columns = dict[str, NDArray[np.generic]]
Joints = int | Sequence[str] | None  # the type of each; a number: so many that turn; None: as many as the table has
LENGTH, ANGLE, PIXEL = "length", "angle", "pixel"
QUANTITIES = {REVOLUTE: ANGLE, PRISMATIC: LENGTH}  # of the columns of joints
# units that a column may have, the one to write first -> factor to [mm] or [rad]; and the largest value then
UNITS = {LENGTH: {"mm": 1.0, "m": 1000.0}, ANGLE: {"deg": float(np.radians(1.0)), "rad": 1.0}, PIXEL: {"px": 1.0}}
MOST = {LENGTH: LARGEST, ANGLE: float(np.radians(LARGEST_ANGLE)), PIXEL: LARGEST}
# columns of one number -> field of `Measurements`, of which `VALUES` say what is allowed
NUMBERS = {"order": "order", "time_s": "order", "temperature_C": "temperature", "payload_kg": "payload"}
NUMBERS |= {"posture": "repeats"}
ORIENTATION = re.compile(r"r[xyz]_(deg|rad)|q[wxyz]")
PLANNED = re.compile(r"kind|weight|payload_kg|temperature_C|direction\d+|q\d+_(deg|rad|mm|m)")  # what plans may have


# -- measurements ------------------------------------------------------------------------------------------------------
def load_measurements(path: PathLike, links: int | Arm | None = None) -> Measurements:
    """The measurements of a CSV file, of an arm with `links` links if given.

    links : or the arm itself: a spatial one has positions of three coordinates, markers, and may have sliding joints
    """
    table = read_table(path)
    kinds = _joint_kinds(table, links.joint_types if isinstance(links, Arm) else links)
    chain = links.chain if isinstance(links, Arm) else planar_chain([1.0])  # has the columns of every planar arm
    instrument, poses = chain.instrument, chain.angle_scale is not None
    postures = read_postures(table, kinds)
    marked, touched = (instrument.target, "") if instrument.own_targets else (chain.point_column, instrument.target)
    session = table.texts("session") if "session" in table else None
    coordinates = instrument.coordinates[: len(chain.axes)]
    read = [read_column(table, name, kind, LENGTH_RANGE if positive else None) for name, kind, positive in coordinates]
    conditions = _conditions(table, kinds, NUMBERS)
    order, time = conditions.pop("order", None), conditions.pop("time_s", None)
    if order is not None and time is not None:  # time says more, if it says the same
        by_order, by_time = (np.argsort(each, kind="stable") for each in (order, time))
        if (differ := by_order != by_time).any():
            state = "order and time_s put the rows in different orders, allowed: the same order, or one column"
            raise InputError(f"{table.place(int(by_time[np.argmax(differ)]), 'time_s')}: {state}")
    measurements = Measurements(
        postures,
        np.column_stack(read) if read else np.zeros((len(table), instrument.dimension)),
        order if time is None else time,
        sigma=read_column(table, "sigma", LENGTH, SIGMA_RANGE) if _units_of(table, "sigma", LENGTH) else None,
        session=session,
        marker=table.texts(marked) if marked and marked in table else None,
        orientations=read_orientations(table) if poses else None,
        commanded=read_postures(table, kinds, "commanded") if _joint_columns(table, "commanded") else None,
        fit=table.fit,
        provenance={"file": Path(path).name, "sha256": table.sha256},
        **conditions,
    )
    if order is not None and np.all(order == np.round(order)):  # it counts measurements, not all of which are there
        gaps = np.zeros(len(table))
        for rows in measurements.sequences:
            steps = np.diff(order[rows], prepend=order[rows[0]])
            # of more than ten, most of them: they are frames or labels, no counts, and none is missing
            gaps[rows] = (steps > 1.0) & (np.median(steps) <= 10.0)
        measurements = replace(measurements, gaps=gaps if gaps.any() else None)
    if touched and touched in table:
        # each surface has a base of its own, as each session has; from where joints came all rows tell, by their order
        names = [each for each in (session, table.texts(touched)) if each is not None]
        surfaces = np.array(["/".join(parts) for parts in zip(*names, strict=True)])
        measurements = replace(measurements.rows(slice(None)), session=surfaces, session_names=())
    hint = ""
    if not instrument.reads_positions and "x_mm" in table:
        hint = f"[instrument] {instrument.kind} of the arm file reads no positions; for a tracker leave it out"
    elif marked and instrument.reads_positions and not poses and any(map(ORIENTATION.fullmatch, table.frame.columns)):
        hint = "orientations are used where the arm file gives measurement.sigma_mm and sigma_deg"
    directions = (f"direction{j + 1}" for j in range(postures.shape[1]))
    labels = filter(None, ("session", instrument.target, marked))
    table.warn_unused(["run", "sigma_mm", *NUMBERS, *directions, *labels], hint)
    if instrument.contact and "run" in table and "order" not in table:
        planned = "has the column run and no order, like a plan; give the joints as read at each contact"
        warnings.warn(f"{table.path}: {planned}", UserWarning, stacklevel=2)
    return measurements


def measurement_text(
    measurements: Measurements, types: Sequence[str] = (), instrument: Instrument | None = None
) -> str:
    """The text of a measurement file; `load_measurements` reads the same from it, to rounding (1e-14 rad).

    types : of the joints, as of `Plan`;  instrument : that measured; None: one of positions or lengths
    Raises `InputError` for positions that a file cannot have.
    """
    if (far := np.abs(measurements.positions).max(initial=0.0)) > LARGEST:
        raise InputError(f"measurements: found a position of {far:g} mm, allowed: up to {LARGEST:g}")
    names = ["distance_mm"] if measurements.dimension == 1 else ["x_mm", "y_mm", "z_mm"]
    session, marker = "session", "marker"
    if instrument is not None and not instrument.reads_positions:
        names = [column_of(name, quantity) for name, quantity, _ in instrument.coordinates]
        if instrument.own_targets:
            marker = instrument.target or marker
        else:
            session = instrument.target or session
    kinds = JointKinds(types or (REVOLUTE,) * measurements.links)
    columns = posture_columns(measurements.postures, kinds)
    columns |= dict(zip(names, measurements.positions.T, strict=False))
    if measurements.commanded is not None:
        columns |= posture_columns(measurements.commanded, kinds, "commanded")
    columns |= {} if measurements.orientations is None else angle_columns(measurements.orientations)
    if (order := measurements.order) is not None:
        counts = np.all(order == np.round(order)) and (measurements.gaps is not None or np.ptp(order) < len(order))
        columns["order" if counts else "time_s"] = order
    optional: dict[str, Any] = {"temperature_C": measurements.temperature, "payload_kg": measurements.payload}
    if (directions := measurements.directions) is not None:
        signs = kinds.counting.signs_of_columns(directions)
        optional |= {f"direction{j}": column for j, column in enumerate(signs.T, start=1)}
    optional |= {"posture": measurements.repeats, marker: measurements.marker, "sigma_mm": measurements.sigma}
    optional[session] = measurements.session
    columns |= {name: values for name, values in optional.items() if values is not None}
    return csv_text(columns, measurements.fit)


# -- reading columns ---------------------------------------------------------------------------------------------------
def column_of(name: str, quantity: str) -> str:
    """`x_mm`: the column of a quantity in the unit in which it is written."""
    return f"{name}_{next(iter(UNITS[quantity]))}"


def _units_of(table: Table, name: str, quantity: str) -> list[str]:
    """The units in which a table has a column."""
    return [unit for unit in UNITS[quantity] if f"{name}_{unit}" in table]


def read_column(table: Table, name: str, quantity: str, bounds: tuple[float, float] | None = None) -> Array:
    """(m,) lengths [mm] or angles [rad] of a column `name` in one of the `UNITS` of its quantity;  bounds : smallest
    and largest value, in [mm] or [rad]; None: any that is finite, up to `MOST`"""
    unit, *others = _units_of(table, name, quantity) or UNITS[quantity]
    if others and f"{name}_{unit}" in table:
        both = " and ".join(f"{name}_{each}" for each in UNITS[quantity])
        raise InputError(f"{table.path}: found both {both}, allowed: one of them")
    factor = UNITS[quantity][unit]
    low, high = bounds or (-MOST[quantity], MOST[quantity])
    allowed = f"a finite {quantity}, up to {high / factor:g}"
    if bounds is not None:
        allowed = f"a number > 0 [{unit}], {low / factor:g} to {high / factor:g}"
    return table.floats(f"{name}_{unit}", allowed, lambda v: (v * factor >= low) & (v * factor <= high)) * factor


def _joint_columns(table: Table, name: str = "q") -> dict[int, str]:
    """Joint, from 1 -> a column of its positions that a table has."""
    every = ((re.fullmatch(rf"{name}([1-9]\d*)_(deg|rad|mm?)", column), column) for column in table.frame.columns)
    return {int(words[1]): column for words, column in every if words}


def _joint_kinds(table: Table, joints: Joints) -> JointKinds:
    """Types of the joints whose positions a table has."""
    if joints is None:
        joints = min(max(_joint_columns(table), default=1), MAX_LINKS)
    return JointKinds((REVOLUTE,) * joints if isinstance(joints, int) else joints)


def read_postures(table: Table, kinds: JointKinds, name: str = "q", planned: bool = False) -> Array:
    """(m, n) joint positions [rad, mm] of columns `q1_deg..`, which are as the controller counts. Raises `InputError`
    for anything else;  name : `q`, or `commanded`;  planned : nothing is measured there that would show a wrong unit"""
    columns = _joint_columns(table, name)
    if (last := max(columns, default=1)) > len(kinds):
        ends = ((1, kinds[0]), (len(kinds), kinds[-1]))
        allowed = " to ".join(column_of(f"{name}{j}", QUANTITIES[kind]) for j, kind in ends)
        raise InputError(f"{table.path}: found column {columns[last]}, allowed: {allowed}")
    read = [read_column(table, f"{name}{j}", QUANTITIES[kind]) for j, kind in enumerate(kinds, start=1)]
    angles = [np.abs(q) for j, q in enumerate(read, start=1) if columns[j].endswith("_deg")]
    if planned and len(table) > 3 and 0.0 < np.max(angles, initial=0.0) <= np.radians(2.0 * np.pi + 0.01):
        message = f"all joint angles are within 6.3 deg and look like radians; name such columns {name}1_rad.."
        warnings.warn(f"{table.path}: {message}", UserWarning, stacklevel=2)
    return kinds.counting.joints(np.column_stack(read))


def read_orientations(table: Table) -> Array | None:
    """(m, 3, 3) axes of the measured frame, from `rx_deg, ry_deg, rz_deg` (about own axes, x, then y, then z; or in
    `_rad`) or from a quaternion `qw, qx, qy, qz`; None if the table has none of these columns."""
    columns = [*filter(ORIENTATION.fullmatch, table.frame.columns)]
    kinds = {column[2:] for column in columns}  # `_deg`, or nothing of a quaternion
    state = f"found {', '.join(columns)}"
    require(len(kinds) <= 1, f"{table.path}: {state}, allowed: three angles of one unit, or a quaternion")
    if not columns:
        return None
    if unit := kinds.pop():
        table.require(f"r{axis}{unit}" for axis in "xyz")
        return from_angles(np.column_stack([read_column(table, f"r{axis}", ANGLE) for axis in "xyz"]))
    table.require(names := ("qw", "qx", "qy", "qz"))
    quaternions = np.column_stack([table.floats(name) for name in names])
    lengths = np.linalg.norm(quaternions, axis=1)
    if (bad := np.abs(lengths - 1.0) > 0.01).any():  # files have few digits
        row = int(np.argmax(bad))
        state = f"found a quaternion of length {lengths[row]:.4g}, allowed: length 1 to 0.01"
        raise InputError(f"{table.place(row, 'qw..qz')}: {state}")
    return from_quaternions(quaternions)


def _conditions(table: Table, kinds: JointKinds, numbers: Iterable[str]) -> dict[str, Any]:
    """Those of the `NUMBERS` columns that the table has, (m,), by their fields, and `directions` (m, n) of the joints:
    +1 or -1, NaN where the cell is empty or coupled joints leave it open."""
    given = {column: table.floats(column, *VALUES[NUMBERS[column]][1:]) for column in numbers if column in table}
    fields = {"time_s" if column == "time_s" else NUMBERS[column]: values for column, values in given.items()}
    wanted = [f"direction{j}" for j in range(1, len(kinds) + 1)]
    if present := [column for column in table.frame.columns if re.fullmatch(r"direction[1-9]\d*", column)]:
        table.require(wanted)
        for column in set(present).difference(wanted):
            raise InputError(f"{table.path}: found column {column}, allowed: direction1 to {wanted[-1]}")
        signs = np.column_stack([table.floats(column, *VALUES["directions"][1:], empty=np.nan) for column in wanted])
        fields["directions"] = kinds.counting.signs_of_columns(signs, back=True)
    return fields


# -- writing columns ---------------------------------------------------------------------------------------------------
def posture_columns(postures: Array, types: Sequence[str], name: str = "q") -> Columns:
    """Columns `q1_deg..qn_deg`, as the controller counts, of (m, n) positions [rad, mm]; `q1_mm` of one that slides;
    name : `q`, or `commanded`"""
    columns, kinds = Columns(), JointKinds(types)
    for j, (kind, column) in enumerate(zip(kinds, kinds.counting.columns(postures).T, strict=True), start=1):
        # 30 rather than 29.999999999999996; 12 decimals are 2e-14 rad;  + 0: no -0
        shown = np.round(np.degrees(column), 12) if kind == REVOLUTE else column
        columns[column_of(f"{name}{j}", QUANTITIES[kind])] = shown + 0.0
    return columns


def angle_columns(orientations: Array) -> Columns:
    """Columns `rx_deg, ry_deg, rz_deg` of orientations (m, 3, 3)."""
    angles = np.round(np.degrees(to_angles(orientations)), 12) + 0.0
    return {f"r{axis}_deg": column for axis, column in zip("xyz", angles.T, strict=True)}


# -- plans -------------------------------------------------------------------------------------------------------------
def is_plan(table: Table, arm: Arm) -> bool:
    """Whether a table is a plan of the arm, not measurements: it has no readings, but runs, or else nothing that plans
    do not have. Of contacts, which have no readings either, it has runs."""
    instrument = arm.chain.instrument
    read = (coordinate for kind in (TRACKER, instrument) for coordinate in kind.coordinates[:1])
    if any(f"{name}_{unit}" in table for name, quantity, _ in read for unit in UNITS[quantity]):
        return False
    return "run" in table or (not instrument.contact and all(map(PLANNED.fullmatch, table.frame.columns)))


@dataclass(frozen=True, eq=False)
class Plan(ByValue):
    """m postures of an n-link arm, in the order of measurement, or an approximate design with weights.

    postures : (m, n) joint angles [rad], of prismatic joints positions [mm]
    weights : (m,) shares of the measurements, summing to one, None: an exact plan, every row is one measurement
    joint_types : (n) `revolute` or `prismatic`, empty: all revolute; as `JointKinds`, which say how files count them
    fit : how its measurements are to be fitted, as options of `armcal identify`; empty: by the model of the arm file
    via : (m,) rows that are way-points, where these were asked for; None: there are none
    cells : column of its file, but for `run` -> its texts, with decimal points
    conditions : `payload` (m,) [kg], `temperature` (m,) [deg C], `sigma` (m,) [mm], `directions` (m, n), or None
    """

    postures: Array
    weights: Array | None = None
    joint_types: Sequence[str] = ()
    fit: str = ""
    via: NDArray[np.bool_] | None = None
    cells: Mapping[str, Sequence[str]] = field(default_factory=dict)
    conditions: Mapping[str, Array | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "postures", np.atleast_2d(self.postures))
        object.__setattr__(self, "joint_types", JointKinds(self.joint_types or (REVOLUTE,) * self.links))
        super().__post_init__()

    def __len__(self) -> int:
        return len(self.postures)

    links = property(lambda self: int(self.postures.shape[1]))  # n, the number of joints

    # (m,) rows that are measured, no way-points
    is_run = property(lambda self: np.ones(len(self), dtype=bool) if self.via is None else ~self.via)
    measured = property(lambda self: self.postures[self.is_run])  # (r, n) postures without way-points

    @property
    def from_elsewhere(self) -> list[int]:
        """Runs, from 1, that a joint approaches from another side than the plan's file says."""
        if (asked := self.conditions.get("directions")) is None:
            return []
        motions = np.diff(self.postures, axis=0, prepend=self.postures[:1])  # to the first it may come from anywhere
        return (np.flatnonzero(np.any(motions * np.nan_to_num(asked) < 0.0, axis=1)[self.is_run]) + 1).tolist()

    def missed(self, beyond: Array, constraints: Sequence[Any], rounding: float) -> dict[int, str]:
        """Runs, from 1, outside joint limits or constraints -> which, and by how much;  beyond : (r, n) [rad, mm] how
        far joints are beyond their limits;  rounding : [mm] by which constraints may be missed"""
        columns = [(f"joint {j}", unit, beyond[:, j - 1], 1e-6) for j, unit in enumerate(self.units, start=1)]
        for each in constraints:
            unit = "mm" * each.kind.startswith(("workspace_box", "keep_out", "clearance"))  # others have no one unit
            columns.append((each.kind, unit, -each.margin(self.measured).min(axis=1, initial=np.inf), rounding))
        missed = dict[int, list[str]]()
        for name, unit, over, most in columns:
            for run in np.flatnonzero(over > most).tolist():
                amount = np.degrees(over[run]) if unit == "deg" else over[run]
                missed.setdefault(run + 1, []).append(name + f" by {in_a_sentence(amount)} {unit}" * bool(unit))
        return {run: ", ".join(missed[run]) for run in sorted(missed)}

    @property
    def shares(self) -> Array:
        """(m,) weight of every posture; 1/m for an exact plan."""
        return np.full(len(self), 1.0 / len(self)) if self.weights is None else self.weights

    @property
    def columns(self) -> Columns:
        """Name, with the unit in which it is shown, -> (m,) positions of each joint, as the controller counts."""
        return posture_columns(self.postures, self.joint_types)

    # (n) units in which joints are shown: deg, or mm
    units = property(lambda self: tuple(name.partition("_")[2] for name in self.columns))

    @property
    def headings(self) -> list[str]:
        """(n) `q1 [deg]` and so on."""
        return [f"q{joint} [{unit}]" for joint, unit in enumerate(self.units, start=1)]

    @property
    def displayed(self) -> Array:
        """(m, n) postures in `units`, as the controller counts."""
        return readonly(np.column_stack([*self.columns.values()]))

    def sheet(self, title: str, beside: Mapping[str, Sequence[str]], most: int | None = None) -> Sheet:
        """One row per run;  beside : further columns of ready text"""
        numbered = enumerate(zip(self.displayed, *beside.values(), strict=True), start=1)
        rows = [[str(run), *(f"{angle:.3f}" for angle in q), *more] for run, (q, *more) in numbered]
        return Sheet(["run", *self.headings, *beside], rows, title, most)

    def to_json(self) -> dict[str, Any]:
        """Keys `postures_deg`, or of an arm that slides `postures` and `joint_units`."""
        shown = self.displayed.tolist()
        return {"postures": shown, "joint_units": list(self.units)} if "mm" in self.units else {"postures_deg": shown}

    @classmethod
    def load(cls, path: PathLike, joints: Joints = None, *, carried_out: bool = False, vias: bool = False) -> Self:
        """The CSV file `run,q1_deg,...,qn_deg[,kind][,weight]`, `# fit: ...` above, with conditions of the rows.

        joints : how many the arm has, or the type of each: a prismatic one has a column `q1_mm`
        carried_out : the file is one of measurements, and has other columns
        vias : read the way-points of the moves too, where nothing is measured
        """
        table = read_table(path, vias=vias)
        kinds, weights, via, given = _joint_kinds(table, joints), None, None, _units_of(table, "sigma", LENGTH)
        postures = read_postures(table, kinds, planned=not carried_out)
        conditions = {"sigma": read_column(table, "sigma", LENGTH, SIGMA_RANGE) if carried_out and given else None}
        if vias and "kind" in table:
            via = (table.frame["kind"].str.strip_chars() == VIA).fill_null(False).to_numpy()
        if carried_out and "weight" in table:
            raise InputError(f"{path}: found weights, allowed: measurements, or an exact plan that was carried out")
        if not carried_out:
            if "weight" in table:
                weights = table.floats("weight", "a number >= 0", lambda v: v >= 0.0)
                if abs((total := float(np.sum(weights))) - 1.0) > 1e-6:
                    wrong = f"found a sum of {total:.9g}, allowed: 1 (within 1e-06)"
                    raise InputError(f"{table.path}: column weight: {wrong}")
            conditions = _conditions(table, kinds, ("payload_kg", "temperature_C"))
            directions = (f"direction{j + 1}" for j in range(len(kinds)))
            table.warn_unused(("run", "weight", "payload_kg", "temperature_C", "cup", *directions))
        cells = {name: table.frame[name].fill_null("").to_list() for name in table.frame.columns if name != "run"}
        return cls(postures, weights, kinds, table.fit, via, cells, conditions)

    @classmethod
    def of_displayed(cls, displayed: Array, joint_types: Sequence[str]) -> Self:
        """The plan whose `displayed` postures (m, n) are these."""
        kinds = JointKinds(joint_types)
        scaled = displayed * [next(iter(UNITS[QUANTITIES[kind]].values())) for kind in kinds]
        return cls(kinds.counting.joints(scaled), joint_types=kinds)

    def _repr_html_(self) -> str:
        columns = self.columns if self.weights is None else self.columns | {"weight": self.weights}
        rows = np.column_stack([*columns.values()]).tolist()
        cells = [[str(run), *(f"{x:.6g}" for x in row)] for run, row in enumerate(rows, start=1)]
        return html(Sheet(["run", *columns], cells))

    def text(self, further: Mapping[str, ArrayLike] | None = None) -> str:
        """The text of a plan file; `load` reads the same from it, to rounding (1e-14 rad).

        further : columns of names, one for each run

        With way-points directions no longer follow from the order of the measurements: they are columns then.
        """
        measured = self.is_run
        columns: Columns = {"run": np.where(measured, np.cumsum(measured), np.nan)}
        columns |= {} if self.via is None else {"kind": np.where(measured, MEASURE, VIA)}
        columns |= self.columns
        if not measured.all():
            shown = JointKinds(self.joint_types).counting.columns(self.postures)
            signs = np.where(measured[:, None], directions_from_order(np.round(shown, 9)), np.nan)
            columns |= {f"direction{j}": column for j, column in enumerate(signs.T, start=1)}
        for name, values in (further or {}).items():
            column = np.asarray(values)
            columns[name] = np.full(len(self), "" if column.dtype.kind == "U" else np.nan, dtype=column.dtype)
            columns[name][measured] = column
        return csv_text(columns if self.weights is None else columns | {"weight": self.weights}, self.fit)


# -- targets -----------------------------------------------------------------------------------------------------------
def load_targets(path: PathLike, arm: Arm) -> dict[str, Any]:
    """What the tip is to reach, as arguments of `compensate`: `targets` (k, d) [mm], nominal `postures` (k, n) [rad]
    and `orientations` (k, 3, 3) of the tool, by a CSV file with `x_mm, y_mm` (or `x_m, y_m`), of a spatial arm with
    `z_mm` too, and angles where these matter, or with `q1_deg..qn_deg`; None: the file does not say.

    With both, positions are the targets and postures say which of the many solutions to stay near.
    """
    table, axes = read_table(path), arm.chain.axes
    has_positions = any(f"{axis}_{unit}" in table for axis in axes for unit in UNITS[LENGTH])
    has_postures = bool(_joint_columns(table))
    if not has_positions and not has_postures:
        allowed = f"{', '.join(f'{axis}_mm' for axis in axes)}, or q1_deg..q{arm.links}_deg"
        raise InputError(f"{path}: found columns {', '.join(table.frame.columns)}, allowed: {allowed}")
    positions = np.column_stack([read_column(table, axis, LENGTH) for axis in axes]) if has_positions else None
    postures = read_postures(table, arm.joint_types, planned=True) if has_postures else None
    orientations = read_orientations(table) if has_positions and arm.chain.point_column else None
    table.warn_unused(["run"])
    return {"targets": positions, "postures": postures, "orientations": orientations}
