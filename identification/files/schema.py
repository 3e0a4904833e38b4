"""The tables of an arm file, of the plane or of space, and one line for what cannot be.

Keys that only one kind of arm has are marked; points have a number for each of its axes. What pydantic says of a value
is the end of a message, or the sentence of a check of ours.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal, NoReturn, TypeVar, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    create_model,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from identification.arm import (
    LARGEST_ACCELERATION,
    LARGEST_ANGLE,
    LARGEST_LENGTH,
    LARGEST_MASS,
    LENGTH_RANGE,
    MAX_LINKS,
    SIGMA_RANGE,
)
from identification.arrays import Array
from identification.bodies import CLEARANCE
from identification.errors import InputError, nearest
from identification.instruments import KINDS, kinds

DIMENSIONS = {"planar": 2, "spatial": 3}
ROUNDED = 1e-5  # of a correlation, where a covariance is written with six digits
OTHER_KEYS = {  # what people write for keys of an arm file
    "lengths_mm": "links_mm",
    "link_lengths_mm": "links_mm",
    "min": "lower",
    "max": "upper",
    "g": "acceleration_m_s2",
    "theta_deg": "offset_deg",
    "theta": "offset_deg",
}
CONSTRAINTS = {  # kind -> keys in the plane and in space, those with ? may be left out
    "workspace_box": {2: "x_mm y_mm", 3: "x_mm y_mm z_mm"},
    "keep_out_circle": {2: "center_mm radius_mm"},
    "keep_out_sphere": {3: "center_mm radius_mm"},
    "keep_out_cylinder": {3: "start_mm end_mm radius_mm"},
    "line_of_sight": {
        2: "tracker_mm half_angle_deg toward_mm",
        3: "tracker_mm half_angle_deg toward_mm range_mm? facing? acceptance_deg?",
    },
}

POSE = {2: "x_mm? y_mm? rz_deg?", 3: "x_mm? y_mm? z_mm? rx_deg? ry_deg? rz_deg?"}
BODIES = {  # kind -> keys in the plane and in space, besides name and joint
    "box": {dimension: f"size_mm {keys}" for dimension, keys in POSE.items()},
    "sphere": dict.fromkeys((2, 3), "center_mm radius_mm"),
    "capsule": dict.fromkeys((2, 3), "start_mm end_mm radius_mm"),
    "cylinder": {3: "start_mm end_mm radius_mm"},
    "mesh": {3: f"file unit? {POSE[3]}"},
}


# -- types of values ---------------------------------------------------------------------------------------------------
def _checked(allowed: str, good: Callable[[Any, int], bool]) -> AfterValidator:
    """Refuses values that are not good for an arm of so many axes, `AXES` in words."""

    def check(value: Any, info: ValidationInfo) -> Any:
        if not good(value, dimension := _dimension(info)):
            raise PydanticCustomError("checked", "{allowed}", {"allowed": allowed.replace("AXES", NUMBERS[dimension])})
        return value

    return AfterValidator(check)


def _dimension(info: ValidationInfo) -> int:
    """Of the arm."""
    return int((info.context or {}).get("dimension", 2))


def _refuse(key: str, sentence: str) -> NoReturn:
    """A key of the table that is being read, and what is wrong with it."""
    raise PydanticCustomError("key", "{sentence}", {"key": key, "sentence": sentence})


def _only(dimension: int, kind: Any, *, needed: bool = False) -> Any:
    """The type of a key that only arms of a dimension have, or need, and what it is where it is left out."""
    return Annotated[kind | None, Field(json_schema_extra={"of": dimension, "needed": needed})], None


F = TypeVar("F", bound=BaseModel)
Tables: Any = list
Named: Any = dict
ARMS = {2: "a planar arm", 3: "a spatial arm"}
NUMBERS = {2: "two numbers", 3: "three numbers"}
Coordinate = Annotated[float, Field(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH)]
Angle = Annotated[float, Field(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE)]
Length = Annotated[float, Field(ge=LENGTH_RANGE[0], le=LENGTH_RANGE[1])]
Mass = Annotated[float, Field(ge=0, le=LARGEST_MASS)]
Acceleration = Annotated[float, Field(ge=-LARGEST_ACCELERATION, le=LARGEST_ACCELERATION)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Sigma = Annotated[float, Field(ge=SIGMA_RANGE[0], le=SIGMA_RANGE[1])]
PerAxis = _checked("AXES", lambda values, dimension: len(values) == dimension)
Point = Annotated[list[float], PerAxis]
Triple = _checked(NUMBERS[3], lambda values, _: len(values) == 3)
Direction = Annotated[list[float], Triple, _checked("a direction, not zero", lambda values, _: any(values))]
Rising = _checked("two numbers, the lower one first", lambda values, _: len(values) == 2 and values[0] < values[1])
Range = Annotated[
    list[float], _checked("two numbers, not falling", lambda values, _: len(values) == 2 and values[0] <= values[1])
]


# -- tables ------------------------------------------------------------------------------------------------------------
class StrictTable(BaseModel):
    """A table without unknown keys, its numbers finite; validated with the context `dimension` of the arm."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _has_its_keys(cls, values: Any, info: ValidationInfo) -> Any:
        if not isinstance(values, dict):
            return values
        dimension = _dimension(info)
        fields = {
            key: field for key, field in cls.model_fields.items() if _mark(field).get("of", dimension) == dimension
        }
        for key in (key for key in values if key not in cls.model_fields):  # first: what is misspelt is missing, too
            tables = {name: (field.annotation, *get_args(field.annotation)) for name, field in fields.items()}
            below = [name for name, types in tables.items() for t in types if key in getattr(t, "model_fields", ())]
            if len(below) == 1:
                _refuse(key, f"found outside of a table, allowed: under [{below[0]}]")
            _refuse(key, f"unknown key, {nearest(key, fields, OTHER_KEYS)}")
        for key in (key for key in values if key not in fields):
            this, other = ARMS[dimension], ARMS[5 - dimension]
            _refuse(key, f"found in the file of {this}, allowed: in that of {other}")
        for key, field in fields.items():
            if key not in values and (field.is_required() or _mark(field).get("needed")):
                _refuse(key, missing(key))
        return values


def missing(key: str) -> str:
    """That a key is missing, and in which unit its value is, which stands at the end of its name."""
    unit = key.rpartition("_")[2]
    return f"is missing, allowed: a value for it{f' [{unit}]' if unit in ('mm', 'deg', 'kg') else ''}"


def _mark(field: FieldInfo) -> dict[str, Any]:
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def _table(name: str, needed: str = "", check: Callable[..., Any] | None = None, /, **keys: Any) -> Any:
    """A table of these keys, each with the type of its value, or with that and what it is where it is left out.

    needed : keys that may not be left out;  check : of the whole table
    """
    fields = {key: kind if isinstance(kind, tuple) else (kind | None, None) for key, kind in keys.items()}
    fields |= {key: (keys[key], ...) for key in needed.split()}
    validators: dict[str, Any] = {} if check is None else {"check": model_validator(mode="after")(check)}
    return create_model(name, __base__=StrictTable, __validators__=validators, **fields)  # type: ignore[call-overload]


def _has_keys_of_its_kind(table: Any, kinds_of: Mapping[str, Iterable[str]], dimension: int) -> None:
    """Refuses a kind that is none of these, and keys that it does not have, or lacks; ? behind what may be left out."""
    keys = {kind: set(words) for kind, words in kinds_of.items()}
    if table.kind not in keys:
        _refuse("kind", f"found {table.kind!r} for {ARMS[dimension]}, {nearest(table.kind, keys)}")
    for key in type(table).model_fields.keys() - {"kind"}:
        present, optional = getattr(table, key) is not None, f"{key}?"
        if present and not {key, optional} & keys[table.kind]:
            owners = sorted(kind for kind, words in keys.items() if {key, optional} & words)
            allowed = f"for {', '.join(owners)}" if owners else "left out"
            _refuse(key, f"found for kind {table.kind}, allowed: {allowed}")
        if not present and key in keys[table.kind]:
            _refuse(key, missing(key))


def _constraint(table: Any, info: ValidationInfo) -> Any:
    dimension = _dimension(info)
    keys = {kind: of[dimension].split() for kind, of in CONSTRAINTS.items() if dimension in of}
    _has_keys_of_its_kind(table, keys, dimension)
    for key, other in (("end_mm", "start_mm"), ("toward_mm", "tracker_mm")):
        if (value := getattr(table, key)) is not None and value == getattr(table, other):
            _refuse(key, f"found {value}, allowed: another point than {other}")
    if table.acceptance_deg is not None and table.facing is None:
        _refuse("acceptance_deg", "found without facing, allowed: with facing")
    return table


def _body(table: Any, info: ValidationInfo) -> Any:
    dimension = _dimension(info)
    keys = {kind: f"name? joint? {of[dimension]}".split() for kind, of in BODIES.items() if dimension in of}
    _has_keys_of_its_kind(table, keys, dimension)
    if table.kind == "cylinder" and table.end_mm == table.start_mm:
        _refuse("end_mm", f"found {table.end_mm}, allowed: another point than start_mm")
    return table


def _instrument(table: Any, info: ValidationInfo) -> Any:
    of_arm = kinds("xyz"[: _dimension(info)])
    keys = {kind: [f"{key}?" for key in each.keys] for kind, each in of_arm.items()}
    _has_keys_of_its_kind(table, keys, _dimension(info))
    if "normal?" in keys[table.kind] and (table.normal is None) != (table.center_mm is None):
        here, missing = ("center_mm", "normal") if table.normal is None else ("normal", "center_mm")
        _refuse(missing, f"is missing beside {here}, allowed: both or none")
    return table


def _covariance(table: Any) -> Any:
    """Symmetric and positive semidefinite, but for rounding."""
    if table.covariance is None:
        return table
    if (names := table.parameters) is None:
        _refuse("parameters", "is missing, allowed: the names of the rows of covariance")
    counts = {"rows": {len(table.covariance)}, "values in a row": {len(row) for row in table.covariance}}
    for what, count in ((what, count) for what, found in counts.items() for count in found - {len(names)}):
        _refuse("covariance", f"found {count} {what} for {len(names)} parameters, allowed: {len(names)}")
    matrix: Array = np.array(table.covariance).reshape(len(names), len(names))
    deviations = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    largest = np.outer(deviations, deviations)  # at a correlation of one
    wrong = (np.abs(matrix) > (1.0 + ROUNDED) * largest) | (np.abs(matrix - matrix.T) > ROUNDED * largest)
    if wrong.any():
        i, j = np.argwhere(wrong)[0].tolist()
        pair = f"{matrix[i, j]:g} and {matrix[j, i]:g} of {names[i]} and {names[j]}"
        _refuse("covariance", f"found {pair}, allowed: a symmetric matrix, correlations of -1 to 1")
    correlations = matrix / np.where(largest > 0.0, largest, 1.0)
    if matrix.size and (least := float(np.linalg.eigvalsh(correlations)[0])) < -ROUNDED * len(matrix):
        _refuse("covariance", f"found correlations with eigenvalue {least:.3g}, allowed: positive semidefinite")
    return table


def _together(file: Any) -> Any:
    """Keys that need or exclude each other."""
    if file.kind == "spatial" and (file.urdf is None) == (file.dh is None):
        state = "neither is there" if file.urdf is None else "both are there"
        _refuse("urdf, dh", f"{state}, allowed: a URDF file or [[dh]] tables")
    for key in ("base_link", "tip_link"):
        if (getattr(file, key) is None) != (file.urdf is None):
            _refuse(key, f"{'is missing' if file.urdf else 'found without urdf'}, allowed: with urdf, a link of it")
    for key in ("bodies_of_urdf", "srdf"):
        if file.urdf is None and getattr(file.cell, key, None) is not None:
            _refuse(f"cell.{key}", "found without urdf, allowed: with urdf")
    for place, table in (
        ("measurement.sigma_deg", "instrument"),
        ("instrument.center_mm", "base"),
        ("calibration.base", "base"),
        ("calibration.tools", "tool"),
    ):
        owner, _, key = place.partition(".")
        if getattr(getattr(file, owner), key, None) and getattr(file, table) is not None:
            _refuse(place, f"found beside [{table}], allowed: one of them")
    return file


def _by_marker(table: Any) -> Any:
    """Tables of markers by name; the table of an arm with a single marker under an empty name."""
    several = isinstance(table, dict) and table and all(isinstance(value, dict) for value in table.values())
    return table if several or not isinstance(table, dict) else {"": table}


class EffectTable(BaseModel):
    """`[[effects]]`: the keys besides these are the effect's own parameters."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, float]
    name: str
    joint: int | None = None
    from_deg: Angle | None = None
    to_deg: Angle | None = None
    values_deg: list[Angle] | None = None
    geometry: dict[str, float] | None = None


class ProvenanceTable(BaseModel):
    """`[calibration.provenance]`: anything, of which the program reads these numbers again."""

    model_config = ConfigDict(extra="allow", strict=True)
    rows: Annotated[int, Field(ge=1)] = 1
    joint_range_deg: list[Range] = []
    joint_range_mm: list[Range] = []


# a pose, its rotation about its own x, then y, then z axis; of a tool a measured point in the frame of the tip, whose
# rotation counts only where orientations are measured
PoseTable = _table(
    "PoseTable", **{f"{axis}_mm": (Coordinate, 0.0) for axis in "xyz"} | {f"r{x}_deg": (Angle, 0.0) for x in "xyz"}
)
LimitsTable = _table("LimitsTable", "lower upper", lower=list[Angle], upper=list[Angle])
JointsTable = _table("JointsTable", sign=list[int], coupled_to=list[int], zero_deg=list[Angle])
MachiningTable = _table("MachiningTable", translation_mm=Length, rotation_deg=Annotated[Angle, Field(gt=0)])
MeasurementTable = _table("MeasurementTable", sigma_mm=Sigma, sigma_deg=_only(3, Positive))
RowTable = _table(
    "RowTable",
    "a_mm alpha_deg d_mm",
    a_mm=Coordinate,
    alpha_deg=Angle,
    d_mm=Coordinate,
    offset_deg=(Angle, 0.0),
    convention=Literal["standard", "modified"],
    joint=(Literal["revolute", "prismatic"], "revolute"),
)
GravityTable = _table(
    "GravityTable",
    "acceleration_m_s2 link_masses_kg",
    acceleration_m_s2=Annotated[list[Acceleration], PerAxis],
    link_masses_kg=list[Mass],
    center_of_mass=list[Annotated[float, Field(ge=0, le=1)]],
    payload_kg=(Mass, 0.0),
    payload_at_mm=_only(3, Annotated[list[Coordinate], Triple]),
)
ConstraintTable = _table(
    "ConstraintTable",
    "kind",
    _constraint,
    kind=Annotated[str, Field(json_schema_extra={"enum": [*CONSTRAINTS]})],
    **dict.fromkeys(("x_mm", "y_mm", "z_mm"), Annotated[list[float], Rising]),
    **dict.fromkeys(("center_mm", "start_mm", "end_mm", "tracker_mm", "toward_mm"), Point),
    **dict.fromkeys(("half_angle_deg", "acceptance_deg"), Annotated[float, Field(gt=0, le=180)]),
    radius_mm=Positive,
    range_mm=Annotated[list[NotNegative], Rising],
    facing=Direction,
)
BodyTable = _table(
    "BodyTable",
    "kind",
    _body,
    kind=Annotated[str, Field(json_schema_extra={"enum": [*BODIES]})],
    name=Annotated[str, Field(min_length=1)],
    joint=Annotated[int, Field(ge=1, le=MAX_LINKS)],
    size_mm=Annotated[list[Length], PerAxis],
    **dict.fromkeys(("center_mm", "start_mm", "end_mm"), Annotated[list[Coordinate], PerAxis]),
    radius_mm=Length,
    file=str,
    unit=Literal["mm", "m"],
    **{f"{axis}_mm": Coordinate for axis in "xyz"},
    **{f"r{axis}_deg": Angle for axis in "xyz"},
)
CellTable = _table(
    "CellTable",
    floor_z_mm=_only(3, Coordinate),
    clearance_mm=(Annotated[float, Field(ge=0, le=LARGEST_LENGTH)], CLEARANCE),
    bodies_of_urdf=_only(3, bool),
    srdf=_only(3, str),
    apart=(list[Annotated[tuple[str, str], Field(strict=False)]], []),
    bodies=(Tables[BodyTable], []),
)
InstrumentTable = _table(
    "InstrumentTable",
    "kind",
    _instrument,
    kind=Annotated[str, Field(json_schema_extra={"enum": [*KINDS]})],
    radius_mm=Positive,
    center_mm=Point,
    normal=Direction,
    cups=dict[str, Point],
    distances_mm=list[Annotated[tuple[str, str, Length], Field(strict=False)]],
)
CalibrationTable = _table(
    "CalibrationTable",
    "",
    _covariance,
    length_errors_mm=_only(2, list[float], needed=True),
    joint_offsets_deg=_only(2, list[float], needed=True),
    values=_only(3, dict[str, float], needed=True),
    base=_only(3, PoseTable),
    tools=_only(3, Named[str, PoseTable]),
    effects=(dict[str, float], {}),
    parameters=list[str],
    covariance=list[list[float]],
    provenance=(ProvenanceTable, ProvenanceTable()),
)
ArmFile = _table(
    "ArmFile",
    "",
    _together,
    kind=(Literal["planar", "spatial"], "planar"),
    name=(str, "arm"),
    links_mm=_only(2, Annotated[list[Length], Field(min_length=1, max_length=MAX_LINKS)], needed=True),
    urdf=_only(3, str),
    base_link=_only(3, str),
    tip_link=_only(3, str),
    dh=_only(3, Annotated[Tables[RowTable], Field(min_length=1, max_length=MAX_LINKS)]),
    link_width_mm=_only(2, Length),
    joint_limits_deg=LimitsTable,
    joint_limits_mm=_only(3, LimitsTable),
    joints=JointsTable,
    base=_only(3, PoseTable),
    tool=_only(3, Annotated[Named[str, PoseTable], BeforeValidator(_by_marker)]),
    machining=_only(3, MachiningTable),
    measurement=MeasurementTable,
    instrument=InstrumentTable,
    gravity=GravityTable,
    gear_ratio=list[NotNegative],
    constraints=(Tables[ConstraintTable], []),
    cell=CellTable,
    effects=(list[EffectTable], []),
    calibration=CalibrationTable,
)


def require_count(key: str, values: list[Any], count: int, whose: str = "joints") -> None:
    """Raises `InputError` unless there is one value for each joint."""
    if len(values) != count:
        raise InputError(f"{key}: found {len(values)} values for {count} {whose}, allowed: {count}")


# -- validation --------------------------------------------------------------------------------------------------------
def validated_arm(tables: Mapping[str, Any], place: str = "") -> Any:
    """The tables of an arm file. Raises `InputError` naming key, what was found and what is allowed.

    place : before the key in messages
    """
    kind = tables.get("kind", "planar")
    if not isinstance(kind, str) or kind not in DIMENSIONS:
        raise InputError(f"{place}kind: found {kind!r}, allowed: {' or '.join(DIMENSIONS)}")
    return validated(ArmFile, tables, place, DIMENSIONS[kind])


def validated(file: type[F], tables: Mapping[str, Any], place: str = "", dimension: int = 2) -> F:
    """The tables of any file; raises `InputError` as `validated_arm` does.

    dimension : of the arm, for keys and points that depend on it
    """
    try:
        return file.model_validate(tables, context={"dimension": dimension})
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
    kind, loc, value = detail["type"], list(detail["loc"]), detail["input"]
    if kind == "key":
        loc.append(detail["ctx"]["key"])
    # entries are counted from 1: `constraints[2].x_mm`
    key = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in loc if part != "")[1:]
    if kind == "key":
        raise InputError(f"{place}{key}: {detail['msg']}")
    if kind == "missing":
        raise InputError(f"{place}{key}: {missing(key)}")
    if kind in ("too_long", "too_short"):
        found = f"{len(value)} values"
    else:
        found = "a table" if isinstance(value, dict) else str(value).lower() if isinstance(value, bool) else repr(value)
    allowed = detail["msg"]
    for words, ours in (
        (r"^\w+ should (be|have) ", ""),
        (r"valid dictionary.*", "table"),
        (r"valid integer", "whole number"),
        (r"greater than or equal to", ">="),
        (r"less than or equal to", "<="),
        (r"greater than", ">"),
        (r"valid ", ""),
        (r" after validation.*", ""),
    ):
        allowed = re.sub(words, ours, allowed)
    raise InputError(f"{place}{key}: found {found if len(found) <= 80 else f'{found[:77]}...'}, allowed: {allowed}")


def json_schema(kind: str) -> dict[str, Any]:
    """The JSON schema of arm files of a kind, for editors."""
    whole = ArmFile.model_json_schema()
    for table in (whole, *whole["$defs"].values()):
        for key, field in list(table["properties"].items()):
            if field.pop("of", DIMENSIONS[kind]) != DIMENSIONS[kind]:
                del table["properties"][key]
            elif field.pop("needed", False):
                table.setdefault("required", []).append(key)
    return dict(json.loads(json.dumps(whole)))
