"""Arm files, writing: `Arm` -> TOML in millimetres and degrees; effects and calibrations into a user's own text."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit

from identification.arm import Arm, Calibration, EffectSpec, Gravity
from identification.arrays import Array
from identification.errors import InputError, nearest
from identification.files.arm import arm_from_tables
from identification.files.arm_effects import GEOMETRY_KEY, FileName, built, curve_name, file_names
from identification.files.io import PathLike, read_toml
from identification.files.joint_counting import joints_table
from identification.files.toml import Plain, append_tables, replace_table
from identification.kinematics.parameters import GEOMETRY, chain_parameters
from identification.workspace import ColumnLimits, KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox

if TYPE_CHECKING:
    from identification.effects import Effect


def dump_arm(arm: Arm) -> str:
    """The text of an arm file for `arm`; `load_arm` reads the same arm from it, to rounding (1e-14).

    That of a spatial arm has its drawing in it, as the text of a URDF file.
    Raises `InputError` for a spatial arm with a chosen set of parameters, which no file can say.
    """
    calibration = arm.calibration
    if arm.chain is None:
        tables: Plain = {"name": arm.name, "links_mm": arm.lengths.tolist()}
        limits = arm.column_limits
        if np.all(np.isfinite(limits)):
            tables["joint_limits_deg"] = {"lower": _degrees(limits[0]), "upper": _degrees(limits[1])}
        elif np.any(np.abs([arm.lower, arm.upper]) != np.pi):
            found = "limits of coupled joints, none of which is the controller's"
            raise InputError(f"arm {arm.name}: {found}, allowed: with a constraint ColumnLimits for each")
    else:
        from identification.files.arm_text_spatial import calibration_with_places, chain_tables

        tables, calibration = chain_tables(arm, arm.chain), calibration_with_places(arm.chain, calibration)
    tables |= {} if arm.counting is None else {"joints": joints_table(arm.counting)}
    tables |= {} if arm.gear_ratios is None else {"gear_ratio": _floats(arm.gear_ratios)}
    if arm.sigma is not None:
        tables.setdefault("measurement", {})["sigma_mm"] = float(arm.sigma)
    if arm.gravity is not None:
        tables["gravity"] = _gravity_table(arm.gravity)
    if constraints := [each for each in arm.constraints if not isinstance(each, ColumnLimits)]:
        tables["constraints"] = [_constraint_table(constraint) for constraint in constraints]
    text = with_effects(tomlkit.dumps(tables), arm.effects)
    return text if calibration is None else with_calibration(text, calibration)


def with_effects(text: str, specs: Iterable[EffectSpec], folder: PathLike = ".") -> str:
    """`text` of an arm file with `[[effects]]` entries added for those of `specs` that it does not have yet.

    Values of the specs (API units) are written in file units, and so become known. Comments and order of the text stay.
    Raises `InputError` for effects that the arm cannot have.

    folder : where the files are that the text names
    """
    text, _, arm = _parsed(text, folder)
    there = {effect.label for _, effect in built(arm.effects, arm.links, arm.dimension)}
    wanted = built(specs, arm.links, arm.dimension)
    geometry = chain_parameters(arm.lengths) if arm.chain is None else arm.chain.every_parameter
    names = {name.api: name for name in file_names(geometry, [*built(arm.effects, arm.links, arm.dimension), *wanted])}
    tables = [_effect_table(spec, effect, names) for spec, effect in wanted if effect.label not in there]
    return append_tables(text, "effects", tables) if tables else text


def with_calibration(text: str, calibration: Calibration, folder: PathLike = ".") -> str:
    """`text` of an arm file with its `[calibration]` replaced or added; comments and order of the rest stay.

    Effects with estimated values must stand under `[[effects]]` of the text: see `with_effects`. Raises `InputError`
    for a calibration of another number of links, or of effects the text does not have.

    folder : where the files are that the text names
    """
    text, before, arm = _parsed(text, folder)
    tables = _calibration_table(arm, calibration)
    arm_from_tables({**before, "calibration": tables}, folder)  # nothing is written that could not be read again
    return replace_table(text, "calibration", tables)


def urdf_beside(path: PathLike, out: PathLike | None) -> dict[PathLike, bytes]:
    """The URDF file that has to be written for a copy at `out` of the arm file at `path`: none if it is there."""
    name = read_toml(path).get("urdf")
    if out is None or name is None or name.lstrip().startswith("<"):
        return {}
    here, there = Path(path).parent / name, Path(out).parent / name
    return {} if there.exists() and there.read_bytes() == here.read_bytes() else {there: here.read_bytes()}


def _parsed(text: str, folder: PathLike) -> tuple[str, Plain, Arm]:
    """The text without a byte-order mark, its tables, and the arm that they describe without a calibration."""
    text = text.removeprefix("\ufeff")
    tables = tomllib.loads(text)
    return text, tables, arm_from_tables({key: value for key, value in tables.items() if key != "calibration"}, folder)


# -- tables, as plain Python in file units --------------------------------------------------------------------
def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _tidy(value: float) -> float:
    """The value to 15 significant digits: 30 rather than 29.999999999999996; the same angle in radians to rounding."""
    return float(f"{value:.15g}")


def _degrees(radians: Any) -> Any:
    """One angle, or a list of them."""
    return _tidy(np.degrees(radians)) if np.ndim(radians) == 0 else [_tidy(value) for value in np.degrees(radians)]


def _gravity_table(gravity: Gravity) -> Plain:
    return {
        "acceleration_m_s2": _floats(gravity.acceleration),
        "link_masses_kg": _floats(gravity.link_masses),
        "center_of_mass": _floats(gravity.center_of_mass),
        "payload_kg": float(gravity.payload),
    } | ({} if gravity.payload_at is None else {"payload_at_mm": _floats(gravity.payload_at)})


def _constraint_table(constraint: WorkspaceBox | KeepOutCircle | KeepOutCylinder | LineOfSight) -> Plain:
    """`[[constraints]]`, of the plane or of space."""
    if isinstance(constraint, WorkspaceBox):
        sides = zip("xyz", (constraint.x, constraint.y, constraint.z), strict=True)
        return {"kind": "workspace_box"} | {f"{axis}_mm": _floats(side) for axis, side in sides if side is not None}
    if isinstance(constraint, KeepOutCircle):
        kind = "keep_out_circle" if len(constraint.center) == 2 else "keep_out_sphere"
        return {"kind": kind, "center_mm": _floats(constraint.center), "radius_mm": float(constraint.radius)}
    if isinstance(constraint, KeepOutCylinder):
        ends = {"start_mm": _floats(constraint.start), "end_mm": _floats(constraint.end)}
        return {"kind": "keep_out_cylinder", **ends, "radius_mm": float(constraint.radius)}
    found: Plain = {
        "kind": "line_of_sight",
        "tracker_mm": _floats(constraint.tracker),
        "half_angle_deg": _tidy(math.degrees(constraint.half_angle)),
        "toward_mm": _floats(constraint.toward),
    }
    if constraint.reach is not None:
        found["range_mm"] = _floats(constraint.reach)
    if constraint.facing is not None:
        found |= {"facing": _floats(constraint.facing), "acceptance_deg": _tidy(math.degrees(constraint.acceptance))}
    return found


def _effect_table(spec: EffectSpec, effect: Effect, names: Mapping[str, FileName]) -> Plain:
    entry: Plain = {"name": spec.name} if spec.joint is None else {"name": spec.name, "joint": int(spec.joint)}
    parameters = {p.short: p for p in effect.parameters}
    for short, value in spec.values.items():
        if short in parameters:
            entry[parameters[short].toml_key] = _in_file(value, parameters[short].to_file)
        else:  # a setting
            entry[short] = int(value) if value == int(value) else float(value)
    if (curve := spec.curve) is not None:
        entry |= {
            "from_deg": _degrees(curve.start),
            "to_deg": _degrees(curve.stop),
            "values_deg": _degrees(curve.values),
        }
        tied = {curve_name(api, names, spec.key): value for api, value in curve.geometry.items()}
        entry |= {GEOMETRY_KEY: {n.file: _in_file(v, n.factor) for n, v in tied.items()}} if tied else {}
    return entry


def _in_file(value: float, factor: float) -> float:
    return float(value) if factor == 1.0 else _tidy(float(value) * factor)


def _calibration_table(arm: Arm, calibration: Calibration) -> Plain:
    chain = None if arm.chain is None else replace(arm.chain, tools=calibration.tools or arm.chain.tools)
    geometry = chain_parameters(arm.lengths) if chain is None else chain.parameters()
    names = file_names(geometry, built(arm.effects, arm.links, arm.dimension))
    by_api = {name.api: name for name in names}
    _require_known((*calibration.effects, *calibration.parameter_names), by_api)
    tables: Plain = _planar_errors(calibration) if chain is None else _spatial_errors(calibration, by_api)
    order = [by_api[api] for api in calibration.parameter_names]
    if order:
        tables["parameters"] = [name.file for name in order]
    if calibration.covariance is not None:
        tables["covariance"] = _covariance(calibration.covariance, [name.factor for name in order])
    if effects := calibration.effects:
        tables["effects"] = {by_api[api].file: _in_file(value, by_api[api].factor) for api, value in effects.items()}
    if calibration.provenance:
        tables["provenance"] = _plain(calibration.provenance)
    return tables


def _planar_errors(calibration: Calibration) -> Plain:
    return {
        "length_errors_mm": _floats(calibration.length_errors),
        "joint_offsets_deg": _degrees(calibration.joint_offsets),
    }


def _spatial_errors(calibration: Calibration, by_api: Mapping[str, FileName]) -> Plain:
    from identification.kinematics.frames import pose_table, tool_tables

    geometry = {name: value for name, value in calibration.values.items() if GEOMETRY.fullmatch(name)}
    _require_known(geometry, by_api)
    tables: Plain = {"values": {name: _in_file(value, by_api[name].factor) for name, value in geometry.items()}}
    if calibration.base is not None:
        tables["base"] = pose_table(calibration.base)
    if calibration.tools:
        tables["tools"] = tool_tables(calibration.tools, calibration.tool_axes)
    return tables


def _require_known(names: Iterable[str], allowed: Mapping[str, FileName]) -> None:
    for name in names:
        if name not in allowed:
            raise InputError(f"calibration: unknown parameter {name!r}, {nearest(name, allowed)}")


def _covariance(covariance: Array, factors: list[float]) -> list[list[float]]:
    rows = zip(factors, covariance, strict=True)
    return [[_in_file(v, f * g) for g, v in zip(factors, row, strict=True)] for f, row in rows]


def _plain(value: Any) -> Any:
    """`value` in TOML's types, without entries that TOML cannot express (None) or that are not allowed (NaN)."""
    if isinstance(value, Mapping):
        items = {str(key): _plain(item) for key, item in value.items()}
        return {key: item for key, item in items.items() if item is not None}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [item for item in map(_plain, value) if item is not None]
    if isinstance(value, float) and math.isnan(value):
        return None
    return value
