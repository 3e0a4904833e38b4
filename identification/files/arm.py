"""Arm files, reading: TOML in millimetres and degrees -> `Arm` in millimetres and radians (`arm_text` writes)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

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
from identification.arrays import readonly
from identification.error_curve import ErrorCurve
from identification.errors import InputError, nearest
from identification.files.arm_schema import (
    ArmFile,
    BoxTable,
    CalibrationTable,
    CircleTable,
    ConstraintTable,
    EffectTable,
    validated,
)
from identification.files.io import PathLike, read_toml
from identification.kinematics.parameters import Parameter, chain_parameters

if TYPE_CHECKING:
    from identification.effects import Effect

CURVE, CURVE_KEYS = "joint_error_curve", ("from_deg", "to_deg", "values_deg")


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
        calibration=None if file.calibration is None else _calibration(file.calibration, names),
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
    )


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
    return built([_spec(table, f"effects[{k}]", links) for k, table in enumerate(file.effects, start=1)], links)


def built(specs: Iterable[EffectSpec], links: int) -> list[tuple[EffectSpec, Effect]]:
    """Specs with their effects on an arm of so many links. Raises `InputError` for effects that it cannot have."""
    if not (listed := list(specs)):
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(listed, build_all(listed, links), strict=True))


def _spec(table: EffectTable, place: str, links: int) -> EffectSpec:
    from identification.effects import build, library

    settings = getattr(library().get(table.name), "settings", {})
    curve = _curve(table, place)
    chosen = {key: value for key, value in table.own.items() if key in settings}
    effect = build(EffectSpec(table.name, table.joint, MappingProxyType(chosen), curve), links)
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
    return EffectSpec(table.name, table.joint, MappingProxyType(values), curve)


def _curve(table: EffectTable, place: str) -> ErrorCurve | None:
    """The table of values of a `joint_error_curve`; raises `InputError` for one of another effect, or a part of one."""
    given = {key: getattr(table, key) for key in CURVE_KEYS}
    for key, value in given.items():
        if value is not None and table.name != CURVE:
            raise InputError(f"{place}.{key}: unknown key of {table.name}, allowed: for {CURVE} only")
        if value is None and table.name == CURVE:
            raise InputError(f"{place}.{key}: is missing, allowed: as `armcal diagnose --out` writes it")
    if table.from_deg is None or table.to_deg is None or table.values_deg is None:
        return None
    try:
        return ErrorCurve(math.radians(table.from_deg), math.radians(table.to_deg), np.radians(table.values_deg))
    except InputError as error:
        raise InputError(f"{place}.{error}") from None


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


def _calibration(table: CalibrationTable, names: list[FileName]) -> Calibration:
    by_file = {name.file: name for name in names}
    of_effects = list(by_file)[2 * len(table.length_errors_mm) :]
    effects = {}
    for key, value in table.effects.items():
        name = _known(by_file, key, "calibration.effects", among=of_effects)
        effects[name.api] = value / name.factor
    order = [_known(by_file, key, "calibration.parameters", among=list(by_file)) for key in table.parameters or ()]
    factors = np.array([name.factor for name in order])
    return Calibration.of(
        table.length_errors_mm,
        np.radians(table.joint_offsets_deg),
        effects,
        parameter_names=tuple(name.api for name in order),
        covariance=None if table.covariance is None else table.matrix / np.outer(factors, factors),
        provenance=MappingProxyType(dict(table.provenance)),
    )


def _known(by_file: Mapping[str, FileName], key: str, place: str, among: list[str]) -> FileName:
    if key in among:
        return by_file[key]
    allowed = nearest(key, among) if among else "allowed: parameters of effects that the file has under [[effects]]"
    raise InputError(f"{place}: unknown parameter {key!r}, {allowed}")
