"""Arm files, reading: TOML in millimetres and degrees -> `Arm` in millimetres and radians (`arm_text` writes)."""

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

from identification.arm import Arm, Calibration, EffectSpec, Gravity, Machining
from identification.arrays import Array, readonly
from identification.error_curve import ErrorCurve
from identification.errors import InputError, nearest
from identification.files import arm_chain
from identification.files.io import PathLike, read_toml
from identification.files.schema import (
    ArmFile,
    BoxTable,
    CalibrationTable,
    ConstraintTable,
    CylinderTable,
    EffectTable,
    JointsTable,
    SightTable,
    require_count,
    validated_arm,
)
from identification.instruments import IN_PLANE, KINDS
from identification.kinematics.counting import Counting, check_kinds
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
from identification.kinematics.spatial import SpatialChain
from identification.workspace import (
    ColumnLimits,
    KeepOutCircle,
    KeepOutCylinder,
    LineOfSight,
    WorkspaceBox,
    WorkspaceConstraint,
)

if TYPE_CHECKING:
    from identification.effects import Effect

CURVE, CURVE_KEYS, GEOMETRY_KEY = "joint_error_curve", ("from_deg", "to_deg", "values_deg"), "geometry"
MARKER = re.compile(r"tool\[.*\]\.(r?)[xyz]")


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
    chain = arm_chain.nominal_chain(file, folder) if file.links_mm is None else arm_chain.of_links(file)
    n, kinds = len(chain), chain.joint_types
    file.require_counts(n)
    constraints = [_constraint(table) for table in file.constraints]
    counting = None if file.joints is None else _counting(file.joints, kinds)
    drawn = [(joint.lower, joint.upper) for joint in chain.joints]
    lower, upper, tied = _joint_limits(file, kinds, np.array(drawn).T, counting)
    effects = built([_spec(table, k, chain) for k, table in enumerate(file.effects, start=1)], chain)
    _check_needs(file, effects)
    if not chain.planar:
        chain = arm_chain.with_limits(chain, lower, upper)
        chain = arm_chain.with_measured_points(chain, file.calibration)
    names = file_names(chain.parameters(), effects)
    calibration = None if file.calibration is None else _calibration(file.calibration, names)
    if not chain.planar and calibration is not None and file.calibration is not None:
        chain, calibration = arm_chain.before_calibration(chain, calibration, file.calibration)
    return Arm(
        chain,
        lower=lower,
        upper=upper,
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=_gravity(file, n),
        constraints=(*constraints, *tied),
        effects=_with_geometry(effects, file.effects, chain.every_parameter),
        calibration=calibration,
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
        machining=_machining(file),
        counting=counting,
    )


# -- joints ------------------------------------------------------------------------------------------------------------
def _counting(table: JointsTable, kinds: Sequence[str]) -> Counting:
    """As `[joints]` says; what it leaves out is as usual. Raises `InputError` for what no controller can have."""
    n = len(kinds)
    zeros = np.radians(table.zero_deg or [0.0] * n).tolist()
    counting = Counting(tuple(table.sign or [1] * n), tuple(table.coupled_to or [0] * n), tuple(zeros))
    check_kinds(counting, kinds)
    return counting


def _joint_limits(
    file: ArmFile, kinds: Sequence[str], drawn: Array, counting: Counting | None
) -> tuple[Array, Array, list[ColumnLimits]]:
    """(n,) lower and (n,) upper limits of the joints [rad, mm], and the controller's of joints that it couples.

    Limits in tables of the file are the controller's; `drawn` (2, n), those of a URDF, are the joints' already.
    """
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
            tied.append(ColumnLimits(j + 1, tuple(counting.sums[j].tolist()), *ends))
        limits = np.where(written, counting.joint_limits(*limits), limits)
    return limits[0], limits[1], tied


# -- what else the file says -------------------------------------------------------------------------------------------
def _gravity(file: ArmFile, joints: int) -> Gravity | None:
    """`[gravity]`, centers of mass in the middle of the links where the file does not say."""
    if (table := file.gravity) is None:
        return None
    center = table.center_of_mass or [0.5] * joints
    return Gravity(
        readonly(table.acceleration_m_s2),
        readonly(table.link_masses_kg),
        readonly(center),
        table.payload_kg,
        None if table.payload_at_mm is None else readonly(table.payload_at_mm),
    )


def _machining(file: ArmFile) -> Machining:
    table, usual = file.machining, Machining()
    if table is None:
        return usual
    rotation = usual.rotation if table.rotation_deg is None else float(np.radians(table.rotation_deg))
    return Machining(usual.translation if table.translation_mm is None else table.translation_mm, rotation)


def _constraint(table: ConstraintTable) -> WorkspaceConstraint:
    if isinstance(table, BoxTable):
        return WorkspaceBox(_pair(table.x_mm), _pair(table.y_mm), None if table.z_mm is None else _pair(table.z_mm))
    if isinstance(table, CylinderTable):
        return KeepOutCylinder(_triple(table.start_mm), _triple(table.end_mm), table.radius_mm)
    if not isinstance(table, SightTable):
        return KeepOutCircle(tuple(table.center_mm), table.radius_mm)
    half, accepted = np.radians((table.half_angle_deg, table.acceptance_deg or 90.0)).tolist()
    facing = None if table.facing is None else _triple(table.facing)
    reach = None if table.range_mm is None else _pair(table.range_mm)
    return LineOfSight(tuple(table.tracker_mm), half, tuple(table.toward_mm), reach, facing, accepted)


def _pair(values: list[float]) -> tuple[float, float]:
    return values[0], values[1]


def _triple(values: list[float]) -> tuple[float, float, float]:
    return values[0], values[1], values[2]


# -- effects -----------------------------------------------------------------------------------------------------------
class FileName(NamedTuple):
    """How a parameter is called in files: API name, name in the file, and the factor from API to file unit."""

    api: str
    file: str
    factor: float


def built(specs: Iterable[EffectSpec], chain: SpatialChain) -> list[tuple[EffectSpec, Effect]]:
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


def _spec(table: EffectTable, k: int, chain: SpatialChain) -> EffectSpec:
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


def _check_needs(file: ArmFile, effects: Iterable[tuple[EffectSpec, Effect]]) -> None:
    """Raises `InputError` for an effect of gravity on an arm without gravity, and for one of measured distances where
    something else is measured."""
    kind = None if file.instrument is None else file.instrument.kind
    known = KINDS if file.links_mm is None else IN_PLANE
    offers = frozenset[str]() if kind is None else known[kind].offers
    for spec, effect in effects:
        if effect.of_positions and kind is not None:
            state = f"found an [instrument] of kind {kind}"
            raise InputError(f"effects: {spec.key} is of measured positions, {state}, allowed: without it")
        if "distance" in effect.needs - offers:
            state = "no [instrument] table" if kind is None else f"an [instrument] of kind {kind}"
            raise InputError(f"effects: {spec.key} needs measured distances, found {state}, allowed: kind distance")
        if "gravity" in effect.needs and file.gravity is None:
            raise InputError(f"effects: {spec.key} needs gravity torques, found no [gravity] table, allowed: with one")


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
