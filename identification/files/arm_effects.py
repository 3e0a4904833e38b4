"""Effects in arm files: `[[effects]]` entries, and the names of all parameters with the units of the file."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from identification.arm import EffectSpec, Gravity
from identification.arrays import Array, readonly
from identification.error_curve import ErrorCurve
from identification.errors import InputError, nearest
from identification.files.arm_schema import CovarianceTable, EffectTable, GravityTable
from identification.files.arm_schema_spatial import InstrumentTable, SpatialGravityTable
from identification.kinematics.instrument import DISTANCE
from identification.kinematics.parameters import Parameter

if TYPE_CHECKING:
    from identification.effects import Effect

CURVE, CURVE_KEYS, GEOMETRY_KEY = "joint_error_curve", ("from_deg", "to_deg", "values_deg"), "geometry"
MARKER = re.compile(r"tool\[.*\]\.(r?)[xyz]")


def effects_of(tables: Sequence[EffectTable], links: int, dimension: int = 2) -> list[tuple[EffectSpec, Effect]]:
    """The `[[effects]]` entries with the effects they ask for; values in API units."""
    specs = [_spec(table, f"effects[{k}]", links, dimension) for k, table in enumerate(tables, start=1)]
    return built(specs, links, dimension)


def built(specs: Iterable[EffectSpec], links: int, dimension: int = 2) -> list[tuple[EffectSpec, Effect]]:
    """Specs with their effects on an arm of so many links. Raises `InputError` for effects that it cannot have."""
    if not (listed := list(specs)):
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(listed, build_all(listed, links, dimension=dimension), strict=True))


def _spec(table: EffectTable, place: str, links: int, dimension: int) -> EffectSpec:
    from identification.effects import build, library

    settings = getattr(library().get(table.name), "settings", {})
    curve = _curve(table, place)
    chosen = {key: value for key, value in table.own.items() if key in settings}
    effect = build(EffectSpec(table.name, table.joint, MappingProxyType(chosen), curve), links, dimension=dimension)
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


def with_geometry(
    effects: Sequence[tuple[EffectSpec, Effect]], tables: Sequence[EffectTable], geometry: Iterable[Parameter]
) -> tuple[EffectSpec, ...]:
    """The specs of a file's effects, curves with the geometry that was fitted with them, in API units.

    geometry : parameters of the chain. Raises `InputError` for names that are none of a parameter
    """
    by_file, found = {name.file: name for name in file_names(geometry, effects)}, []
    for k, ((spec, _), table) in enumerate(zip(effects, tables, strict=True), start=1):
        if spec.curve is not None and table.geometry:
            place = f"effects[{k}].{GEOMETRY_KEY}"
            names = {key: curve_name(key, by_file, place) for key in table.geometry}
            values = {name.api: table.geometry[key] / name.factor for key, name in names.items()}
            spec = replace(spec, curve=replace(spec.curve, geometry=values))
        found.append(spec)
    return tuple(found)


def curve_name(key: str, known: Mapping[str, FileName], place: str) -> FileName:
    """Of a parameter in the geometry of a curve: one of those known, or of a measured point of any name."""
    if key not in known and (point := MARKER.fullmatch(key)):
        return FileName(key, key, math.degrees(1.0) if point[1] else 1.0)
    if key not in known:
        raise InputError(f"{place}: unknown parameter {key!r}, {nearest(key, known)}")
    return known[key]


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


def gravity_of(table: GravityTable | SpatialGravityTable | None, joints: int) -> Gravity | None:
    """`[gravity]`, centers of mass in the middle of the links where the file does not say."""
    if table is None:
        return None
    center = [0.5] * joints if table.center_of_mass is None else table.center_of_mass
    acceleration, masses = readonly(table.acceleration_m_s2), readonly(table.link_masses_kg)
    return Gravity(acceleration, masses, readonly(center), table.payload_kg, getattr(table, "payload_at_mm", None))


def check_tables(
    gravity: GravityTable | SpatialGravityTable | None,
    effects: Iterable[tuple[EffectSpec, Effect]],
    instrument: InstrumentTable | None = None,
) -> None:
    """Raises `InputError` for an effect of gravity on an arm without gravity, and for one of measured distances where
    something else is measured."""
    for spec, effect in effects:
        if "distance" in effect.needs and (instrument is None or instrument.kind != DISTANCE):
            found = "no [instrument] table" if instrument is None else f"an [instrument] of kind {instrument.kind}"
            raise InputError(f"effects: {spec.key} needs measured distances, found {found}, allowed: kind distance")
        if "gravity" in effect.needs and gravity is None:
            raise InputError(f"effects: {spec.key} needs gravity torques, found no [gravity] table, allowed: with one")


def file_names(geometry: Iterable[Parameter], effects: Iterable[tuple[EffectSpec, Effect]]) -> list[FileName]:
    """All parameters of a calibration: those of the geometry (`joint_offset:1` in deg), then those of effects."""
    names = [FileName(p.name, p.name, p.to_file) for p in geometry]
    for _, effect in effects:
        names += [FileName(p.name, f"{effect.key}.{p.toml_key}", p.to_file) for p in effect.parameters]
    return names


def calibrated_effects(table: CovarianceTable, names: Iterable[FileName]) -> dict[str, float]:
    """Name -> value [API unit] of the effects' parameters; raises `InputError` for one that the file's effects lack.

    names : those of effects
    """
    by_file = {name.file: name for name in names}
    found = {}
    for key, value in table.effects.items():
        name = _known(by_file, key, "calibration.effects")
        found[name.api] = value / name.factor
    return found


def covariance_of(table: CovarianceTable, names: Iterable[FileName]) -> tuple[tuple[str, ...], Array | None]:
    """(p) names of the parameters and (p, p) their covariance in API units; raises `InputError` for unknown names."""
    by_file = {name.file: name for name in names}
    order = [_known(by_file, key, "calibration.parameters") for key in table.parameters or ()]
    factors = np.array([name.factor for name in order])
    covariance = None if table.covariance is None else table.matrix / np.outer(factors, factors)
    return tuple(name.api for name in order), covariance


def _known(by_file: Mapping[str, FileName], key: str, place: str) -> FileName:
    if key in by_file:
        return by_file[key]
    allowed = nearest(key, by_file) if by_file else "allowed: parameters of effects that the file has under [[effects]]"
    raise InputError(f"{place}: unknown parameter {key!r}, {allowed}")
