"""Arm files: TOML in millimetres and degrees <-> `Arm` in millimetres and radians."""

from __future__ import annotations

import math
import tomllib
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit

from identification.arm import (
    Arm,
    Calibration,
    Constraint,
    EffectSpec,
    Gravity,
    KeepOutCircle,
    LineOfSight,
    WorkspaceBox,
)
from identification.arrays import Array, readonly
from identification.errors import InputError, nearest
from identification.files.arm_schema import (
    ArmFile,
    BoxTable,
    CalibrationTable,
    CircleTable,
    ConstraintTable,
    EffectTable,
    check_covariance,
    validated,
)
from identification.files.io import PathLike, read_toml
from identification.files.toml import Plain, append_tables, replace_table
from identification.kinematics.parameters import Parameter, chain_parameters

if TYPE_CHECKING:
    from identification.effects import Effect


def load_arm(path: PathLike) -> Arm:
    """The arm that a TOML file describes.

    Raises `InputError`, one line naming file, key, what was found and what is allowed. Warns (`UserWarning`) when the
    joint limits look like radians.
    """
    tables = read_toml(path)
    try:
        arm = arm_from_tables(tables)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    _warn_if_radians(path, tables)
    return arm


def arm_from_tables(tables: dict[str, Any]) -> Arm:
    """The arm of parsed TOML; raises `InputError` as `load_arm` does, without the file's name."""
    file = validated(tables)
    links = len(file.links_mm)
    limits = file.joint_limits_deg
    effects = effects_of(file)
    _check_gravity(file, effects)
    names = file_names(links, effects)
    return Arm(
        lengths=readonly(file.links_mm),
        lower=None if limits is None else np.radians(limits.lower),  # type: ignore[arg-type]
        upper=None if limits is None else np.radians(limits.upper),  # type: ignore[arg-type]
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=_gravity(file, links),
        constraints=tuple(_constraint(table) for table in file.constraints),
        effects=tuple(spec for spec, _ in effects),
        calibration=None if file.calibration is None else _calibration(file.calibration, file.links_mm, names),
    )


def dump_arm(arm: Arm) -> str:
    """The text of an arm file for `arm`; `load_arm` reads the same arm from it, to rounding (1e-14)."""
    tables: Plain = {
        "name": arm.name,
        "links_mm": arm.lengths.tolist(),
        "joint_limits_deg": {"lower": _degrees(arm.lower), "upper": _degrees(arm.upper)},
    }
    if arm.sigma is not None:
        tables["measurement"] = {"sigma_mm": float(arm.sigma)}
    if arm.gravity is not None:
        tables["gravity"] = {
            "acceleration_m_s2": _floats(arm.gravity.acceleration),
            "link_masses_kg": _floats(arm.gravity.link_masses),
            "center_of_mass": _floats(arm.gravity.center_of_mass),
            "payload_kg": float(arm.gravity.payload),
        }
    if arm.constraints:
        tables["constraints"] = [_constraint_table(constraint) for constraint in arm.constraints]
    text = with_effects(tomlkit.dumps(tables), arm.effects)
    return text if arm.calibration is None else with_calibration(text, arm.calibration)


def with_effects(text: str, specs: Iterable[EffectSpec]) -> str:
    """`text` of an arm file with `[[effects]]` entries added for those of `specs` that it does not have yet.

    Values of the specs (API units) are written in file units, and so become known. Comments and order of the text stay.
    Raises `InputError` for effects that the arm cannot have.
    """
    text = text.removeprefix("\ufeff")
    before = tomllib.loads(text)
    file = validated({key: value for key, value in before.items() if key != "calibration"})
    there = {effect.label for _, effect in effects_of(file)}
    built = _built(specs, len(file.links_mm))
    tables = [_effect_table(spec, effect) for spec, effect in built if effect.label not in there]
    return append_tables(text, "effects", tables) if tables else text


def with_calibration(text: str, calibration: Calibration) -> str:
    """`text` of an arm file with its `[calibration]` replaced or added; comments and order of the rest stay.

    Effects with estimated values must stand under `[[effects]]` of the text: see `with_effects`. Raises `InputError`
    for a calibration of another number of links, or of effects the text does not have.
    """
    text = text.removeprefix("\ufeff")
    before = tomllib.loads(text)
    file = validated({key: value for key, value in before.items() if key != "calibration"})
    tables = _calibration_table(calibration, file_names(len(file.links_mm), effects_of(file)))
    arm_from_tables({**before, "calibration": tables})  # nothing is written that could not be read again
    return replace_table(text, "calibration", tables)


# -- reading -----------------------------------------------------------------------------------------------------------
def _warn_if_radians(path: PathLike, tables: Mapping[str, Any]) -> None:
    limits = tables.get("joint_limits_deg")
    if limits and max(abs(value) for key in ("lower", "upper") for value in limits[key]) <= 2.0 * np.pi + 0.01:
        message = "joint_limits_deg: all limits are within 6.3 deg and look like radians; write them in degrees"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=3)


def _gravity(file: ArmFile, links: int) -> Gravity | None:
    table = file.gravity
    if table is None:
        return None
    center = [0.5] * links if table.center_of_mass is None else table.center_of_mass
    for key, values in (("link_masses_kg", table.link_masses_kg), ("center_of_mass", center)):
        _require_count(f"gravity.{key}", values, links)
    acceleration, masses = readonly(table.acceleration_m_s2), readonly(table.link_masses_kg)
    return Gravity(acceleration, masses, readonly(center), table.payload_kg)


def _constraint(table: ConstraintTable) -> Constraint:
    if isinstance(table, BoxTable):
        return WorkspaceBox((table.x_mm[0], table.x_mm[1]), (table.y_mm[0], table.y_mm[1]))
    if isinstance(table, CircleTable):
        return KeepOutCircle((table.center_mm[0], table.center_mm[1]), table.radius_mm)
    tracker, toward = table.tracker_mm, table.toward_mm
    return LineOfSight((tracker[0], tracker[1]), float(np.radians(table.half_angle_deg)), (toward[0], toward[1]))


# -- effects and the names of their parameters in files ---------------------------------------------------------------
def effects_of(file: ArmFile) -> list[tuple[EffectSpec, Effect]]:
    """The `[[effects]]` entries with the effects they ask for; values in API units."""
    links = len(file.links_mm)
    return _built([_spec(table, f"effects[{k}]", links) for k, table in enumerate(file.effects, start=1)], links)


def _built(specs: Iterable[EffectSpec], links: int) -> list[tuple[EffectSpec, Effect]]:
    if not (listed := list(specs)):
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(listed, build_all(listed, links), strict=True))


def _spec(table: EffectTable, place: str, links: int) -> EffectSpec:
    from identification.effects import build, library

    settings = getattr(library().get(table.name), "settings", {})
    chosen = {key: value for key, value in table.own.items() if key in settings}
    effect = build(EffectSpec(table.name, table.joint, MappingProxyType(chosen)), links)
    parameters = {p.toml_key: p for p in effect.parameters}
    values = dict(chosen)
    for key, value in table.own.items():
        if key in chosen:
            continue
        if key not in parameters:
            hint = nearest(key, ["name", "joint", *parameters, *settings])
            raise InputError(f"{place}.{key}: unknown key of {table.name}, {hint}")
        parameter = parameters[key]
        values[parameter.short] = value / parameter.to_file
        _require_bounds(f"{place}.{key}", value, parameter)
    return EffectSpec(table.name, table.joint, MappingProxyType(values))


def _require_bounds(key: str, value: float, parameter: Parameter) -> None:
    low, high = parameter.lower * parameter.to_file, parameter.upper * parameter.to_file
    if not low <= value <= high:
        allowed = f">= {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        raise InputError(f"{key}: found {value:g}, allowed: a number {allowed}")


@dataclass(frozen=True)
class FileName:
    """How a parameter is called in files: API name, name in the file, and the factor from API to file unit."""

    api: str
    file: str
    factor: float


def _check_gravity(file: ArmFile, effects: Iterable[tuple[EffectSpec, Effect]]) -> None:
    """Raises `InputError` for an effect of gravity in a plane without gravity."""
    for spec, effect in effects:
        if "gravity" in effect.needs and file.gravity is None:
            raise InputError(f"effects: {spec.key} needs gravity torques, found no [gravity] table, allowed: with one")


def file_names(links: int, effects: Iterable[tuple[EffectSpec, Effect]]) -> list[FileName]:
    """All parameters an arm's calibration may have: `length_error:1` (mm), `joint_offset:1` (deg), then of effects."""
    names = [FileName(p.name, p.name, p.to_file) for p in chain_parameters(np.ones(links))]
    for _, effect in effects:
        names += [FileName(p.name, f"{effect.key}.{p.toml_key}", p.to_file) for p in effect.parameters]
    return names


def _calibration(table: CalibrationTable, nominal: list[float], names: list[FileName]) -> Calibration:
    links = len(nominal)
    for key in ("length_errors_mm", "joint_offsets_deg"):
        _require_count(f"calibration.{key}", getattr(table, key), links)
    for j, (length, error) in enumerate(zip(nominal, table.length_errors_mm, strict=True), start=1):
        if length + error <= 0.0:
            found = f"found {error:g} for link {j} of {length:g} mm"
            raise InputError(f"calibration.length_errors_mm: {found}, allowed: more than {-length:g}")
    by_file = {name.file: name for name in names}
    effects = {}
    for key, value in table.effects.items():
        name = _known(by_file, key, "calibration.effects", among=list(by_file)[2 * links :])
        effects[name.api] = value / name.factor
    order = [_known(by_file, key, "calibration.parameters", among=list(by_file)) for key in table.parameters or ()]
    return Calibration.of(
        table.length_errors_mm,
        np.radians(table.joint_offsets_deg),
        effects,
        parameter_names=tuple(name.api for name in order),
        covariance=_covariance(table, np.array([name.factor for name in order])),
        provenance=MappingProxyType(dict(table.provenance)),
    )


def _known(by_file: Mapping[str, FileName], key: str, place: str, among: list[str]) -> FileName:
    if key in among:
        return by_file[key]
    allowed = nearest(key, among) if among else "allowed: parameters of effects that the file has under [[effects]]"
    raise InputError(f"{place}: unknown parameter {key!r}, {allowed}")


def _covariance(table: CalibrationTable, factors: Array) -> Array | None:
    """(p, p) in API units."""
    if table.covariance is None:
        return None
    if table.parameters is None:
        raise InputError("calibration.parameters: is missing, allowed: the names of the rows of covariance")
    p = len(factors)
    _require_count("calibration.covariance", table.covariance, p, "rows for", "parameters")
    for row in table.covariance:
        _require_count("calibration.covariance", row, p, "values in a row for", "parameters")
    matrix = np.array(table.covariance).reshape(p, p)
    check_covariance(matrix, table.parameters)
    return readonly(matrix / np.outer(factors, factors))


def _require_count(key: str, values: list[Any], count: int, what: str = "values for", whose: str = "links") -> None:
    if len(values) != count:
        raise InputError(f"{key}: found {len(values)} {what} {count} {whose}, allowed: {count}")


# -- what is written, as plain Python in file units --------------------------------------------------------------------
def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _tidy(value: float) -> float:
    """15 significant digits: 30 rather than 29.999999999999996, and the same angle in radians to rounding."""
    return float(f"{value:.15g}")


def _degrees(radians: Any) -> list[float]:
    return [_tidy(value) for value in np.degrees(radians)]


def _constraint_table(constraint: Constraint) -> Plain:
    if isinstance(constraint, WorkspaceBox):
        return {"kind": "workspace_box", "x_mm": _floats(constraint.x), "y_mm": _floats(constraint.y)}
    if isinstance(constraint, KeepOutCircle):
        center = _floats(constraint.center)
        return {"kind": "keep_out_circle", "center_mm": center, "radius_mm": float(constraint.radius)}
    return {
        "kind": "line_of_sight",
        "tracker_mm": _floats(constraint.tracker),
        "half_angle_deg": _tidy(math.degrees(constraint.half_angle)),
        "toward_mm": _floats(constraint.toward),
    }


def _effect_table(spec: EffectSpec, effect: Effect) -> Plain:
    entry: Plain = {"name": spec.name} if spec.joint is None else {"name": spec.name, "joint": int(spec.joint)}
    parameters = {p.short: p for p in effect.parameters}
    for short, value in spec.values.items():
        if short in parameters:
            entry[parameters[short].toml_key] = _in_file(value, parameters[short].to_file)
        else:  # a setting, a whole number
            entry[short] = int(value)
    return entry


def _in_file(value: float, factor: float) -> float:
    return float(value) if factor == 1.0 else _tidy(float(value) * factor)


def _calibration_table(calibration: Calibration, names: list[FileName]) -> Plain:
    by_api = {name.api: name for name in names}
    for api in (*calibration.effects, *calibration.parameter_names):
        if api not in by_api:
            raise InputError(f"calibration: unknown parameter {api!r}, {nearest(api, by_api)}")
    tables: Plain = {
        "length_errors_mm": _floats(calibration.length_errors),
        "joint_offsets_deg": _degrees(calibration.joint_offsets),
    }
    order = [by_api[api] for api in calibration.parameter_names]
    if order:
        tables["parameters"] = [name.file for name in order]
    if calibration.covariance is not None:
        factors = [name.factor for name in order]
        rows = zip(factors, calibration.covariance, strict=True)
        tables["covariance"] = [[_in_file(v, f * g) for g, v in zip(factors, row, strict=True)] for f, row in rows]
    effects = calibration.effects.items()
    if effects:
        tables["effects"] = {by_api[api].file: _in_file(value, by_api[api].factor) for api, value in effects}
    if calibration.provenance:
        tables["provenance"] = _plain(calibration.provenance)
    return tables


def _plain(value: Any) -> Any:
    """`value` in TOML's types; what TOML cannot say (None) and what must not be said (NaN) is left out."""
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
