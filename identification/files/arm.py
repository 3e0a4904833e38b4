"""Arm files: TOML in millimetres and degrees -> `Arm` in millimetres and radians, and what is found written into them.

Keys of files end with their unit, names of our classes are the same without it: `half_angle_deg` is `half_angle`.
Effects and calibrations are written into a user's own text, whose comments and order stay as they are.
"""

import math
import re
import tomllib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import tomlkit
from pydantic import BaseModel

from identification.arm import Arm, Calibration, EffectSpec, ErrorCurve, Gravity, Machining, check_limits
from identification.arrays import Array
from identification.errors import InputError, nearest, require
from identification.files.bodies import Shape, ShapedBodies, pairs_apart
from identification.files.io import PathLike, named_file, read_toml
from identification.files.schema import CURVE, CalibrationTable, EffectTable, PoseTable, validated, validated_arm
from identification.files.urdf import METER, Urdf, read_urdf, urdf_text
from identification.instruments import KINDS, Tracker
from identification.kinematics import chain as chains
from identification.kinematics.chain import BASE, STANDARD, TOOL, CorrectedGeometry, DHRow, KinematicChain
from identification.kinematics.counting import Counting
from identification.kinematics.frames import from_angles, pose, pose_table, rotation_to_z, tool_tables
from identification.kinematics.parameters import GEOMETRY, PRISMATIC, REVOLUTE, Parameter, by_joint
from identification.workspace import Cell, ColumnLimits, KeepOut, LineOfSight, WorkspaceBox

if TYPE_CHECKING:
    from identification.effects import Effect

Plain = dict[str, Any]
Effects: TypeAlias = "list[tuple[EffectSpec, Effect]]"
TURN = (-np.pi, np.pi)  # limits of joints whose file gives none
MARKER = re.compile(r"tool\[.*\]\.(r?)[xyz]")
HEADER = re.compile(r"\[\[?\s*([\w-]+)[\w.\"' -]*\]\]?\s*(#.*)?")  # of a table
CLASSES: dict[str, Any] = {each.kind: each for each in (WorkspaceBox, LineOfSight)}  # others are `KeepOut`
RENAMED = {"range_mm": "reach", "center_mm": "start"}  # keys with other names in our classes


# -- reading -----------------------------------------------------------------------------------------------------------
def load_arm(path: PathLike | Mapping[str, Any], package_dirs: Sequence[PathLike] = ()) -> Arm:
    """The arm that a TOML file describes, or the tables of one.

    package_dirs : folders with meshes of its URDF file, besides its own folder, those below, and its package

    Raises `InputError`, one line naming file, key, what was found and what is allowed. Warns (`UserWarning`) when
    lengths look like metres or joint limits like radians.
    """
    if isinstance(path, Mapping):
        return arm_from_tables(dict(path))
    tables = read_toml(path)
    for folder in package_dirs:
        require(Path(folder).is_dir(), f"--package-dir: {folder} is not a folder, allowed: an existing one with meshes")
    with InputError.at(path):
        arm = arm_from_tables(tables, Path(path).parent, package_dirs)
    if 0.0 < arm.reach < 10.0:
        message = f"the arm reaches {arm.reach:.4g} mm, which looks like metres; write millimetres"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=2)
    limits = [abs(value) for values in tables.get("joint_limits_deg", {}).values() for value in values]
    if limits and max(limits) <= 2.0 * np.pi + 0.01:
        message = "joint_limits_deg: all limits are within 6.3 deg and look like radians; write them in degrees"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=2)
    return arm


def arm_from_tables(tables: Plain, folder: PathLike = ".", package_dirs: Sequence[PathLike] = ()) -> Arm:
    """The arm of parsed TOML; raises `InputError` as `load_arm` does, without the file's name;
    folder : where the files are that the tables name;  package_dirs : as of `load_arm`"""
    file = validated_arm(tables)
    urdf = None if file.urdf is None else read_urdf(named_file(folder, file.urdf, "urdf", "the arm file"))
    chain = _drawn_chain(file, urdf)
    n, types = len(chain), np.array(chain.joint_types)
    counted = "gravity.link_masses_kg gravity.center_of_mass gravity.center_of_mass_mm joints.sign joints.coupled_to"
    for place in (*counted.split(), "joints.zero_deg"):
        table, _, key = place.partition(".")
        _require_count(place, getattr(getattr(file, table), key, None), n)
    counting, calibration, tied = replace(Counting.usual(n), **_in_api(file.joints)), None, list[ColumnLimits]()
    # limits in tables are the controller's, those of the chain, as of a URDF, are the joints' already
    limits, written = np.array([(joint.lower, joint.upper) for joint in chain.joints]).T, np.zeros(n, dtype=bool)
    for kind, key in ((REVOLUTE, "joint_limits_deg"), (PRISMATIC, "joint_limits_mm")):
        if (table := getattr(file, key)) is not None:
            joints = types == kind
            for side, (end, values) in enumerate(table):
                _require_count(f"{key}.{end}", values, int(joints.sum()), f"{kind} joints")
                limits[side, joints] = values
            written |= joints
    check_limits(limits[0], limits[1], chain.joint_types)
    for j in filter(written.__getitem__, counting.coupled):  # limits of columns with angles of several joints tie these
        ends = sorted((counting.sign[j] * (limits[:, j] - counting.zero[j])).tolist())
        tied.append(ColumnLimits(j + 1, tuple((counting.sign[j] * counting.matrix[j]).tolist()), *ends))
    limits = np.where(written, counting.joint_limits(*limits), limits)
    if file.links_mm is None:  # so that they stand in its URDF file
        each = zip(chain.joints, *limits.tolist(), strict=True)
        chain = replace(chain, joints=tuple(replace(joint, lower=low, upper=high) for joint, low, high in each))
    if file.gravity is not None and file.gravity.center_of_mass is not None is not file.gravity.center_of_mass_mm:
        raise InputError("gravity.center_of_mass: found beside center_of_mass_mm, allowed: one of them")
    halves: Plain = {"center_of_mass": (0.5,) * n}
    gravity = None if file.gravity is None else Gravity(**halves | _in_api(file.gravity))
    effects = _effects(file.effects, chain, gravity is not None)
    if file.calibration is not None:
        calibration, chain = _calibration(file.calibration, chain, effects, tables["calibration"].get("provenance", {}))
    return Arm(
        chain,
        lower=limits[0],
        upper=limits[1],
        sigma=file.measurement.sigma_mm,
        name=file.name,
        gravity=gravity,
        constraints=(*(CLASSES.get(table.kind, KeepOut)(**_in_api(table)) for table in file.constraints), *tied),
        effects=tuple(spec for spec, _ in effects),
        calibration=calibration,
        gear_ratios=file.gear_ratio,
        machining=Machining(**_in_api(file.machining)),
        counting=counting,
        cell=_cell(file, urdf, chain, folder, package_dirs),
    )


def described(arm: Arm, effects: Sequence[Plain] | None, calibration: Plain | None = None) -> Arm:
    """An arm with entries of `[[effects]]`, None: its own, and with a `[calibration]`, None: without any."""
    chain, kind, found = arm.chain, arm.chain.kind, None
    built = _built(arm.effects, chain)
    if effects is not None:
        entries = [validated(EffectTable, each, f"effects[{k}].", kind) for k, each in enumerate(effects, start=1)]
        built = _effects(entries, chain, arm.gravity is not None)
    if calibration is not None:
        found, _ = _calibration(validated(CalibrationTable, calibration, "calibration.", kind), chain, built, {})
    return replace(arm, effects=tuple(spec for spec, _ in built), calibration=found)


def _require_count(key: str, values: Sequence[Any] | None, count: int, whose: str = "joints") -> None:
    if values is not None and len(values) != count:
        raise InputError(f"{key}: found {len(values)} values for {count} {whose}, allowed: {count}")


def _in_api(table: BaseModel | None) -> Plain:
    """What a table has, by the names of our classes, several numbers as a tuple; None: nothing."""
    values: Plain = {} if table is None else table.model_dump(exclude_none=True, exclude={"kind"})
    names = {key: RENAMED.get(key) or re.sub(r"_(mm|deg|kg|m_s2)$", "", key) for key in values}
    return {names[key]: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _drawn_chain(file: Any, urdf: Urdf | None) -> KinematicChain:
    """The geometry as drawn, with base and measured points where the file gives them; joint limits of the URDF."""
    if file.links_mm is not None:
        chain = chains.planar_chain(file.links_mm)
    elif urdf is not None:
        tables = {REVOLUTE: file.joint_limits_deg, PRISMATIC: file.joint_limits_mm}
        chain = urdf.chain(file.base_link, file.tip_link, [kind for kind, table in tables.items() if table is not None])
    else:
        limits = None if file.joint_limits_mm is None else TURN  # those of joints that slide are given elsewhere
        rows = [DHRow(row.a_mm, row.alpha_deg, row.d_mm, row.offset_deg, row.joint, limits) for row in file.dh]
        chain = chains.chain_of(rows, next((row.convention for row in file.dh if row.convention), STANDARD))
    if file.base is not None:
        chain = replace(chain, base=_pose(file.base), settled=chain.settled | {BASE})
    if file.tool is not None:
        chain = replace(chain, tools=_tools(file.tool), settled=chain.settled | {TOOL})
    if (table := file.instrument) is None:
        sigma, turn = file.measurement.sigma_mm, file.measurement.sigma_deg
        if turn is not None and sigma is None:
            unused = "orientations are not used, since their weight relative to positions is not known"
            warnings.warn(f"measurement.sigma_deg: found without sigma_mm: {unused}", UserWarning, stacklevel=2)
        # residuals of orientations weigh as much as those of positions
        return replace(chain, instrument=Tracker(turn and sigma and sigma / turn))
    instrument = KINDS[chain.axes][table.kind].of_table(table.model_dump(exclude_none=True))
    if file.base is not None and instrument.own_targets:
        raise InputError(f"base: found with an [instrument] of kind {table.kind}, allowed: left out, it is the frame")
    if table.center_mm is not None and not instrument.own_targets:
        normal = np.array([0.0, 0.0, 1.0] if table.normal is None else table.normal, dtype=float)
        turn = rotation_to_z(normal / np.linalg.norm(normal)).T
        chain = replace(chain, base=pose(-turn @ np.array(table.center_mm), turn))
    return replace(chain, instrument=instrument)


def _pose(table: Any) -> Array:
    """(4, 4) [mm] of the keys x_mm .. rz_deg, zero where they are left out."""
    numbers = [getattr(table, key) or 0.0 for key in PoseTable.model_fields]
    return pose(numbers[:3], from_angles(numbers[3:]))


def _tools(tables: Mapping[str, Any]) -> dict[str, Array]:
    """Measured points by the names of their markers, of which a single one may have none."""
    return {name or "1": _pose(table) for name, table in tables.items()}


def _cell(
    file: Any, urdf: Urdf | None, chain: KinematicChain, folder: PathLike, package_dirs: Sequence[PathLike]
) -> Cell | None:
    """The bodies of the file, which are read when they are asked for; None: it names none."""
    cell, shapes, apart = file.cell, list[tuple[str, int, Shape]](), {*map(frozenset, file.cell.apart)}
    if file.link_width_mm is not None:
        for j, length in enumerate(file.links_mm, start=1):
            link = Shape.between("capsule", (0.0, 0.0), (length, 0.0), 0.5 * file.link_width_mm)
            shapes.append((f"link {j}", j, link))
        apart |= {frozenset((f"link {j}", f"link {j + 1}")) for j in range(1, len(chain))}
    for k, table in enumerate(cell.bodies, start=1):
        joint, name = table.joint or 0, table.name or f"{table.kind} {k}"
        require(joint <= len(chain), f"cell.bodies[{k}].joint: found {joint}, allowed: 1 to {len(chain)}, or left out")
        if other := [at for body, at, _ in shapes if body == name and at != joint]:
            raise InputError(f"cell.bodies[{k}].joint: found {joint} for another part of {name!r}, allowed: {other[0]}")
        if table.kind in ("capsule", "cylinder", "sphere"):
            start, end = table.start_mm or table.center_mm, table.end_mm or table.center_mm  # a ball has one place
            shape = Shape.between(table.kind, start, end, table.radius_mm)
        elif table.kind == "box":  # as thick as long in the plane, in which its middle is
            shape = Shape("box", _pose(table), np.array([*table.size_mm, max(table.size_mm)][:3]))
        else:
            mesh = str(named_file(folder, table.file, f"cell.bodies[{k}].file", "the arm file"))
            shape = Shape("mesh", _pose(table), np.full(3, METER if table.unit == "m" else 1.0), mesh)
        shapes.append((name, joint, shape))
    wanted = cell.bodies_of_urdf is not False and urdf and urdf.robot.find("link/collision") is not None
    solid = urdf if wanted else None
    apart |= solid.neighbours() if solid else frozenset()
    names = {Cell.FLOOR, Cell.SIGHT, *(urdf.links if urdf else ()), *(name for name, _, _ in shapes)}
    InputError.check_names("cell.apart: unknown body", (name for pair in cell.apart for name in pair), names)
    if not ("cell" in file.model_fields_set or solid or shapes):
        return None
    if cell.srdf is not None:
        apart |= pairs_apart(named_file(folder, cell.srdf, "cell.srdf", "the arm file"))
    folders = tuple(dict.fromkeys(map(str, (Path(urdf.path).parent if urdf else folder, folder, *package_dirs))))
    bodies = ShapedBodies(tuple(shapes), solid, (str(file.base_link), str(file.tip_link)), folders, chain.reach)
    return Cell(bodies, cell.floor_z_mm, cell.clearance_mm, frozenset(apart))


# -- effects and calibration -------------------------------------------------------------------------------------------
def _built(specs: Sequence[EffectSpec], chain: KinematicChain) -> Effects:
    """Specs with their effects on an arm. Raises `InputError` for effects that it cannot have."""
    if not specs:
        return []
    from identification.effects import build_all  # imports CasADi: only arms with effects pay for it

    return list(zip(specs, build_all(specs, chain), strict=True))


def _named(
    geometry: Iterable[Parameter], effects: Effects, keys: Iterable[str], place: str, *, in_file: bool = True
) -> list[Parameter]:
    """The parameters of these names, in files or in the API. Raises `InputError` for another."""
    every = [*geometry, *(p for _, effect in effects for p in effect.parameters)]
    names = {p.file_name if in_file else p.name: p for p in every}
    InputError.check_names(f"{place}: unknown parameter", keys, names)
    return [names[key] for key in keys]


def _fitted_with(curve: Iterable[str], chain: KinematicChain) -> list[Parameter]:
    """Parameters of the geometry that an error curve may have, measured points of any name among them."""
    points = ((key, point[1]) for key in curve if (point := MARKER.fullmatch(key)))
    return [*chain.every_parameter, *(Parameter(key, "rad" if turns else "mm", kind=TOOL) for key, turns in points)]


def _effects(tables: Sequence[EffectTable], chain: KinematicChain, heavy: bool) -> Effects:
    """Entries of `[[effects]]` in API units. Raises `InputError` for what arm or instrument do not have;  heavy : the
    arm has gravity"""
    specs = []
    for k, table in enumerate(tables, start=1):
        from identification.effects import library

        curve, settings = None, getattr(library().get(table.name), "settings", {})
        if table.name == CURVE:
            try:
                curve = ErrorCurve(table.from_deg, table.to_deg, table.values_deg)  # type: ignore[arg-type]
            except InputError as error:
                raise InputError(f"effects[{k}].{error}") from None
        chosen = {key: value for key, value in table.__pydantic_extra__.items() if key in settings}
        specs.append(EffectSpec(table.name, table.joint, chosen, curve))
    effects, instrument = _built(specs, chain), chain.instrument
    state = f"an [instrument] of kind {instrument.kind}" if instrument.kind else "no [instrument] table"
    for k, ((spec, effect), table) in enumerate(zip(effects, tables, strict=True), start=1):
        lacking, values = effect.needs - instrument.offers, dict(spec.values)
        parameters = {p.toml_key: p for p in effect.parameters}
        for key, value in ((key, value) for key, value in table.__pydantic_extra__.items() if key not in spec.values):
            if (parameter := parameters.get(key)) is None:
                hint = nearest(key, ["name", "joint", *parameters, *spec.values])
                raise InputError(f"effects[{k}].{key}: unknown key of {table.name}, {hint}")
            low, high = parameter.lower * parameter.to_file, parameter.upper * parameter.to_file
            allowed = f">= {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
            require(low <= value <= high, f"effects[{k}].{key}: found {value:g}, allowed: a number {allowed}")
            values[parameter.short] = value / parameter.to_file
        for wrong, sentence in (
            (effect.of_positions and instrument.kind, f"is of measured positions, found {state}, allowed: without it"),
            ("distance" in lacking, f"needs measured distances, found {state}, allowed: kind distance"),
            ("gravity" in lacking and not heavy, "needs gravity torques, found no [gravity], allowed: one"),
        ):
            require(not wrong, f"effects: {spec.key} {sentence}")
        curve = spec.curve
        if curve is not None and table.geometry:  # that was fitted with it
            fitted = _named(_fitted_with(table.geometry, chain), effects, table.geometry, f"effects[{k}].geometry")
            curve = replace(curve, geometry={p.name: table.geometry[p.file_name] / p.to_file for p in fitted})
        effects[k - 1] = replace(spec, values=values, curve=curve), effect
    return effects


def _calibration(
    table: Any, chain: KinematicChain, effects: Effects, provenance: Mapping[str, Any]
) -> tuple[Calibration, KinematicChain]:
    """In API units, and the chain whose errors it has. Raises `InputError` for parameters that are not of the arm."""
    given = (table.values or {}) | table.effects
    for kind, key in chain.lists.items():
        if (values := getattr(table, key)) is not None:
            _require_count(f"calibration.{key}", values, len(chain))
            given |= {f"{kind}:{j}": value for j, value in enumerate(values, start=1)}
    for j, (length, error) in enumerate(zip(chain.lengths, table.length_errors_mm or (), strict=False), start=1):
        state = f"found {error:g} for link {j} of {length:g} mm"
        require(length + error > 0.0, f"calibration.length_errors_mm: {state}, allowed: more than {-length:g}")
    if table.tools:  # which the file has where they are not known
        chain = replace(chain, tools=_tools(table.tools))
    base, tools = None if table.base is None else _pose(table.base), chain.tools if table.tools else {}
    # where its base was before the fit says which turn about the normal of a touched plane was not fitted
    every = {p.file_name: p for p in chain.every_parameter}
    moved = {every[key].name: value / every[key].to_file for key, value in given.items() if key in every}
    drawn = (chain if base is None else replace(chain, base=base)).standing_in(moved, back=True)
    chain = chain if base is None else replace(chain, base=drawn.base)
    chain = replace(chain, tools=drawn.tools) if tools else chain
    parameters = chain.parameters()
    in_api = {p.name: given[p.file_name] / p.to_file for p in _named(parameters, effects, given, "calibration")}
    order = _named(parameters, effects, table.parameters or (), "calibration.parameters")
    covariance, factors = None, np.array([1.0 / p.to_file for p in order])
    if table.covariance is not None:
        covariance = np.array(table.covariance).reshape(len(order), len(order)) * np.outer(factors, factors)
    return Calibration(in_api, tuple(p.name for p in order), covariance, provenance, base, tools), chain


# -- the drawing that a file names -------------------------------------------------------------------------------------
def corrected_urdf(path: PathLike, geometry: CorrectedGeometry | None) -> str:
    """The URDF file that an arm file names, with the origins of a corrected chain; a bare one where it names none.
    Raises `InputError` where there is no such geometry."""
    if geometry is None:
        raise InputError("--urdf: found for a planar arm, allowed: for spatial arms")
    file, chain = validated_arm(read_toml(path)), geometry.real
    if file.urdf is None:
        return urdf_text(chain, file.name)
    urdf = read_urdf(named_file(Path(path).parent, file.urdf, "urdf", "the arm file"))
    return urdf.with_origins(file.base_link, file.tip_link, [joint.origin for joint in chain.joints])


# -- writing -----------------------------------------------------------------------------------------------------------
def with_effects(
    text: str, specs: Iterable[EffectSpec] = (), folder: PathLike = ".", calibration: Calibration | None = None
) -> str:
    """`text` of an arm file with what was found written into it; comments and order of the rest stay.

    specs : `[[effects]]` entries are added for those that it does not have yet; their values (API units) are written in
        file units, and so become known
    folder : where the files are that the text names
    calibration : in the place of its `[calibration]`, None: that stays as it is. Effects with estimated values are
        those of the text and of `specs`

    Raises `InputError` for effects that the arm cannot have, and for a calibration of another number of links, or of
    effects that the arm does not have.
    """
    text = text.removeprefix("\ufeff")
    tables = tomllib.loads(text)
    arm = arm_from_tables({key: value for key, value in tables.items() if key != "calibration"}, folder)
    before = _built(arm.effects, arm.chain)
    labels, entries = {effect.label for _, effect in before}, list[Plain]()
    wanted = [each for each in _built(tuple(specs), arm.chain) if each[1].label not in labels]
    for spec, effect in wanted:
        entry: Plain = {"name": spec.name, "joint": spec.joint}
        parameters = {p.short: p for p in effect.parameters}
        for short, value in spec.values.items():
            if (parameter := parameters.get(short)) is not None:
                entry[parameter.toml_key] = _in_file(value, parameter.to_file)
            else:  # a setting
                entry[short] = int(value) if value == int(value) else value
        if (curve := spec.curve) is not None:
            for key, angles in (("from_deg", curve.start), ("to_deg", curve.stop), ("values_deg", curve.values)):
                entry[key] = _in_file(angles, math.degrees(1.0))
            every = _fitted_with(curve.geometry, arm.chain)
            fitted = _named(every, [*before, *wanted], curve.geometry, spec.key, in_file=False)
            entry["geometry"] = {p.file_name: _in_file(curve.geometry[p.name], p.to_file) for p in fitted} or None
        entries.append(_plain(entry))
    if entries:
        text = _with_tables(text, "effects", entries)
        tables["effects"] = [*tables.get("effects", ()), *entries]
    if calibration is None:
        return text
    effects = _built([spec for spec, _ in (*before, *wanted)], arm.chain)
    chain = replace(arm.chain, tools=calibration.tools or arm.chain.tools)
    values = dict.fromkeys(chain.unestimated, 0.0) | dict(calibration.values)
    named, order = (
        _named(chain.every_parameter, effects, names, "calibration", in_file=False)
        for names in (values, calibration.parameter_names)
    )
    in_file = {p.file_name: _in_file(values[p.name], p.to_file) for p in named}
    geometry = {name: in_file.pop(name) for name in [*in_file] if GEOMETRY.fullmatch(name)}
    table: Plain = {key: by_joint(geometry, kind) for kind, key in chain.lists.items()} or {"values": geometry}
    factors, covariance = np.array([p.to_file for p in order]), None
    if calibration.covariance is not None:
        covariance = _in_file(calibration.covariance, np.outer(factors, factors))
    table |= {
        "base": None if calibration.base is None else pose_table(calibration.base),
        "tools": tool_tables(calibration.tools) or None,
        "parameters": [p.file_name for p in order] or None,
        "covariance": covariance,
        "effects": in_file or None,
        "provenance": calibration.provenance or None,
    }
    table = _plain(table)
    arm_from_tables({**tables, "calibration": table}, folder)  # nothing is written that could not be read again
    return _with_tables(text, "calibration", table)


def _in_file(values: Any, factors: Any) -> Any:
    """A number or numbers in file units, to 15 significant digits where they are converted: 30 rather than
    29.999999999999996, the same angle in radians to rounding."""
    converted = np.vectorize(lambda x, factor: x if factor == 1.0 else float(f"{x * factor:.15g}"), otypes=[float])
    return converted(values, factors).tolist()


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
