"""Arm files: TOML in millimetres and degrees <-> `Arm` in millimetres and radians.

Keys of files end with their unit, names of our classes are the same without it: `half_angle_deg` [deg] is `half_angle`
[rad]. Effects and calibrations are written into a user's own text, whose comments and order stay as they are.
"""

from __future__ import annotations

import math
import re
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import tomlkit
from pydantic import BaseModel

from identification.arm import Arm, Calibration, EffectSpec, Gravity, Machining
from identification.arrays import Array, readonly
from identification.bodies import Cell
from identification.error_curve import ErrorCurve
from identification.errors import InputError, nearest
from identification.files.bodies import GivenBody, Shape, ShapedBodies, pairs_apart, segment
from identification.files.io import PathLike, named_file, read_toml
from identification.files.schema import (
    CONSTRAINTS,
    CURVE,
    CURVE_KEYS,
    POSE,
    GravityTable,
    JointsTable,
    MachiningTable,
    PoseTable,
    require_count,
    validated_arm,
)
from identification.files.urdf import BASE_LINK, METER, TIP, Urdf, parse_urdf, read_urdf, urdf_text, with_origins
from identification.instruments import KINDS
from identification.kinematics.chain import BASE, STANDARD, TOOL, DHRow, KinematicChain, chain_of, planar_chain
from identification.kinematics.corrected import before_errors, standing_in
from identification.kinematics.counting import Counting, check_kinds
from identification.kinematics.frames import from_angles, pose, pose_table, rotation_to_z, tool_tables
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

Plain = dict[str, Any]
Effects = list[tuple[EffectSpec, "Effect"]]
COUNTED = (  # keys with a value for each joint
    *("gravity.link_masses_kg", "gravity.center_of_mass", "calibration.length_errors_mm"),
    *("calibration.joint_offsets_deg", "joints.sign", "joints.coupled_to", "joints.zero_deg", "gear_ratio"),
)
MARKER = re.compile(r"tool\[.*\]\.(r?)[xyz]")
HEADER = re.compile(r"\[\[?\s*([\w-]+)[\w.\"' -]*\]\]?\s*(#.*)?")  # of a table
CLASSES = {each.kind: each for each in (WorkspaceBox, KeepOutCircle, KeepOutCylinder, LineOfSight)}
CLASSES["keep_out_sphere"] = KeepOutCircle


# -- keys and names: reading and writing -------------------------------------------------------------------------------
def _field(key: str) -> tuple[str, float]:
    """The name in our classes of a key of a file, and the factor from its unit to ours."""
    name = "reach" if key == "range_mm" else re.sub(r"_(mm|deg|kg|m_s2)$", "", key)
    return name, math.radians(1.0) if key.endswith("_deg") else 1.0


def _in_api(table: BaseModel) -> Plain:
    """What a table has, by the names of our classes, angles in radians, several numbers as a tuple."""
    values = {}
    for key, value in table.model_dump(exclude_none=True, exclude={"kind"}).items():
        name, factor = _field(key)
        scaled = value if factor == 1.0 else np.multiply(value, factor).tolist()
        values[name] = tuple(scaled) if isinstance(scaled, list) else scaled
    return values


def _in_table(keys: Iterable[str], value: Any) -> Plain:
    """What keys of a table say of one of our classes, the reverse of `_in_api`."""
    fields = {key: _field(key) for key in keys}
    numbers = {key: (getattr(value, name, None), factor) for key, (name, factor) in fields.items()}
    return {key: _in_file(x, 1.0 / factor) for key, (x, factor) in numbers.items() if x is not None}


def _in_file(values: Any, factor: float = 1.0) -> Any:
    """A number or numbers in file units, to 15 significant digits where they are converted: 30 rather than
    29.999999999999996, the same angle in radians to rounding."""
    if np.ndim(values):
        return [_in_file(value, factor) for value in values]
    if factor != 1.0:
        return float(f"{values * factor:.15g}")
    return values if isinstance(values, int) else float(values)


def _named(
    parameters: Iterable[Parameter], keys: Iterable[str], place: str, *, in_file: bool = True
) -> list[Parameter]:
    """The parameters of these names, in files or in the API. Raises `InputError` for another."""
    names = {p.file_name if in_file else p.name: p for p in parameters}
    for key in (key for key in keys if key not in names):
        raise InputError.unknown(f"{place}: unknown parameter", key, names)
    return [names[key] for key in keys]


def _every(geometry: Iterable[Parameter], effects: Effects) -> list[Parameter]:
    """All parameters of a calibration: of the geometry, then of effects."""
    return [*geometry, *(p for _, effect in effects for p in effect.parameters)]


def _built(specs: Iterable[EffectSpec], chain: KinematicChain) -> Effects:
    """Specs with their effects on an arm. Raises `InputError` for effects that it cannot have."""
    if not (listed := list(specs)):
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(listed, build_all(listed, chain), strict=True))


# -- reading -----------------------------------------------------------------------------------------------------------
def load_arm(path: PathLike | Mapping[str, Any], package_dirs: Sequence[PathLike] = ()) -> Arm:
    """The arm that a TOML file describes, or the tables of one.

    package_dirs : folders in which meshes of its URDF file are, besides those beside it, below, and in its package

    Raises `InputError`, one line naming file, key, what was found and what is allowed. Warns (`UserWarning`) when the
    joint limits look like radians.
    """
    if isinstance(path, Mapping):
        return arm_from_tables(dict(path))
    tables = read_toml(path)
    for folder in package_dirs:
        if not Path(folder).is_dir():
            raise InputError(f"--package-dir: {folder} is no folder, allowed: an existing one, in which meshes are")
    try:
        arm = arm_from_tables(tables, Path(path).parent, package_dirs)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    limits = [abs(value) for values in tables.get("joint_limits_deg", {}).values() for value in values]
    if limits and max(limits) <= 2.0 * np.pi + 0.01:
        message = "joint_limits_deg: all limits are within 6.3 deg and look like radians; write them in degrees"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=2)
    return arm


def arm_from_tables(tables: Plain, folder: PathLike = ".", package_dirs: Sequence[PathLike] = ()) -> Arm:
    """The arm of parsed TOML; raises `InputError` as `load_arm` does, without the file's name.

    folder : where the files are that the tables name;  package_dirs : as of `load_arm`
    """
    file = validated_arm(tables)
    urdf = None if file.urdf is None else _urdf(str(file.urdf), folder)
    chain = _drawn_chain(file, urdf)
    n, calibration, counting = len(chain), None, None
    for place in COUNTED:
        table, _, key = place.rpartition(".")
        if (values := getattr(getattr(file, table) if table else file, key, None)) is not None:
            require_count(place, values, n)
    if file.joints is not None:  # what it leaves out is as usual
        usual: Plain = {"sign": (1,) * n, "coupled_to": (0,) * n, "zero": (0.0,) * n}
        counting = Counting(**usual | _in_api(file.joints))
        check_kinds(counting, chain.joint_types)
    lower, upper, tied = _joint_limits(file, chain, counting)
    effects = _effects(file, chain)
    if file.links_mm is None:  # so that they stand in its URDF file
        limits = zip(chain.joints, lower.tolist(), upper.tolist(), strict=True)
        chain = replace(chain, joints=tuple(replace(joint, lower=low, upper=high) for joint, low, high in limits))
    halves = Plain(center_of_mass=(0.5,) * n)
    if file.calibration is not None:
        calibration, chain = _calibration(file, chain, effects, tables["calibration"].get("provenance", {}))
    return Arm(
        chain,
        lower=lower,
        upper=upper,
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=None if file.gravity is None else Gravity(**{**halves, **_in_api(file.gravity)}),
        constraints=(*(CLASSES[table.kind](**_in_api(table)) for table in file.constraints), *tied),
        effects=tuple(spec for spec, _ in effects),
        calibration=calibration,
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
        machining=Machining() if file.machining is None else Machining(**_in_api(file.machining)),
        counting=counting,
        cell=_cell(file, urdf, chain, folder, package_dirs),
    )


def _cell(
    file: Any, urdf: Urdf | None, chain: KinematicChain, folder: PathLike, package_dirs: Sequence[PathLike]
) -> Cell | None:
    """The bodies of the file, which are read when they are asked for; None: it names none."""
    given, apart = dict[str, GivenBody](), set[frozenset[str]]()
    if file.link_width_mm is not None:
        for j, length in enumerate(file.links_mm, start=1):
            place, between = segment((0.0, 0.0), (length, 0.0))
            sizes = {"radius": np.array([0.5 * file.link_width_mm]), "length": between}
            given[f"link {j}"] = GivenBody(f"link {j}", j, (Shape("capsule", place, sizes),))
        apart |= {frozenset((f"link {j}", f"link {j + 1}")) for j in range(1, len(chain))}
    for k, table in enumerate(file.cell.bodies if file.cell is not None else (), start=1):
        joint, name = table.joint or 0, table.name or f"{table.kind} {k}"
        before = given.get(name, GivenBody(name, joint, ()))
        for wrong, sentence in (
            (joint > len(chain), f", allowed: 1 to {len(chain)}, or left out"),
            (joint != before.joint, f" for another part of {name!r}, allowed: {before.joint}"),
        ):
            if wrong:
                raise InputError(f"cell.bodies[{k}].joint: found {joint}{sentence}")
        shapes = (*before.shapes, _shape(table, f"cell.bodies[{k}].file", folder))
        given[name] = replace(before, shapes=shapes)
    drawn = urdf is not None and urdf.robot.find("link/collision") is not None
    drawn = drawn and (file.cell is None or file.cell.bodies_of_urdf is not False)
    if file.cell is None and not drawn and not given:
        return None
    beside = Path(folder) if urdf is None or urdf.text == file.urdf else Path(urdf.path).parent
    bodies = ShapedBodies(
        tuple(given.values()),
        urdf.text if drawn and urdf is not None else "",
        "" if urdf is None else urdf.path,
        (str(file.base_link), str(file.tip_link)),
        tuple(dict.fromkeys(str(each) for each in (beside, folder, *package_dirs))),
        chain.reach,
    )
    apart |= urdf.neighbours() if drawn and urdf is not None else set()
    if file.cell is None:
        return Cell(bodies, apart=frozenset(apart))
    if file.cell.srdf is not None:
        apart |= pairs_apart(named_file(folder, file.cell.srdf, "cell.srdf", "the arm file"))
    return Cell(
        bodies, file.cell.floor_z_mm, file.cell.clearance_mm, frozenset(apart | {*map(frozenset, file.cell.apart)})
    )


def _shape(table: Any, key: str, folder: PathLike) -> Shape:
    """What an entry of `[[cell.bodies]]` says;  key : of the name of a mesh's file"""
    if table.kind in ("capsule", "cylinder", "sphere"):
        ends = (table.center_mm,) * 2 if table.kind == "sphere" else (table.start_mm, table.end_mm)
        place, length = segment(*ends)
        return Shape(table.kind, place, {"radius": np.array([table.radius_mm]), "length": length})
    if table.kind == "box":  # as thick as long in the plane, in which its middle is
        return Shape("box", _pose(table), {"size": np.array([*table.size_mm, max(table.size_mm)][:3])})
    file = str(named_file(folder, table.file, key, "the arm file"))
    return Shape("mesh", _pose(table), {"scale": np.full(3, METER if table.unit == "m" else 1.0)}, file)


def _drawn_chain(file: Any, urdf: Urdf | None) -> KinematicChain:
    """The geometry as drawn, with base and measured points where the file gives them; joint limits of the URDF."""
    if file.links_mm is not None:
        chain = planar_chain(file.links_mm)
    elif urdf is not None:
        tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
        limited = [kind for kind, table in tables.items() if table is not None]
        chain = urdf.chain(str(file.base_link), str(file.tip_link), limited)
    else:
        chain = chain_of(*_dh_table(file))
    if file.base is not None:
        chain = replace(chain, base=_pose(file.base), settled=chain.settled | {BASE})
    if file.tool is not None:
        chain = replace(_with_tools(chain, file.tool), settled=chain.settled | {TOOL})
    if (table := file.instrument) is None:
        sigma = file.measurement
        scale: float | None = None
        if sigma is not None and sigma.sigma_deg is not None:
            if sigma.sigma_mm is None:
                unused = "orientations are not used; what a degree weighs against a millimetre is not known"
                warnings.warn(f"measurement.sigma_deg: found without sigma_mm: {unused}", UserWarning, stacklevel=2)
            else:  # residuals of orientations weigh as much as those of positions
                scale = sigma.sigma_mm / math.radians(sigma.sigma_deg)
        return replace(chain, angle_scale=scale)
    instrument = KINDS[chain.axes][table.kind].of_table(table.model_dump(exclude_none=True))
    if file.base is not None and instrument.own_targets:
        raise InputError(f"base: found with an [instrument] of kind {table.kind}, allowed: left out, it is the frame")
    if table.center_mm is not None and not instrument.own_targets:
        normal = np.array([0.0, 0.0, 1.0] if table.normal is None else table.normal, dtype=float)
        turn = rotation_to_z(normal / np.linalg.norm(normal)).T
        chain = replace(chain, base=pose(-turn @ np.array(table.center_mm), turn))
    return replace(chain, instrument=instrument)


def _dh_table(file: Any) -> tuple[list[DHRow], str]:
    """Rows and convention of `[[dh]]`."""
    rows = [
        DHRow(row.a_mm, math.radians(row.alpha_deg), row.d_mm, math.radians(row.offset_deg), row.joint, (-np.pi, np.pi))
        for row in file.dh
    ]
    return rows, next((row.convention for row in file.dh if row.convention), STANDARD)


def _pose(table: Any) -> Array:
    """(4, 4) [mm] of the keys x_mm .. rz_deg, zero where they are left out."""
    x, y, z, *angles = (getattr(table, key) or 0.0 for key in PoseTable.model_fields)
    return pose((x, y, z), from_angles(np.radians(angles)))


def _with_tools(chain: KinematicChain, tables: Mapping[str, Any]) -> KinematicChain:
    """With measured points, by the names of their markers, of which a single one may have none."""
    poses = {name or "1": _pose(table) for name, table in tables.items()}
    tools = {name: readonly(matrix[:3, 3]) for name, matrix in poses.items()}
    return replace(chain, tools=tools, tool_axes={name: readonly(matrix[:3, :3]) for name, matrix in poses.items()})


def _joint_limits(
    file: Any, chain: KinematicChain, counting: Counting | None
) -> tuple[Array, Array, list[ColumnLimits]]:
    """(n,) lower and (n,) upper limits of the joints [rad, mm], and the controller's of joints that it couples.

    Limits in tables of the file are the controller's, those of the chain, as of a URDF, are the joints' already.
    """
    types, limits = np.array(chain.joint_types), np.array([(joint.lower, joint.upper) for joint in chain.joints]).T
    written, tied = np.zeros(len(types), dtype=bool), []
    for kind, table in ((REVOLUTE, file.joint_limits_deg), (PRISMATIC, file.joint_limits_mm)):
        if table is not None:
            joints, (unit, factor, _) = types == kind, FILE_UNITS[JOINT_UNITS[kind]]
            for side, (name, values) in enumerate((("lower", table.lower), ("upper", table.upper))):
                require_count(f"joint_limits_{unit}.{name}", values, int(joints.sum()), f"{kind} joints")
                limits[side, joints] = np.array(values) / factor
            for j in np.flatnonzero(joints & (limits[0] >= limits[1])).tolist():
                order = f"joint {j + 1} has lower {limits[0, j] * factor:g} >= upper {limits[1, j] * factor:g}"
                raise InputError(f"joint_limits_{unit}: {order}, allowed: lower < upper")
            written |= joints
    if counting is not None:
        for j in filter(written.__getitem__, counting.coupled):
            ends = sorted((counting.sign[j] * (limits[:, j] - counting.zero[j])).tolist())
            tied.append(ColumnLimits(j + 1, tuple((counting.sign[j] * counting.matrix[j]).tolist()), *ends))
        limits = np.where(written, counting.joint_limits(*limits), limits)
    return limits[0], limits[1], tied


def _effects(file: Any, chain: KinematicChain) -> Effects:
    """The entries of `[[effects]]`, values in API units. Raises `InputError` for what arm or instrument do not have."""
    if not file.effects:
        return []
    from identification.effects import build, library

    specs = []
    for k, table in enumerate(file.effects, start=1):
        place, curve, given = f"effects[{k}]", None, dict(table.__pydantic_extra__)
        if table.name == CURVE:
            try:
                curve = ErrorCurve(*map(np.radians, (table.from_deg, table.to_deg, table.values_deg)))
            except InputError as error:
                raise InputError(f"{place}.{error}") from None
        settings = getattr(library().get(table.name), "settings", {})
        values = {key: given.pop(key) for key in list(given) if key in settings}
        effect = build(EffectSpec(table.name, table.joint, MappingProxyType(values), curve), chain)
        parameters = {p.toml_key: p for p in effect.parameters}
        for key, value in given.items():
            if (parameter := parameters.get(key)) is None:
                hint = nearest(key, ["name", "joint", *parameters, *settings])
                raise InputError(f"{place}.{key}: unknown key of {table.name}, {hint}")
            low, high = parameter.lower * parameter.to_file, parameter.upper * parameter.to_file
            if not low <= value <= high:
                allowed = f">= {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
                raise InputError(f"{place}.{key}: found {value:g}, allowed: a number {allowed}")
            values[parameter.short] = value / parameter.to_file
        specs.append(EffectSpec(table.name, table.joint, MappingProxyType(values), curve))
    effects = _built(specs, chain)
    offers = chain.instrument.offers
    state = f"an [instrument] of kind {chain.instrument.kind}" if file.instrument else "no [instrument] table"
    for k, ((spec, effect), table) in enumerate(zip(effects, file.effects, strict=True), start=1):
        for wrong, sentence in (
            (effect.of_positions and file.instrument, f"is of measured positions, found {state}, allowed: without it"),
            ("distance" in effect.needs - offers, f"needs measured distances, found {state}, allowed: kind distance"),
            ("gravity" in effect.needs and not file.gravity, "needs gravity torques, found no [gravity], allowed: one"),
        ):
            if wrong:
                raise InputError(f"effects: {spec.key} {sentence}")
        if spec.curve is not None and table.geometry:  # that was fitted with it
            fitted = _curve_parameters(chain, effects, table.geometry, f"effects[{k}].geometry")
            values = {p.name: table.geometry[p.file_name] / p.to_file for p in fitted}
            effects[k - 1] = replace(spec, curve=replace(spec.curve, geometry=values)), effect
    return effects


def _calibration(
    file: Any, chain: KinematicChain, effects: Effects, provenance: Plain
) -> tuple[Calibration, KinematicChain]:
    """In API units, and the chain whose errors it has. Raises `InputError` for parameters that arm and effects do not
    have."""
    table = file.calibration
    for j, (length, error) in enumerate(zip(file.links_mm or (), table.length_errors_mm or (), strict=False), start=1):
        if length + error <= 0.0:
            state = f"found {error:g} for link {j} of {length:g} mm"
            raise InputError(f"calibration.length_errors_mm: {state}, allowed: more than {-length:g}")
    if table.tools:  # which the file has where they are not known
        chain = _with_tools(chain, table.tools)
    parameters = _every(chain.parameters(), effects)
    lists = ((LENGTH_ERROR, table.length_errors_mm), (JOINT_OFFSET, table.joint_offsets_deg))
    given = {f"{kind}:{j}": value for kind, list_ in lists for j, value in enumerate(list_ or (), start=1)}
    given |= (table.values or {}) | table.effects
    values = {p.name: given[p.file_name] / p.to_file for p in _named(parameters, given, "calibration")}
    order = _named(parameters, table.parameters or (), "calibration.parameters")
    covariance, factors = None, np.array([1.0 / p.to_file for p in order])
    if table.covariance is not None:
        covariance = np.array(table.covariance).reshape(len(order), len(order)) * np.outer(factors, factors)
    base, tools = None if table.base is None else _pose(table.base), dict(chain.tools) if table.tools else {}
    axes = dict(chain.tool_axes) if tools and chain.angle_scale is not None else {}
    names = tuple(p.name for p in order)
    calibration = Calibration(values, names, covariance, MappingProxyType(dict(provenance)), base, tools, axes)
    return calibration, before_errors(chain, values, base, tools, axes)


# -- the drawing that a file names -------------------------------------------------------------------------------------
def _urdf(name: str, folder: PathLike) -> Urdf:
    """The URDF file that an arm file names, or its text."""
    if name.lstrip().startswith("<"):
        return parse_urdf(name, "urdf")
    return read_urdf(named_file(folder, name, "urdf", "the arm file"))


def _drawing(path: PathLike) -> tuple[Any, Urdf | None]:
    """The tables of an arm file, and its URDF file, None: it names none."""
    file = validated_arm(read_toml(path))
    return file, None if file.urdf is None else _urdf(file.urdf, Path(path).parent)


def urdf_masses(path: PathLike) -> tuple[float, ...] | None:
    """[kg] of the links, from the URDF file that an arm file names; None without one, or where it gives no mass."""
    file, urdf = _drawing(path)
    masses = () if urdf is None else urdf.masses(file.base_link, file.tip_link)
    return masses if any(masses) else None


def corrected_urdf(path: PathLike, chain: KinematicChain) -> str:
    """The URDF file that an arm file names, with the origins of a corrected chain; a bare one where it names none."""
    file, urdf = _drawing(path)
    if urdf is None:
        return urdf_text(chain, file.name)
    return with_origins(urdf, file.base_link, file.tip_link, [joint.origin for joint in chain.joints])


def dh_rows(path: PathLike) -> tuple[list[DHRow], str] | None:
    """Rows and convention of the `[[dh]]` table of an arm file; None where it has none."""
    file = validated_arm(read_toml(path))
    return None if file.dh is None else _dh_table(file)


# -- writing -----------------------------------------------------------------------------------------------------------
def dump_arm(arm: Arm) -> str:
    """The text of an arm file for `arm`; `load_arm` reads the same arm from it, to rounding (1e-14).

    That of a spatial arm has its drawing in it, as the text of a URDF file. Bodies are written as they are covered,
    without what they look like. Raises `InputError` for a spatial arm with a chosen set of parameters, and limits of
    coupled joints that are not the controller's, which no file can say.
    """
    chain, calibration, kind, degree = arm.chain, arm.calibration, "spatial", math.degrees(1.0)
    limits, sliding = np.stack(arm.column_limits), np.array(arm.joint_types) == PRISMATIC
    drawing: Plain = {"links_mm": arm.lengths}
    if chain.planar:
        kind = "planar"
        if not np.all(np.isfinite(limits)) and np.any(np.abs([arm.lower, arm.upper]) != np.pi):
            tied = "limits of coupled joints, none of which is the controller's"
            raise InputError(f"arm {arm.name}: found {tied}, allowed: with a constraint ColumnLimits for each")
    else:
        if chain.fixed:
            chosen = "has a chosen set of parameters"
            raise InputError(f"arm {arm.name}: {chosen}, allowed: all of them; a file has no such key")
        urdf = tomlkit.string(urdf_text(chain, arm.name), literal=True, multiline=True)
        drawing = {"kind": kind, "urdf": urdf, "base_link": BASE_LINK, "tip_link": TIP}
        drawing["base"] = pose_table(chain.base) if BASE in chain.settled else None
        drawing["tool"] = tool_tables(chain.tools, chain.tool_axes) if TOOL in chain.settled else None
    within = {}
    for unit, joints, factor in (("deg", ~sliding, degree), ("mm", sliding, 1.0)):
        if joints.any() and np.all(np.isfinite(limits[:, joints])):  # else those of the drawing
            lower, upper = _in_file(limits[:, joints], factor)
            within[f"joint_limits_{unit}"] = {"lower": lower, "upper": upper}
    constraints = []
    for constraint in (each for each in arm.constraints if not isinstance(each, ColumnLimits)):
        sphere = isinstance(constraint, KeepOutCircle) and kind == "spatial"
        which = "keep_out_sphere" if sphere else constraint.kind
        entries = _in_table(CONSTRAINTS[which][kind].replace("?", "").split(), constraint)
        if "facing" not in entries:
            entries.pop("acceptance_deg", None)
        constraints.append({"kind": which, **entries})
    bodies, axes = list[Plain](), slice(arm.dimension)
    for body in () if arm.cell is None else arm.cell.bodies:
        named = {"name": body.name, "joint": body.joint or None}
        for start, end, (radius,) in (np.split(capsule, [3, 6]) for capsule in body.capsules):
            ends = {"start_mm": start[axes], "end_mm": end[axes], "radius_mm": radius}
            bodies.append({"kind": "capsule", **named, **ends})
        for middle, turn, half in (np.split(box, [3, 12]) for box in body.boxes):
            place = pose_table(pose(middle, turn.reshape(3, 3)))
            place = {key: place[key] for key in POSE[kind].replace("?", "").split()}
            bodies.append({"kind": "box", **named, "size_mm": 2.0 * half[axes], **place})
    # where base and measured points are if they are somewhere without being known
    somewhere = BASE not in chain.settled and not np.array_equal(chain.base, np.eye(4))
    points = list(chain.tools) != ["1"] or bool(np.any(chain.tools["1"])) or bool(chain.tool_axes)
    points = points and TOOL not in chain.settled
    if somewhere or points:
        calibration = calibration or Calibration({})
        stands = standing_in(chain, calibration.values)
        calibration = replace(calibration, base=stands.base) if somewhere else calibration
        calibration = replace(calibration, tools=stands.tools, tool_axes=stands.tool_axes) if points else calibration
    effects, scale = _built(arm.effects, chain), chain.angle_scale
    sigma_deg = None if arm.sigma is None or scale is None else _in_file(arm.sigma / scale, degree)
    cell = arm.cell and {
        "floor_z_mm": arm.cell.floor,
        "clearance_mm": arm.cell.clearance,
        "apart": sorted(map(sorted, arm.cell.apart)) or None,
        "bodies": bodies or None,
    }
    tables = {
        "name": arm.name,
        **drawing,
        "measurement": {"sigma_deg": sigma_deg, "sigma_mm": arm.sigma},
        "instrument": chain.instrument.table() if chain.instrument.kind else None,
        **within,
        "gear_ratio": arm.gear_ratios,
        "joints": arm.counting and _in_table(JointsTable.model_fields, arm.counting),
        "machining": _in_table(MachiningTable.model_fields, arm.machining) if arm.machining != Machining() else None,
        "gravity": arm.gravity and _in_table(GravityTable.model_fields, arm.gravity),
        "constraints": constraints,
        "cell": cell,
        "effects": _effect_tables(effects, chain, effects),
        "calibration": None if calibration is None else _calibration_table(arm, effects, calibration),
    }
    return _toml({key: value for key, value in _plain(tables).items() if value not in ([], {})})


def with_effects(text: str, specs: Iterable[EffectSpec], folder: PathLike = ".") -> str:
    """`text` of an arm file with `[[effects]]` entries added for those of `specs` that it does not have yet.

    Values of the specs (API units) are written in file units, and so become known. Comments and order of the text stay.
    Raises `InputError` for effects that the arm cannot have.

    folder : where the files are that the text names
    """
    text, _, arm, before = _parsed(text, folder)
    labels = {effect.label for _, effect in before}
    wanted = _built(specs, arm.chain)
    new = [(spec, effect) for spec, effect in wanted if effect.label not in labels]
    tables = _effect_tables(new, arm.chain, [*before, *wanted])
    return _with_tables(text, "effects", tables) if tables else text


def with_calibration(text: str, calibration: Calibration, folder: PathLike = ".") -> str:
    """`text` of an arm file with its `[calibration]` replaced or added; comments and order of the rest stay.

    Effects with estimated values must stand under `[[effects]]` of the text: see `with_effects`. Raises `InputError`
    for a calibration of another number of links, or of effects the text does not have.

    folder : where the files are that the text names
    """
    text, tables, arm, effects = _parsed(text, folder)
    table = _calibration_table(arm, effects, calibration)
    arm_from_tables({**tables, "calibration": table}, folder)  # nothing is written that could not be read again
    return _with_tables(text, "calibration", table)


def _parsed(text: str, folder: PathLike) -> tuple[str, Plain, Arm, Effects]:
    """The text without a byte-order mark, its tables, and the arm that they describe without a calibration."""
    text = text.removeprefix("\ufeff")
    tables = tomllib.loads(text)
    arm = arm_from_tables({key: value for key, value in tables.items() if key != "calibration"}, folder)
    return text, tables, arm, _built(arm.effects, arm.chain)


def _curve_parameters(
    chain: KinematicChain, effects: Effects, names: Iterable[str], place: str, *, in_file: bool = True
) -> list[Parameter]:
    """Parameters of these names that were fitted with an error curve, those of measured points of any name."""
    points = [
        Parameter(key, "rad" if point[1] else "mm", kind=TOOL) for key in names if (point := MARKER.fullmatch(key))
    ]
    return _named([*_every(chain.every_parameter, effects), *points], names, place, in_file=in_file)


def _effect_tables(effects: Effects, chain: KinematicChain, every: Effects) -> list[Plain]:
    """Entries of `[[effects]]`;  every : effect of the arm"""
    tables = []
    for spec, effect in effects:
        table: Plain = {"name": spec.name, "joint": spec.joint}
        parameters = {p.short: p for p in effect.parameters}
        for short, value in spec.values.items():
            if (parameter := parameters.get(short)) is not None:
                table[parameter.toml_key] = _in_file(value, parameter.to_file)
            else:  # a setting
                table[short] = int(value) if value == int(value) else value
        if (curve := spec.curve) is not None:
            angles = (_in_file(angle, math.degrees(1.0)) for angle in (curve.start, curve.stop, curve.values))
            fitted = _curve_parameters(chain, every, curve.geometry, spec.key, in_file=False)
            geometry = {p.file_name: _in_file(curve.geometry[p.name], p.to_file) for p in fitted}
            table |= dict(zip(CURVE_KEYS, angles, strict=True)) | {"geometry": geometry or None}
        tables.append(_plain(table))
    return tables


def _calibration_table(arm: Arm, effects: Effects, calibration: Calibration) -> Plain:
    chain = replace(arm.chain, tools=calibration.tools or arm.chain.tools)
    parameters = _every(chain.parameters(), effects)
    values = calibration.values if chain.frame_kinds else calibration.effects
    order = _named(parameters, calibration.parameter_names, "calibration", in_file=False)
    named = _named(parameters, values, "calibration", in_file=False)
    in_file = {p.file_name: _in_file(values[p.name], p.to_file) for p in named}
    geometry = {name: in_file.pop(name) for name in [*in_file] if GEOMETRY.fullmatch(name)}
    table: Plain = {"values": geometry}
    if chain.planar:
        held = replace(calibration, values=dict.fromkeys(chain.held, 0.0) | dict(calibration.values))
        offsets = _in_file(held.joint_offsets, math.degrees(1.0))
        table = {"length_errors_mm": held.length_errors, "joint_offsets_deg": offsets}
    factors, covariance = [p.to_file for p in order], None
    if calibration.covariance is not None:
        rows = zip(factors, calibration.covariance, strict=True)
        covariance = [[_in_file(v, row * f) for f, v in zip(factors, line, strict=True)] for row, line in rows]
    table |= {
        "base": None if calibration.base is None else pose_table(calibration.base),
        "tools": tool_tables(calibration.tools, calibration.tool_axes) or None,
        "parameters": [p.file_name for p in order] or None,
        "covariance": covariance,
        "effects": in_file or None,
        "provenance": calibration.provenance or None,
    }
    return dict(_plain(table))


def _plain(value: Any) -> Any:
    """`value` in TOML's types, without entries that TOML cannot express (None) or that are not allowed (NaN)."""
    if isinstance(value, Mapping):
        items = {str(key): _plain(item) for key, item in value.items()}
        return {key: item for key, item in items.items() if item is not None}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [item for item in map(_plain, value) if item is not None]
    return None if isinstance(value, float) and math.isnan(value) else value


def _toml(tables: Plain) -> str:
    """The text of tables, a row of a matrix on each line."""
    text = tomlkit.dumps(tables).strip("\n") + "\n"
    matrix, rows = re.compile(r"^((?:covariance|joint_range_\w+) = \[)(\[.*\])\]$", re.MULTILINE), "],\n    ["
    return matrix.sub(lambda line: "".join([line[1], "\n    ", line[2].replace("], [", rows), ",\n]"]), text)


def _with_tables(text: str, key: str, entry: Plain | list[Plain]) -> str:
    """`text` with its table `[key]` replaced where it stands, or with entries added behind its others `[[key]]`; at the
    end where it has none. Blank lines and comments before the header that follows stay there.

    A parser has then read exactly the intended tables: a user's file is never damaged. A file whose layout does not
    allow that is written anew, without its comments.
    """
    tables, new = tomllib.loads(text), _toml({key: entry})
    wanted = tables | {key: entry if isinstance(entry, dict) else [*tables.get(key, ()), *entry]}
    lines = [f"{line}\n" for line in text.removesuffix("\n").split("\n")]
    headers = {k: header[1] for k, line in enumerate(lines) if (header := HEADER.fullmatch(line.strip()))}
    start = end = len(lines)
    if of_key := [k for k, name in headers.items() if name == key]:
        start, end = of_key[0], next((k for k in headers if k > of_key[-1]), len(lines))
        while not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#"):
            end -= 1
    if isinstance(entry, list) or not of_key:
        start, new = end, f"\n{new}"
    spliced = "".join([*lines[:start], new, *lines[end:]])
    try:
        kept = tomllib.loads(spliced) == wanted
    except tomllib.TOMLDecodeError:  # it stands in one line, or in several places
        kept = False
    return spliced if kept else _toml(wanted)
