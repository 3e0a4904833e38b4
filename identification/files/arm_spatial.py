"""Spatial arms in arm files, `kind = "spatial"`: a URDF file or Denavit-Hartenberg tables -> `Arm.of_chain`."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from identification.arm import Arm, Calibration, Machining
from identification.arrays import Array, readonly
from identification.errors import InputError, nearest
from identification.files.arm_effects import (
    FileName,
    calibrated_effects,
    check_tables,
    covariance_of,
    effects_of,
    file_names,
    gravity_of,
    with_geometry,
)
from identification.files.arm_schema_spatial import (
    SPATIAL,
    TOOLS,
    AnglesTable,
    CylinderTable,
    MachiningTable,
    PoseTable,
    SpatialArmFile,
    SpatialBoxTable,
    SpatialCalibrationTable,
    SpatialConstraint,
    SpatialMeasurementTable,
    SphereTable,
    TravelsTable,
)
from identification.files.io import PathLike, named_file, read_toml
from identification.files.joint_counting import counting_of, limits_of_joints
from identification.files.schema import require_count
from identification.files.urdf import Urdf, parse_urdf, read_urdf, urdf_text, with_origins
from identification.kinematics.corrected import before_errors
from identification.kinematics.counting import Counting
from identification.kinematics.denavit_hartenberg import STANDARD, DHRow, chain_of
from identification.kinematics.frames import from_own_axes, pose, rotation_to_z
from identification.kinematics.instrument import Instrument
from identification.kinematics.parameters import GEOMETRY, PRISMATIC, REVOLUTE
from identification.kinematics.spatial import BASE, TOOL, Joint, SpatialChain
from identification.workspace import (
    ColumnLimits,
    KeepOutCircle,
    KeepOutCylinder,
    LineOfSight,
    WorkspaceBox,
    WorkspaceConstraint,
)


def spatial_arm(tables: Mapping[str, Any], folder: PathLike) -> Arm:
    """The arm of parsed TOML; raises `InputError` naming key, what was found and what is allowed.

    folder : where the URDF file is
    """
    file: SpatialArmFile = SPATIAL.validated(tables)
    chain = _standing(file, _chain(file, folder))
    joints = len(chain)
    file.require_counts(joints)
    constraints: list[WorkspaceConstraint] = [_constraint(table) for table in file.constraints]
    if (counting := counting_of(file.joints, chain.joint_types)) is not None:
        chain, tied = _of_columns(file, chain, counting)
        constraints += tied
    effects = effects_of(file.effects, joints, chain.dimension)
    check_tables(file.gravity, effects, file.instrument)
    table, calibration = file.calibration, None
    if table is not None:
        chain = _with_markers(chain, table)
        calibration = _calibration(table, chain, file_names(chain.parameters(), effects))
        axes = calibration.tool_axes if chain.angle_scale is not None else {}
        chain = before_errors(chain, calibration.values, calibration.base, calibration.tools, axes)
    return Arm.of_chain(
        chain,
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=gravity_of(file.gravity, joints),
        constraints=tuple(constraints),
        counting=counting,
        effects=with_geometry(effects, file.effects, chain.every_parameter),
        calibration=calibration,
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
        machining=_machining(file.machining),
    )


# -- geometry ----------------------------------------------------------------------------------------------------------
def urdf_of(tables: Mapping[str, Any], folder: PathLike) -> tuple[Urdf, str, str] | None:
    """The URDF file that the tables of an arm file name or contain, with base and tip link; None without one."""
    name = tables.get("urdf")
    if not isinstance(name, str):
        return None
    if name.lstrip().startswith("<"):
        return parse_urdf(name, "urdf"), str(tables["base_link"]), str(tables["tip_link"])
    return (
        read_urdf(named_file(folder, name, "urdf", "the arm file")),
        str(tables["base_link"]),
        str(tables["tip_link"]),
    )


def urdf_masses(path: PathLike) -> tuple[float, ...] | None:
    """[kg] of the links, from the URDF file that an arm file names; None without one, or where it gives no mass."""
    named = urdf_of(read_toml(path), Path(path).parent)
    masses = () if named is None else named[0].masses(*named[1:])
    return masses if any(masses) else None


def corrected_urdf(path: PathLike, chain: SpatialChain) -> str:
    """The URDF file that an arm file names, with the origins of a corrected chain; a bare one where it names none."""
    tables = read_toml(path)
    if (named := urdf_of(tables, Path(path).parent)) is None:
        return urdf_text(chain, str(tables.get("name", "arm")))
    return with_origins(*named, [joint.origin for joint in chain.joints])


def dh_rows(path: PathLike) -> tuple[list[DHRow], str] | None:
    """Rows and convention of the `[[dh]]` table of an arm file; None where it has none."""
    tables = read_toml(path).get("dh")
    if not isinstance(tables, list):
        return None
    rows = [
        DHRow(
            float(row.get("a_mm", 0.0)),
            float(np.radians(row.get("alpha_deg", 0.0))),
            float(row.get("d_mm", 0.0)),
            float(np.radians(row.get("offset_deg", 0.0))),
            row.get("joint", REVOLUTE),
        )
        for row in tables
    ]
    return rows, next((row["convention"] for row in tables if row.get("convention")), STANDARD)


def _chain(file: SpatialArmFile, folder: PathLike) -> SpatialChain:
    """The nominal geometry with its joint limits."""
    if file.dh is None:
        found = urdf_of(file.model_dump(include={"urdf", "base_link", "tip_link"}), folder)
        assert found is not None
        urdf, base, tip = found
        tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
        chain = urdf.chain(base, tip, [kind for kind, table in tables.items() if table is not None])
    else:
        given = dict.fromkeys(row.convention for row in file.dh if row.convention)
        if len(given) > 1:
            raise InputError(f"dh: found conventions {' and '.join(given)}, allowed: one for all rows")
        chain = chain_of([_row(file, k) for k in range(len(file.dh))], next(iter(given), STANDARD))
    joints = _limited(chain.joints, REVOLUTE, "joint_limits_deg", file.joint_limits_deg, np.pi / 180.0)
    joints = _limited(joints, PRISMATIC, "joint_limits_mm", file.joint_limits_mm, 1.0)
    return replace(chain, joints=joints)


def _row(file: SpatialArmFile, k: int) -> DHRow:
    """Row k of `[[dh]]`; limits of a prismatic joint are set later, those here stand for some."""
    row = (file.dh or [])[k]
    if row.joint == PRISMATIC and file.joint_limits_mm is None:
        found = "a prismatic joint without limits"
        raise InputError(f"dh[{k + 1}]: {found}, allowed: lower and upper in [joint_limits_mm]")
    alpha, offset = np.radians((row.alpha_deg, row.offset_deg))
    return DHRow(row.a_mm, float(alpha), row.d_mm, float(offset), row.joint, (-np.pi, np.pi))


def _limited(
    joints: Iterable[Joint], kind: str, key: str, table: AnglesTable | TravelsTable | None, factor: float
) -> tuple[Joint, ...]:
    """The joints, those of a kind with the limits of a table, in order."""
    if table is None:
        return tuple(joints)
    found = list(joints)
    own = [k for k, joint in enumerate(found) if joint.type == kind]
    for name, values in (("lower", table.lower), ("upper", table.upper)):
        require_count(f"{key}.{name}", values, len(own), whose=f"{kind} joints")
    for k, lower, upper in zip(own, table.lower, table.upper, strict=True):
        found[k] = replace(found[k], lower=lower * factor, upper=upper * factor)
    return tuple(found)


def _of_columns(
    file: SpatialArmFile, chain: SpatialChain, counting: Counting
) -> tuple[SpatialChain, list[ColumnLimits]]:
    """The chain whose limits from tables of the file, which are the controller's, are those of its joints, and the
    controller's of coupled joints; limits of a URDF are the joints' already."""
    tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
    given = [tables[kind] is not None for kind in chain.joint_types]
    limits = np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    lower, upper, tied = limits_of_joints(counting, chain.joint_types, *limits)
    joints = tuple(
        replace(joint, lower=float(low), upper=float(high)) if own else joint
        for joint, low, high, own in zip(chain.joints, lower, upper, given, strict=True)
    )
    return replace(chain, joints=joints), [each for each in tied if given[each.joint - 1]]


def _standing(file: SpatialArmFile, chain: SpatialChain) -> SpatialChain:
    """With base and measured points, where the file gives them."""
    if file.base is not None:
        chain = replace(chain, base=_pose(file.base), known=chain.known | {BASE})
    if file.tool is not None:
        tools, axes = _tools(file.tool)
        chain = replace(chain, tools=tools, tool_axes=axes, known=chain.known | {TOOL})
    if (table := file.instrument) is None:
        return replace(chain, angle_scale=_angle_scale(file.measurement))
    if table.center_mm is not None:
        normal = np.array([0.0, 0.0, 1.0] if table.normal is None else table.normal, dtype=float)
        turn = rotation_to_z(normal / np.linalg.norm(normal)).T
        chain = replace(chain, base=pose(-turn @ np.array(table.center_mm), turn))
    return replace(chain, instrument=Instrument(table.kind, table.radius_mm))


def _angle_scale(table: SpatialMeasurementTable | None) -> float | None:
    """[mm/rad] of orientations, whose residuals weigh as much as those of positions; None: they are not measured."""
    if table is None or table.sigma_deg is None:
        return None
    if table.sigma_mm is None:
        found = (
            "found without sigma_mm: orientations are not used; what a degree weighs against a millimetre is not known"
        )
        warnings.warn(f"measurement.sigma_deg: {found}", UserWarning, stacklevel=2)
        return None
    return table.sigma_mm / float(np.radians(table.sigma_deg))


def _pose(table: PoseTable) -> Array:
    angles = np.radians((table.rx_deg, table.ry_deg, table.rz_deg)).tolist()
    return pose((table.x_mm, table.y_mm, table.z_mm), from_own_axes(*angles))


def _tools(table: Mapping[str, Any], place: str = "tool") -> tuple[dict[str, Array], dict[str, Array]]:
    """Name -> (3,) point of `[tool]`, which is of marker 1, or of `[tool.MARKER]`; and name -> its (3, 3) axes."""
    several = table and all(isinstance(value, dict) for value in table.values())
    points = (
        {name: (f"{place}.{name}.", value) for name, value in table.items()} if several else {"1": ("tool.", table)}
    )
    read = {name: _pose(TOOLS.validated(value, where)) for name, (where, value) in points.items()}
    places = {name: readonly(found[:3, 3]) for name, found in read.items()}
    return places, {name: readonly(found[:3, :3]) for name, found in read.items()}


# -- what else the file says -------------------------------------------------------------------------------------------
def _machining(table: MachiningTable | None) -> Machining:
    usual = Machining()
    if table is None:
        return usual
    rotation = usual.rotation if table.rotation_deg is None else float(np.radians(table.rotation_deg))
    return Machining(usual.translation if table.translation_mm is None else table.translation_mm, rotation)


def _constraint(table: SpatialConstraint) -> WorkspaceConstraint:
    if isinstance(table, SpatialBoxTable):
        return WorkspaceBox(_pair(table.x_mm), _pair(table.y_mm), _pair(table.z_mm))
    if isinstance(table, SphereTable):
        return KeepOutCircle(tuple(table.center_mm), table.radius_mm)
    if isinstance(table, CylinderTable):
        return KeepOutCylinder(_triple(table.start_mm), _triple(table.end_mm), table.radius_mm)
    half, accepted = np.radians((table.half_angle_deg, table.acceptance_deg or 90.0)).tolist()
    facing = None if table.facing is None else _triple(table.facing)
    reach = None if table.range_mm is None else _pair(table.range_mm)
    return LineOfSight(tuple(table.tracker_mm), half, tuple(table.toward_mm), reach, facing, accepted)


def _pair(values: list[float]) -> tuple[float, float]:
    return values[0], values[1]


def _triple(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


# -- calibration -------------------------------------------------------------------------------------------------------
def _with_markers(chain: SpatialChain, table: SpatialCalibrationTable) -> SpatialChain:
    """With the measured points of the calibration, where the file does not give them as known."""
    if TOOL in chain.known or not table.tools:
        return chain
    tools, axes = _tools(table.tools, "calibration.tools")
    return replace(chain, tools=tools, tool_axes=axes)


def _calibration(table: SpatialCalibrationTable, chain: SpatialChain, names: list[FileName]) -> Calibration:
    if table.base is not None and BASE in chain.known:
        raise InputError("calibration.base: found beside [base], allowed: one of them")
    if table.tools and TOOL in chain.known:
        raise InputError("calibration.tools: found beside [tool], allowed: one of them")
    geometry = {name.file: name for name in names if GEOMETRY.fullmatch(name.file)}
    values = {}
    for key, value in table.values.items():
        if key not in geometry:
            raise InputError(f"calibration.values: unknown parameter {key!r}, {nearest(key, geometry)}")
        values[key] = value / geometry[key].factor
    of_effects = [name for name in names if name.file not in geometry]
    order, covariance = covariance_of(table, names)
    return Calibration(
        values | calibrated_effects(table, of_effects),
        order,
        covariance,
        MappingProxyType(dict(table.provenance)),
        None if table.base is None else _pose(table.base),
        dict(chain.tools) if (found := table.tools and TOOL not in chain.known) else {},
        dict(chain.tool_axes) if found and chain.angle_scale is not None else {},
    )
