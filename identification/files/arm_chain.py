"""The geometry of spatial arms in arm files, `kind = "spatial"`: tables and URDF files <-> `SpatialChain`."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from identification.arm import Arm, Calibration, Machining
from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.files.io import PathLike, named_file, read_toml
from identification.files.schema import ArmFile, CalibrationTable, MeasurementTable, PoseTable
from identification.files.urdf import BASE_LINK, TIP, Urdf, parse_urdf, read_urdf, urdf_text, with_origins
from identification.instruments import IN_PLANE, KINDS
from identification.kinematics.corrected import before_errors, standing_in
from identification.kinematics.denavit_hartenberg import STANDARD, DHRow, chain_of
from identification.kinematics.frames import from_own_axes, pose, pose_table, rotation_to_z, tool_tables
from identification.kinematics.parameters import PRISMATIC, REVOLUTE
from identification.kinematics.spatial import BASE, TOOL, SpatialChain, planar_chain

FREE = (-np.pi, np.pi)


# -- reading -----------------------------------------------------------------------------------------------------------
def nominal_chain(file: ArmFile, folder: PathLike) -> SpatialChain:
    """The geometry as drawn, with base and measured points where the file gives them; joint limits of the URDF.

    folder : where the URDF file is
    """
    if file.dh is None:
        urdf, base, tip = _urdf(str(file.urdf), folder), str(file.base_link), str(file.tip_link)
        tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
        chain = urdf.chain(base, tip, [kind for kind, table in tables.items() if table is not None])
    else:
        conventions = dict.fromkeys(row.convention for row in file.dh if row.convention)
        if len(conventions) > 1:
            raise InputError(f"dh: found conventions {' and '.join(conventions)}, allowed: one for all rows")
        for k, row in enumerate(file.dh, start=1):
            if row.joint == PRISMATIC and file.joint_limits_mm is None:
                missing = "a prismatic joint without limits"
                raise InputError(f"dh[{k}]: {missing}, allowed: lower and upper in [joint_limits_mm]")
        rows = [replace(_row(row.model_dump()), limits=FREE) for row in file.dh]
        chain = chain_of(rows, next(iter(conventions), STANDARD))
    if file.base is not None:
        chain = replace(chain, base=_pose(file.base), known=chain.known | {BASE})
    if file.tool is not None:
        chain = replace(_with_tools(chain, file.tool), known=chain.known | {TOOL})
    if (table := file.instrument) is None:
        return replace(chain, angle_scale=_angle_scale(file.measurement))
    instrument = KINDS[table.kind].of_table(table.model_dump(exclude_none=True))
    if file.base is not None and instrument.own_targets:
        raise InputError(f"base: found with an [instrument] of kind {table.kind}, allowed: left out, it is the frame")
    if table.center_mm is not None:
        normal = np.array([0.0, 0.0, 1.0] if table.normal is None else table.normal, dtype=float)
        turn = rotation_to_z(normal / np.linalg.norm(normal)).T
        chain = replace(chain, base=pose(-turn @ np.array(table.center_mm), turn))
    return replace(chain, instrument=instrument)


def of_links(file: ArmFile) -> SpatialChain:
    """The planar arm as drawn, with what is measured of it."""
    chain = planar_chain(file.links_mm or ())
    if (table := file.instrument) is None:
        return chain
    return replace(chain, instrument=IN_PLANE[table.kind].of_table(table.model_dump(exclude_none=True)))


def with_limits(chain: SpatialChain, lower: Array, upper: Array) -> SpatialChain:
    """With joint limits (n,) [rad, mm]."""
    limits = zip(chain.joints, lower.tolist(), upper.tolist(), strict=True)
    return replace(chain, joints=tuple(replace(joint, lower=low, upper=high) for joint, low, high in limits))


def with_measured_points(chain: SpatialChain, table: CalibrationTable | None) -> SpatialChain:
    """With the measured points of a calibration, which the file has where they are not known."""
    return chain if table is None or not table.tools else _with_tools(chain, table.tools)


def before_calibration(
    chain: SpatialChain, calibration: Calibration, table: CalibrationTable
) -> tuple[SpatialChain, Calibration]:
    """The chain that its errors bring to where base and measured points were identified, and the calibration with
    these."""
    base, tools = None if table.base is None else _pose(table.base), dict(chain.tools) if table.tools else {}
    axes = dict(chain.tool_axes) if tools and chain.angle_scale is not None else {}
    calibration = replace(calibration, base=base, tools=tools, tool_axes=axes)
    return before_errors(chain, calibration.values, base, tools, axes), calibration


def _urdf(name: str, folder: PathLike) -> Urdf:
    """The URDF file that an arm file names, or its text."""
    if name.lstrip().startswith("<"):
        return parse_urdf(name, "urdf")
    return read_urdf(named_file(folder, name, "urdf", "the arm file"))


def _row(table: Mapping[str, Any]) -> DHRow:
    """A table of `[[dh]]`."""
    lengths, angles = (
        [float(table.get(key, 0.0)) for key in keys] for keys in (("a_mm", "d_mm"), ("alpha_deg", "offset_deg"))
    )
    alpha, offset = np.radians(angles).tolist()
    return DHRow(lengths[0], alpha, lengths[1], offset, table.get("joint", REVOLUTE))


def _angle_scale(table: MeasurementTable | None) -> float | None:
    """[mm/rad] of orientations, whose residuals weigh as much as those of positions; None: they are not measured."""
    if table is None or table.sigma_deg is None:
        return None
    if table.sigma_mm is None:
        unused = "orientations are not used; what a degree weighs against a millimetre is not known"
        warnings.warn(f"measurement.sigma_deg: found without sigma_mm: {unused}", UserWarning, stacklevel=2)
        return None
    return table.sigma_mm / float(np.radians(table.sigma_deg))


def _pose(table: PoseTable) -> Array:
    angles = np.radians((table.rx_deg, table.ry_deg, table.rz_deg)).tolist()
    return pose((table.x_mm, table.y_mm, table.z_mm), from_own_axes(*angles))


def _with_tools(chain: SpatialChain, tables: Mapping[str, PoseTable]) -> SpatialChain:
    """With measured points, by the names of their markers, of which a single one may have none."""
    poses = {name or "1": _pose(table) for name, table in tables.items()}
    tools = {name: readonly(matrix[:3, 3]) for name, matrix in poses.items()}
    return replace(chain, tools=tools, tool_axes={name: readonly(matrix[:3, :3]) for name, matrix in poses.items()})


# -- the drawing of an arm file that is there --------------------------------------------------------------------------
def urdf_masses(path: PathLike) -> tuple[float, ...] | None:
    """[kg] of the links, from the URDF file that an arm file names; None without one, or where it gives no mass."""
    tables = read_toml(path)
    if not isinstance(name := tables.get("urdf"), str):
        return None
    masses = _urdf(name, Path(path).parent).masses(str(tables["base_link"]), str(tables["tip_link"]))
    return masses if any(masses) else None


def corrected_urdf(path: PathLike, chain: SpatialChain) -> str:
    """The URDF file that an arm file names, with the origins of a corrected chain; a bare one where it names none."""
    tables = read_toml(path)
    if not isinstance(name := tables.get("urdf"), str):
        return urdf_text(chain, str(tables.get("name", "arm")))
    urdf, ends = _urdf(name, Path(path).parent), (str(tables["base_link"]), str(tables["tip_link"]))
    return with_origins(urdf, *ends, [joint.origin for joint in chain.joints])


def dh_rows(path: PathLike) -> tuple[list[DHRow], str] | None:
    """Rows and convention of the `[[dh]]` table of an arm file; None where it has none."""
    tables = read_toml(path).get("dh")
    if not isinstance(tables, list):
        return None
    convention = next((row["convention"] for row in tables if row.get("convention")), STANDARD)
    return [_row(table) for table in tables], convention


# -- writing -----------------------------------------------------------------------------------------------------------
def chain_tables(arm: Arm, chain: SpatialChain) -> dict[str, Any]:
    """What an arm file says of the geometry, the joint limits, and what is known of base and measured points; the
    drawing as the text of a URDF file.

    Raises `InputError` for a chosen set of parameters, which no file can say.
    """
    if chain.fixed:
        chosen = "has a chosen set of parameters"
        raise InputError(f"arm {arm.name}: {chosen}, allowed: all of them; a file has no such key")
    sliding = np.array(arm.joint_types) == PRISMATIC
    tables: dict[str, Any] = {"name": arm.name, "kind": "spatial"}
    tables["urdf"] = tomlkit.string(urdf_text(chain, arm.name), literal=True, multiline=True)
    tables |= {"base_link": BASE_LINK, "tip_link": TIP}
    limits = np.stack(arm.column_limits)
    for unit, joints, factor in (("deg", ~sliding, 180.0 / np.pi), ("mm", sliding, 1.0)):
        if joints.any() and np.all(np.isfinite(limits[:, joints])):  # else those of the drawing
            lower, upper = ([tidy(factor * x) for x in side] for side in limits[:, joints])
            tables[f"joint_limits_{unit}"] = {"lower": lower, "upper": upper}
    if BASE in chain.known:
        tables["base"] = pose_table(chain.base)
    if TOOL in chain.known:
        tables["tool"] = tool_tables(chain.tools, chain.tool_axes)
    if chain.angle_scale is not None and arm.sigma is not None:
        tables["measurement"] = {"sigma_deg": tidy(np.degrees(arm.sigma / chain.angle_scale))}
    if chain.instrument.kind:
        tables["instrument"] = chain.instrument.table()
    if arm.machining != Machining():
        rotation = tidy(np.degrees(arm.machining.rotation))
        tables["machining"] = {"translation_mm": arm.machining.translation, "rotation_deg": rotation}
    return tables


def place_tables(calibration: Calibration) -> dict[str, Any]:
    """`[calibration]`: where base and measured points were identified."""
    tables: dict[str, Any] = {} if calibration.base is None else {"base": pose_table(calibration.base)}
    tools = tool_tables(calibration.tools, calibration.tool_axes) if calibration.tools else {}
    return tables | ({"tools": tools} if tools else {})


def with_places(chain: SpatialChain, calibration: Calibration | None) -> Calibration | None:
    """The calibration, with where base and measured points are if they are somewhere without being known."""
    somewhere = BASE not in chain.known and not np.array_equal(chain.base, np.eye(4))
    named = TOOL not in chain.known and (
        list(chain.tools) != ["1"] or bool(np.any(chain.tools["1"])) or bool(chain.tool_axes)
    )
    if not somewhere and not named:
        return calibration
    placed = calibration or Calibration({})
    stands = standing_in(chain, placed.values)
    if somewhere:
        placed = replace(placed, base=stands.base)
    return replace(placed, tools=stands.tools, tool_axes=stands.tool_axes) if named else placed


def tidy(value: float) -> float:
    """The value to 15 significant digits: 30 rather than 29.999999999999996; the same angle in radians to rounding."""
    return float(f"{value:.15g}")
