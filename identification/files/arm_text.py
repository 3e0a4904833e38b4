"""Arm files, writing: `Arm` -> TOML in millimetres and degrees; effects and calibrations into a user's own text, whose
comments and order stay as they are."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
import tomlkit
from pydantic import BaseModel
from tomlkit.items import AoT, Comment, Item, Table, Whitespace

from identification.arm import Arm, Calibration, EffectSpec, Machining
from identification.errors import InputError, JobError, nearest
from identification.files.arm import (
    GEOMETRY_KEY,
    RENAMED,
    UNIT,
    FileName,
    arm_from_tables,
    built,
    curve_name,
    file_names,
)
from identification.files.io import PathLike, read_toml
from identification.files.schema import ConstraintTable, GravityTable, MachiningTable
from identification.files.urdf import BASE_LINK, TIP, urdf_text
from identification.kinematics.chain import BASE, TOOL, KinematicChain
from identification.kinematics.corrected import standing_in
from identification.kinematics.frames import pose_table, tool_tables
from identification.kinematics.parameters import GEOMETRY, PRISMATIC
from identification.workspace import ColumnLimits

if TYPE_CHECKING:
    from identification.effects import Effect

Plain = dict[str, Any]


def dump_arm(arm: Arm) -> str:
    """The text of an arm file for `arm`; `load_arm` reads the same arm from it, to rounding (1e-14).

    That of a spatial arm has its drawing in it, as the text of a URDF file.
    Raises `InputError` for a spatial arm with a chosen set of parameters, which no file can say.
    """
    tables: Plain = {"name": arm.name} | _chain_tables(arm, arm.chain)
    limits, sliding = np.stack(arm.column_limits), np.array(arm.joint_types) == PRISMATIC
    for unit, joints, factor in (("deg", ~sliding, math.degrees(1.0)), ("mm", sliding, 1.0)):
        if joints.any() and np.all(np.isfinite(limits[:, joints])):  # else those of the drawing
            lower, upper = _in_file(limits[:, joints], factor)
            tables[f"joint_limits_{unit}"] = {"lower": lower, "upper": upper}
    if (counting := arm.counting) is not None:
        signs = {"sign": list(counting.sign), "coupled_to": list(counting.coupled_to)}
        tables["joints"] = signs | {"zero_deg": _degrees(counting.zero)}
    if arm.gear_ratios is not None:
        tables["gear_ratio"] = _in_file(arm.gear_ratios)
    if arm.sigma is not None:
        tables.setdefault("measurement", {})["sigma_mm"] = float(arm.sigma)
    if arm.machining != Machining():
        tables["machining"] = _table(MachiningTable, arm.machining)
    if arm.gravity is not None:
        tables["gravity"] = _table(GravityTable, arm.gravity)
    for constraint in (each for each in arm.constraints if not isinstance(each, ColumnLimits)):
        kind = constraint.kind if len(getattr(constraint, "center", ())) < 3 else "keep_out_sphere"
        [table] = [each for each in get_args(ConstraintTable) if kind in get_args(each.model_fields["kind"].annotation)]
        entries = {"kind": kind} | _table(table, constraint)
        if "facing" not in entries:
            entries.pop("acceptance_deg", None)
        tables.setdefault("constraints", []).append(entries)
    # where base and measured points are if they are somewhere without being known
    chain, calibration = arm.chain, arm.calibration
    somewhere = BASE not in chain.settled and not np.array_equal(chain.base, np.eye(4))
    named = TOOL not in chain.settled and (
        list(chain.tools) != ["1"] or bool(np.any(chain.tools["1"])) or bool(chain.tool_axes)
    )
    if somewhere or named:
        calibration = calibration or Calibration({})
        stands = standing_in(chain, calibration.values)
        calibration = replace(calibration, base=stands.base) if somewhere else calibration
        if named:
            calibration = replace(calibration, tools=stands.tools, tool_axes=stands.tool_axes)
    text = with_effects(tomlkit.dumps(tables), arm.effects)
    return text if calibration is None else with_calibration(text, calibration)


def with_effects(text: str, specs: Iterable[EffectSpec], folder: PathLike = ".") -> str:
    """`text` of an arm file with `[[effects]]` entries added for those of `specs` that it does not have yet.

    Values of the specs (API units) are written in file units, and so become known. Comments and order of the text stay.
    Raises `InputError` for effects that the arm cannot have.

    folder : where the files are that the text names
    """
    text, _, arm = _parsed(text, folder)
    before = built(arm.effects, arm.chain)
    labels = {effect.label for _, effect in before}
    wanted = built(specs, arm.chain)
    geometry = arm.chain.every_parameter
    names = {name.api: name for name in file_names(geometry, [*before, *wanted])}
    tables = [_effect_table(spec, effect, names) for spec, effect in wanted if effect.label not in labels]
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
    source, copy = Path(path).parent / name, Path(out).parent / name
    return {} if copy.exists() and copy.read_bytes() == source.read_bytes() else {copy: source.read_bytes()}


def _parsed(text: str, folder: PathLike) -> tuple[str, Plain, Arm]:
    """The text without a byte-order mark, its tables, and the arm that they describe without a calibration."""
    text = text.removeprefix("\ufeff")
    tables = tomllib.loads(text)
    return text, tables, arm_from_tables({key: value for key, value in tables.items() if key != "calibration"}, folder)


# -- tables, as plain Python in file units -----------------------------------------------------------------------------
def _in_file(values: Any, factor: float = 1.0) -> Any:
    """A number or numbers in file units, to 15 significant digits where they are converted: 30 rather than
    29.999999999999996, the same angle in radians to rounding."""
    if np.ndim(values):
        return [_in_file(value, factor) for value in values]
    return float(values) if factor == 1.0 else float(f"{values * factor:.15g}")


def _degrees(radians: Any) -> Any:
    return _in_file(radians, math.degrees(1.0))


def _table(table: type[BaseModel], value: Any) -> Plain:
    """What a table has of one of our classes; `in_api` reads it."""
    entries: Plain = {}
    for key in (key for key in table.model_fields if key != "kind"):
        if (number := getattr(value, RENAMED.get(key) or UNIT.sub("", key), None)) is not None:
            entries[key] = _in_file(number, math.degrees(1.0) if key.endswith("_deg") else 1.0)
    return entries


def _chain_tables(arm: Arm, chain: KinematicChain) -> Plain:
    """What an arm file says of the geometry, how it is measured, and what is known of base and measured points; the
    drawing of an arm in space as the text of a URDF file."""
    if chain.planar:
        if not np.all(np.isfinite(arm.column_limits)) and np.any(np.abs([arm.lower, arm.upper]) != np.pi):
            tied = "limits of coupled joints, none of which is the controller's"
            raise InputError(f"arm {arm.name}: found {tied}, allowed: with a constraint ColumnLimits for each")
        tables: Plain = {"links_mm": _in_file(arm.lengths)}
        return tables | ({"instrument": chain.instrument.table()} if chain.instrument.kind else {})
    if chain.fixed:
        chosen = "has a chosen set of parameters"
        raise InputError(f"arm {arm.name}: {chosen}, allowed: all of them; a file has no such key")
    tables = {"kind": "spatial"}
    tables["urdf"] = tomlkit.string(urdf_text(chain, arm.name), literal=True, multiline=True)
    tables |= {"base_link": BASE_LINK, "tip_link": TIP}
    if BASE in chain.settled:
        tables["base"] = pose_table(chain.base)
    if TOOL in chain.settled:
        tables["tool"] = tool_tables(chain.tools, chain.tool_axes)
    if chain.angle_scale is not None and arm.sigma is not None:
        tables["measurement"] = {"sigma_deg": _degrees(arm.sigma / chain.angle_scale)}
    if chain.instrument.kind:
        tables["instrument"] = chain.instrument.table()
    return tables


def _effect_table(spec: EffectSpec, effect: Effect, names: Mapping[str, FileName]) -> Plain:
    table: Plain = {"name": spec.name} if spec.joint is None else {"name": spec.name, "joint": int(spec.joint)}
    parameters = {p.short: p for p in effect.parameters}
    for short, value in spec.values.items():
        if short in parameters:
            table[parameters[short].toml_key] = _in_file(value, parameters[short].to_file)
        else:  # a setting
            table[short] = int(value) if value == int(value) else float(value)
    if (curve := spec.curve) is not None:
        ends = {"from_deg": _degrees(curve.start), "to_deg": _degrees(curve.stop)}
        table |= ends | {"values_deg": _degrees(curve.values)}
        tied = {curve_name(api, names, spec.key): value for api, value in curve.geometry.items()}
        table |= {GEOMETRY_KEY: {n.file: _in_file(v, n.factor) for n, v in tied.items()}} if tied else {}
    return table


def _calibration_table(arm: Arm, calibration: Calibration) -> Plain:
    chain = replace(arm.chain, tools=calibration.tools or arm.chain.tools)
    by_api = {name.api: name for name in file_names(chain.parameters(), built(arm.effects, arm.chain))}
    values = calibration.effects if chain.planar else calibration.values
    for name in (*values, *calibration.parameter_names):
        if name not in by_api:
            raise InputError(f"calibration: unknown parameter {name!r}, {nearest(name, by_api)}")
    in_file = {name: _in_file(value, by_api[name].factor) for name, value in values.items()}
    if chain.planar:
        calibration = replace(calibration, values=dict.fromkeys(chain.held, 0.0) | dict(calibration.values))
        errors, offsets = _in_file(calibration.length_errors), _degrees(calibration.joint_offsets)
        tables: Plain = {"length_errors_mm": errors, "joint_offsets_deg": offsets}
    else:
        tables = {"values": {name: value for name, value in in_file.items() if GEOMETRY.fullmatch(name)}}
    if calibration.base is not None:
        tables["base"] = pose_table(calibration.base)
    if calibration.tools:
        tables["tools"] = tool_tables(calibration.tools, calibration.tool_axes)
    order = [by_api[api] for api in calibration.parameter_names]
    if order:
        tables["parameters"] = [name.file for name in order]
    if (covariance := calibration.covariance) is not None:
        rows = zip(order, covariance, strict=True)
        tables["covariance"] = [
            [_in_file(v, row.factor * column.factor) for column, v in zip(order, values, strict=True)]
            for row, values in rows
        ]
    if effects := calibration.effects:
        tables["effects"] = {by_api[api].file: in_file[api] for api in effects}
    if calibration.provenance:
        tables["provenance"] = _plain(calibration.provenance)
    return tables


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


# -- into a user's text ------------------------------------------------------------------------------------------------
def append_tables(text: str, key: str, entries: list[Plain]) -> str:
    """`text` with `entries` added to the array of tables `[[key]]`, which is made if it is not there."""
    before = tomllib.loads(text)
    document = tomlkit.parse(text if text.endswith("\n") else text + "\n")
    existing = document.get(key)
    if isinstance(existing, AoT):
        trivia = _pop_trailing(existing[-1])
        for entry in entries:
            _extend(existing[-1], [Whitespace("\n")])
            existing.append(_filled(tomlkit.table(), entry))
        _extend(existing[-1], trivia)
    elif existing is not None:  # key = [{...}], in one line
        existing.extend(entries)
    else:
        document[key] = AoT([_filled(tomlkit.table(), entry) for entry in entries])
    return _checked(document, {**before, key: [*before.get(key, ()), *entries]})


def replace_table(text: str, key: str, entry: Plain) -> str:
    """`text` with the table `[key]` replaced where it stands, or added at the end."""
    before = tomllib.loads(text)
    document = tomlkit.parse(text if text.endswith("\n") else text + "\n")
    old = document.get(key)
    if type(old) is Table:
        trivia = _pop_trailing(old)
        for name in [name for name in old if name not in entry or isinstance(old[name], dict)]:
            old.remove(name)
        _extend(_filled(old, entry), trivia)
    else:  # not there, in one line, or in several places
        if old is not None:
            document.remove(key)
        document[key] = _filled(tomlkit.table(), entry)
    return _checked(document, {**before, key: entry})


def _filled(table: Table, entry: Plain) -> Table:
    """The table with these keys: plain values first, because what follows a sub-table's header belongs to that."""
    for key, value in sorted(entry.items(), key=lambda item: isinstance(item[1], dict)):
        if isinstance(value, dict):
            table[key] = _filled(tomlkit.table(), value)
        elif isinstance(value, list) and value and isinstance(value[0], list):
            matrix = tomlkit.array()
            matrix.extend(value)
            table[key] = matrix.multiline(True)  # a row per line
        else:
            table[key] = value
    return table


def _last_table(table: Table) -> Table:
    """The table that the text just before the next header belongs to."""
    last = table.value.body[-1][1] if table.value.body else None
    return _last_table(last) if type(last) is Table else table


def _pop_trailing(table: Table) -> list[Item]:
    """Remove and return trailing blank lines and comments: they belong to the table that follows, not to this one."""
    body = _last_table(table).value.body
    trivia: list[Item] = []
    while body and body[-1][0] is None and isinstance(body[-1][1], Comment | Whitespace):
        trivia.insert(0, body.pop()[1])
    return trivia


def _extend(table: Table, trivia: list[Item]) -> None:
    _last_table(table).value.body.extend((None, item) for item in trivia)


def _checked(document: tomlkit.TOMLDocument, wanted: Plain) -> str:
    """The text, after a second parser has read exactly the intended tables from it: a user's file is never damaged."""
    text = tomlkit.dumps(document)
    if tomllib.loads(text) != wanted:
        message = "write its tables as [table] and [[table]], each in one place"
        raise JobError(f"the TOML file's layout is too unusual to be extended: {message}")
    return text
