"""Arm files, reading: TOML in millimetres and degrees -> `Arm` in millimetres and radians (`arm_text` writes).

The geometry is that of lengths of links, of a URDF file or of a Denavit-Hartenberg table. Keys of files end with their
unit, names of our classes are the same without it: `in_api` reads `half_angle_deg` [deg] as `half_angle` [rad].
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel

from identification.arm import Arm, Calibration, EffectSpec, Gravity, Machining
from identification.arrays import Array, readonly
from identification.error_curve import ErrorCurve
from identification.errors import InputError, nearest
from identification.files.io import PathLike, named_file, read_toml
from identification.files.schema import (
    ArmFile,
    CalibrationTable,
    DHTable,
    EffectTable,
    PoseTable,
    require_count,
    validated_arm,
)
from identification.files.urdf import Urdf, parse_urdf, read_urdf, urdf_text, with_origins
from identification.instruments import kinds
from identification.kinematics.chain import BASE, STANDARD, TOOL, DHRow, KinematicChain, chain_of, planar_chain
from identification.kinematics.corrected import before_errors
from identification.kinematics.counting import Counting, check_kinds
from identification.kinematics.frames import from_own_axes, pose, rotation_to_z
from identification.kinematics.parameters import (
    FILE_UNITS,
    GEOMETRY,
    JOINT_OFFSET,
    JOINT_UNITS,
    LENGTH_ERROR,
    PRISMATIC,
    REVOLUTE,
    Parameter,
)
from identification.workspace import ColumnLimits, KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox

if TYPE_CHECKING:
    from identification.effects import Effect

CURVE, CURVE_KEYS, GEOMETRY_KEY = "joint_error_curve", ("from_deg", "to_deg", "values_deg"), "geometry"
MARKER = re.compile(r"tool\[.*\]\.(r?)[xyz]")
UNIT = re.compile(r"_(mm|deg|kg|m_s2)$")
RENAMED = {"range_mm": "reach"}  # keys that are called otherwise in our classes
CONSTRAINTS = {each.kind: each for each in (WorkspaceBox, KeepOutCircle, KeepOutCylinder, LineOfSight)}
CONSTRAINTS["keep_out_sphere"] = KeepOutCircle


def load_arm(path: PathLike) -> Arm:
    """The arm that a TOML file describes.

    Raises `InputError`, one line naming file, key, what was found and what is allowed. Warns (`UserWarning`) when the
    joint limits look like radians.
    """
    tables = read_toml(path)
    try:
        arm = arm_from_tables(tables, Path(path).parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    limits = tables.get("joint_limits_deg") or {}
    values = [abs(value) for key in ("lower", "upper") for value in limits.get(key, ())]
    if values and max(values) <= 2.0 * np.pi + 0.01:
        message = "joint_limits_deg: all limits are within 6.3 deg and look like radians; write them in degrees"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=2)
    return arm


def arm_from_tables(tables: dict[str, Any], folder: PathLike = ".") -> Arm:
    """The arm of parsed TOML; raises `InputError` as `load_arm` does, without the file's name.

    folder : where the files are that the tables name
    """
    file = validated_arm(tables)
    chain = _drawn_chain(file, folder)
    n = len(chain)
    file.require_counts(n)
    constraints = [CONSTRAINTS[table.kind](**in_api(table, "kind")) for table in file.constraints]
    counting = None
    if file.joints is not None:  # what it leaves out is as usual
        usual: dict[str, Any] = {"sign": (1,) * n, "coupled_to": (0,) * n, "zero": (0.0,) * n}
        counting = Counting(**usual | in_api(file.joints))
        check_kinds(counting, chain.joint_types)
    lower, upper, tied = _joint_limits(file, chain, counting)
    effects = built([_spec(table, k, chain) for k, table in enumerate(file.effects, start=1)], chain)
    state = f"an [instrument] of kind {chain.instrument.kind}" if file.instrument else "no [instrument] table"
    for spec, effect in effects:
        if effect.of_positions and file.instrument:
            raise InputError(f"effects: {spec.key} is of measured positions, found {state}, allowed: without it")
        if "distance" in effect.needs - chain.instrument.offers:
            raise InputError(f"effects: {spec.key} needs measured distances, found {state}, allowed: kind distance")
        if "gravity" in effect.needs and file.gravity is None:
            raise InputError(f"effects: {spec.key} needs gravity torques, found no [gravity] table, allowed: with one")
    if file.links_mm is None:  # so that they stand in its URDF file
        limits = zip(chain.joints, lower.tolist(), upper.tolist(), strict=True)
        chain = replace(chain, joints=tuple(replace(joint, lower=low, upper=high) for joint, low, high in limits))
    calibration = None
    if (table := file.calibration) is not None:
        if table.tools:  # which the file has where they are not known
            chain = _with_tools(chain, table.tools)
        calibration = _calibration(table, file_names(chain.parameters(), effects))
        base, tools = None if table.base is None else _pose(table.base), dict(chain.tools) if table.tools else {}
        axes = dict(chain.tool_axes) if tools and chain.angle_scale is not None else {}
        calibration = replace(calibration, base=base, tools=tools, tool_axes=axes)
        chain = before_errors(chain, calibration.values, base, tools, axes)
    gravity = None if file.gravity is None else {"center_of_mass": (0.5,) * n} | in_api(file.gravity)
    return Arm(
        chain,
        lower=lower,
        upper=upper,
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=None if gravity is None else Gravity(**gravity),
        constraints=(*constraints, *tied),
        effects=_with_geometry(effects, file.effects, chain.every_parameter),
        calibration=calibration,
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
        machining=Machining() if file.machining is None else Machining(**in_api(file.machining)),
        counting=counting,
    )


def in_api(table: BaseModel, *without: str) -> dict[str, Any]:
    """What a table has, by the names of our classes, angles in radians, several numbers as a tuple.

    without : keys that are left out
    """
    values = {}
    for key, value in table.model_dump(exclude_none=True, exclude=set(without)).items():
        value = np.radians(value).tolist() if key.endswith("_deg") else value
        values[RENAMED.get(key) or UNIT.sub("", key)] = tuple(value) if isinstance(value, list) else value
    return values


# -- geometry ----------------------------------------------------------------------------------------------------------
def _drawn_chain(file: ArmFile, folder: PathLike) -> KinematicChain:
    """The geometry as drawn, with base and measured points where the file gives them; joint limits of the URDF.

    folder : where the URDF file is
    """
    if file.links_mm is not None:
        chain = planar_chain(file.links_mm)
    elif file.dh is None:
        tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
        limited = [kind for kind, table in tables.items() if table is not None]
        chain = _urdf(str(file.urdf), folder).chain(str(file.base_link), str(file.tip_link), limited)
    else:
        conventions = dict.fromkeys(row.convention for row in file.dh if row.convention)
        if len(conventions) > 1:
            raise InputError(f"dh: found conventions {' and '.join(conventions)}, allowed: one for all rows")
        for k, row in enumerate(file.dh, start=1):
            if row.joint == PRISMATIC and file.joint_limits_mm is None:
                missing = "a prismatic joint without limits"
                raise InputError(f"dh[{k}]: {missing}, allowed: lower and upper in [joint_limits_mm]")
        chain = chain_of(
            [replace(_row(row), limits=(-np.pi, np.pi)) for row in file.dh], next(iter(conventions), STANDARD)
        )
    if file.base is not None:
        chain = replace(chain, base=_pose(file.base), settled=chain.settled | {BASE})
    if file.tool is not None:
        chain = replace(_with_tools(chain, file.tool), settled=chain.settled | {TOOL})
    if (table := file.instrument) is None:
        sigma = file.measurement
        if sigma is None or sigma.sigma_deg is None:
            return replace(chain, angle_scale=None)
        if sigma.sigma_mm is None:
            unused = "orientations are not used; what a degree weighs against a millimetre is not known"
            warnings.warn(f"measurement.sigma_deg: found without sigma_mm: {unused}", UserWarning, stacklevel=2)
            return replace(chain, angle_scale=None)
        # residuals of orientations weigh as much as those of positions
        return replace(chain, angle_scale=sigma.sigma_mm / float(np.radians(sigma.sigma_deg)))
    instrument = kinds(chain.axes)[table.kind].of_table(table.model_dump(exclude_none=True))
    if file.base is not None and instrument.own_targets:
        raise InputError(f"base: found with an [instrument] of kind {table.kind}, allowed: left out, it is the frame")
    if table.center_mm is not None and not instrument.own_targets:
        normal = np.array([0.0, 0.0, 1.0] if table.normal is None else table.normal, dtype=float)
        turn = rotation_to_z(normal / np.linalg.norm(normal)).T
        chain = replace(chain, base=pose(-turn @ np.array(table.center_mm), turn))
    return replace(chain, instrument=instrument)


def _urdf(name: str, folder: PathLike) -> Urdf:
    """The URDF file that an arm file names, or its text."""
    if name.lstrip().startswith("<"):
        return parse_urdf(name, "urdf")
    return read_urdf(named_file(folder, name, "urdf", "the arm file"))


def _row(table: DHTable) -> DHRow:
    return DHRow(table.a_mm, math.radians(table.alpha_deg), table.d_mm, math.radians(table.offset_deg), table.joint)


def _pose(table: PoseTable) -> Array:
    angles = np.radians((table.rx_deg, table.ry_deg, table.rz_deg)).tolist()
    return pose((table.x_mm, table.y_mm, table.z_mm), from_own_axes(*angles))


def _with_tools(chain: KinematicChain, tables: Mapping[str, PoseTable]) -> KinematicChain:
    """With measured points, by the names of their markers, of which a single one may have none."""
    poses = {name or "1": _pose(table) for name, table in tables.items()}
    tools = {name: readonly(matrix[:3, 3]) for name, matrix in poses.items()}
    return replace(chain, tools=tools, tool_axes={name: readonly(matrix[:3, :3]) for name, matrix in poses.items()})


def urdf_masses(path: PathLike) -> tuple[float, ...] | None:
    """[kg] of the links, from the URDF file that an arm file names; None without one, or where it gives no mass."""
    tables = read_toml(path)
    if not isinstance(name := tables.get("urdf"), str):
        return None
    masses = _urdf(name, Path(path).parent).masses(str(tables["base_link"]), str(tables["tip_link"]))
    return masses if any(masses) else None


def corrected_urdf(path: PathLike, chain: KinematicChain) -> str:
    """The URDF file that an arm file names, with the origins of a corrected chain; a bare one where it names none."""
    tables = read_toml(path)
    if not isinstance(name := tables.get("urdf"), str):
        return urdf_text(chain, str(tables.get("name", "arm")))
    urdf, ends = _urdf(name, Path(path).parent), (str(tables["base_link"]), str(tables["tip_link"]))
    return with_origins(urdf, *ends, [joint.origin for joint in chain.joints])


def dh_rows(path: PathLike) -> tuple[list[DHRow], str] | None:
    """Rows and convention of the `[[dh]]` table of an arm file; None where it has none."""
    if (tables := validated_arm(read_toml(path)).dh) is None:
        return None
    return [_row(table) for table in tables], next((table.convention for table in tables if table.convention), STANDARD)


# -- joints ------------------------------------------------------------------------------------------------------------
def _joint_limits(
    file: ArmFile, chain: KinematicChain, counting: Counting | None
) -> tuple[Array, Array, list[ColumnLimits]]:
    """(n,) lower and (n,) upper limits of the joints [rad, mm], and the controller's of joints that it couples.

    Limits in tables of the file are the controller's, those of the chain, as of a URDF, are the joints' already.
    """
    kinds, drawn = chain.joint_types, np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    limits, written, tied = drawn.copy(), np.zeros(len(kinds), dtype=bool), []
    for kind, table in ((REVOLUTE, file.joint_limits_deg), (PRISMATIC, file.joint_limits_mm)):
        if table is not None:
            joints = np.array([other == kind for other in kinds])
            unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
            for side, values in enumerate((table.lower, table.upper)):
                key = f"joint_limits_{unit}.{('lower', 'upper')[side]}"
                require_count(key, values, int(joints.sum()), whose=f"{kind} joints")
                limits[side, joints] = np.array(values) / factor
            written |= joints
    if counting is not None:
        for j, (low, high) in enumerate(limits.T):
            if low >= high:
                unit, factor, _ = FILE_UNITS[JOINT_UNITS[kinds[j]]]
                order = f"joint {j + 1} has lower {low * factor:g} >= upper {high * factor:g}"
                raise InputError(f"joint_limits_{unit}: {order}, allowed: lower < upper")
        for j in filter(written.__getitem__, counting.coupled):
            ends = sorted((counting.sign[j] * (limits[:, j] - counting.zero[j])).tolist())
            tied.append(ColumnLimits(j + 1, tuple((counting.sign[j] * counting.matrix[j]).tolist()), *ends))
        limits = np.where(written, counting.joint_limits(*limits), limits)
    return limits[0], limits[1], tied


# -- effects -----------------------------------------------------------------------------------------------------------
class FileName(NamedTuple):
    """How a parameter is called in files: API name, name in the file, and the factor from API to file unit."""

    api: str
    file: str
    factor: float


def built(specs: Iterable[EffectSpec], chain: KinematicChain) -> list[tuple[EffectSpec, Effect]]:
    """Specs with their effects on an arm. Raises `InputError` for effects that it cannot have."""
    if not (listed := list(specs)):
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(listed, build_all(listed, chain), strict=True))


def file_names(geometry: Iterable[Parameter], effects: Iterable[tuple[EffectSpec, Effect]]) -> list[FileName]:
    """All parameters of a calibration: those of the geometry (`joint_offset:1` in deg), then those of effects."""
    names = [FileName(p.name, p.name, p.to_file) for p in geometry]
    for _, effect in effects:
        names += [FileName(p.name, f"{effect.key}.{p.toml_key}", p.to_file) for p in effect.parameters]
    return names


def curve_name(key: str, names: Mapping[str, FileName], place: str) -> FileName:
    """Of a parameter in the geometry of a curve: one of `names`, or of a measured point of any name."""
    if key not in names and (point := MARKER.fullmatch(key)):
        return FileName(key, key, math.degrees(1.0) if point[1] else 1.0)
    return _named(names, key, place)


def _named(names: Mapping[str, FileName], key: str, place: str, without: str = "") -> FileName:
    """The parameter of this name. Raises `InputError` for another;  without : what is allowed without any names."""
    if key not in names:
        raise InputError(f"{place}: unknown parameter {key!r}, {nearest(key, names) if names else without}")
    return names[key]


def _spec(table: EffectTable, k: int, chain: KinematicChain) -> EffectSpec:
    """An entry of `[[effects]]`, the k-th from 1; values in API units."""
    from identification.effects import build, library

    place = f"effects[{k}]"
    settings = getattr(library().get(table.name), "settings", {})
    curve = _curve(table, place)
    values = {key: value for key, value in table.parameters.items() if key in settings}
    effect = build(EffectSpec(table.name, table.joint, MappingProxyType(values), curve), chain)
    parameters = {p.toml_key: p for p in effect.parameters}
    for key in table.parameters.keys() - settings.keys():
        if key not in parameters:
            hint = nearest(key, ["name", "joint", *parameters, *settings])
            raise InputError(f"{place}.{key}: unknown key of {table.name}, {hint}")
        value, parameter = table.parameters[key], parameters[key]
        low, high = parameter.lower * parameter.to_file, parameter.upper * parameter.to_file
        if not low <= value <= high:
            allowed = f">= {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
            raise InputError(f"{place}.{key}: found {value:g}, allowed: a number {allowed}")
        values[parameter.short] = value / parameter.to_file
    return EffectSpec(table.name, table.joint, MappingProxyType(values), curve)


def _curve(table: EffectTable, place: str) -> ErrorCurve | None:
    """The table of values of a `joint_error_curve`; raises `InputError` for one of another effect, or a part of one."""
    for key in (*CURVE_KEYS, GEOMETRY_KEY):
        value = getattr(table, key)
        if value is not None and table.name != CURVE:
            raise InputError(f"{place}.{key}: unknown key of {table.name}, allowed: for {CURVE} only")
        if value is None and table.name == CURVE and key != GEOMETRY_KEY:
            raise InputError(f"{place}.{key}: is missing, allowed: as `armcal diagnose --out` writes it")
    if table.from_deg is None or table.to_deg is None or table.values_deg is None:
        return None
    try:
        return ErrorCurve(math.radians(table.from_deg), math.radians(table.to_deg), np.radians(table.values_deg))
    except InputError as error:
        raise InputError(f"{place}.{error}") from None


def _with_geometry(
    effects: Sequence[tuple[EffectSpec, Effect]], tables: Sequence[EffectTable], geometry: Iterable[Parameter]
) -> tuple[EffectSpec, ...]:
    """The specs of a file's effects, curves with the geometry that was fitted with them, in API units.

    geometry : parameters of the chain. Raises `InputError` for names that are none of a parameter
    """
    by_file, specs = {name.file: name for name in file_names(geometry, effects)}, []
    for k, ((spec, _), table) in enumerate(zip(effects, tables, strict=True), start=1):
        if spec.curve is not None and table.geometry:
            names = {key: curve_name(key, by_file, f"effects[{k}].{GEOMETRY_KEY}") for key in table.geometry}
            values = {name.api: table.geometry[key] / name.factor for key, name in names.items()}
            spec = replace(spec, curve=replace(spec.curve, geometry=values))
        specs.append(spec)
    return tuple(specs)


# -- calibration -------------------------------------------------------------------------------------------------------
def _calibration(table: CalibrationTable, names: Sequence[FileName]) -> Calibration:
    """In API units; raises `InputError` for parameters that the file's arm and effects do not have."""
    by_file = {name.file: name for name in names}
    geometry = {key: name for key, name in by_file.items() if GEOMETRY.fullmatch(key)}
    effects = {key: name for key, name in by_file.items() if key not in geometry}
    lists = ((LENGTH_ERROR, table.length_errors_mm), (JOINT_OFFSET, table.joint_offsets_deg))
    of_links = {f"{kind}:{j}": value for kind, list_ in lists for j, value in enumerate(list_ or (), start=1)}
    values = {}
    without = "allowed: parameters of effects that the file has under [[effects]]"
    for place, entries, allowed in (
        ("values", of_links | (table.values or {}), geometry),
        ("effects", table.effects, effects),
    ):
        for key, value in entries.items():
            name = _named(allowed, key, f"calibration.{place}", without)
            values[name.api] = value / name.factor
    order = [_named(by_file, key, "calibration.parameters") for key in table.parameters or ()]
    factors = np.array([name.factor for name in order])
    matrix = None if table.covariance is None else np.array(table.covariance).reshape(len(order), len(order))
    return Calibration(
        values,
        tuple(name.api for name in order),
        None if matrix is None else matrix / np.outer(factors, factors),
        MappingProxyType(dict(table.provenance)),
    )
