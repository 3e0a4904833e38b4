"""The tables of an arm file, of the plane or of space, and one line for what cannot be.

A key is declared once: its name ends with its unit, its type says what is allowed there, and an angle is turned from
degrees into radians where it is read. Keys that only one kind of arm has are marked; points have a number for each of
its axes; a magnitude is at most `LARGEST`. What pydantic says of a value is the end of a message, or the sentence of a
check of ours.
"""

import math
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NoReturn, Self, TypeVar, get_args

import numpy as np
import pydantic
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, ValidationInfo
from pydantic_core import PydanticCustomError

from identification.arm import LARGEST, LARGEST_ANGLE, LENGTH_RANGE, MAX_LINKS, SIGMA_RANGE
from identification.errors import InputError, close_names, nearest, require, suggestion
from identification.instruments import KINDS
from identification.workspace import CLEARANCE

AXES = {"planar": "xy", "spatial": "xyz"}  # kind of an arm -> of its points
CURVE = "joint_error_curve"
# kind -> keys of a planar and of a spatial arm, those with ? may be left out
POSE = {"planar": "x_mm? y_mm? rz_deg?", "spatial": "x_mm? y_mm? z_mm? rx_deg? ry_deg? rz_deg?"}
KEYS_OF_KIND = {
    "constraints": {
        "workspace_box": {"planar": "x_mm y_mm", "spatial": "x_mm y_mm z_mm"},
        "keep_out_circle": {"planar": "center_mm radius_mm"},
        "keep_out_sphere": {"spatial": "center_mm radius_mm"},
        "keep_out_cylinder": {"spatial": "start_mm end_mm radius_mm"},
        "line_of_sight": {
            "planar": "tracker_mm half_angle_deg toward_mm",
            "spatial": "tracker_mm half_angle_deg toward_mm range_mm? facing? acceptance_deg?",
        },
    },
    "bodies": {
        "box": {kind: f"name? joint? size_mm {keys}" for kind, keys in POSE.items()},
        "sphere": dict.fromkeys(AXES, "name? joint? center_mm radius_mm"),
        "capsule": dict.fromkeys(AXES, "name? joint? start_mm end_mm radius_mm"),
        "cylinder": {"spatial": "name? joint? start_mm end_mm radius_mm"},
        "mesh": {"spatial": f"name? joint? file unit? {POSE['spatial']}"},
    },
    "instrument": {
        word: {
            kind: " ".join(f"{key}?" for key in KINDS[axes][word].keys)
            for kind, axes in AXES.items()
            if word in KINDS[axes]
        }
        for word in KINDS["xyz"]
    },
}


# -- types of values ---------------------------------------------------------------------------------------------------
def _checked(allowed: str, good: Callable[[Any], bool]) -> AfterValidator:
    """Refuses values that are not good."""

    def check(value: Any) -> Any:
        if not good(value):
            raise PydanticCustomError("checked", "{allowed}", {"allowed": allowed})
        return value

    return AfterValidator(check)


def _per_axis(values: Any, info: ValidationInfo) -> Any:
    if len(values) != len(AXES[_kind(info)]):
        allowed = {"planar": "two numbers", "spatial": "three numbers"}[_kind(info)]
        raise PydanticCustomError("checked", "{allowed}", {"allowed": allowed})
    return values


def _kind(info: ValidationInfo) -> str:
    """Of the arm."""
    return str((info.context or {}).get("kind", "planar"))


def _refuse(key: str, sentence: str) -> NoReturn:
    """A key of the table that is being read, and what is wrong with it."""
    raise PydanticCustomError("key", "{sentence}", {"key": key, "sentence": sentence})


def _only(kind: str, value: Any, *, needed: bool = False) -> Any:
    """The type of a key that only arms of a kind have, or need, and what it is where it is left out."""
    return Annotated[value | None, Field(json_schema_extra={"of": kind, "needed": needed})], None


F = TypeVar("F", bound=BaseModel)
Tables: Any = list
Named: Any = dict
Radians = AfterValidator(math.radians)
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Angle = Annotated[float, Field(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE), Radians]
Opening = Annotated[float, Field(gt=0, le=180), Radians]
Length = Annotated[float, Field(ge=LENGTH_RANGE[0], le=LENGTH_RANGE[1])]
Sigma = Annotated[float, Field(ge=SIGMA_RANGE[0], le=SIGMA_RANGE[1])]
Lengths = Annotated[list[Length], AfterValidator(_per_axis)]
Point = Annotated[list[Number], AfterValidator(_per_axis)]
Direction = Annotated[Point, _checked("a direction, not zero", any)]
Rising = Annotated[
    list[Number],
    _checked("two numbers, the lower one first", lambda pair: len(pair) == len({*pair}) == 2 and pair == sorted(pair)),
]
Range = Annotated[list[float], _checked("two numbers, not falling", lambda pair: len(pair) == 2 and pair[0] <= pair[1])]


# -- tables ------------------------------------------------------------------------------------------------------------
class StrictTable(BaseModel):
    """A table without unknown keys, its numbers finite; validated with the context `kind` of the arm."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    @pydantic.model_validator(mode="before")
    @classmethod
    def _has_its_keys(cls, values: Any, info: ValidationInfo) -> Any:
        if not isinstance(values, dict):
            return values
        kind = _kind(info)
        marks: dict[str, Any] = {key: field.json_schema_extra or {} for key, field in cls.model_fields.items()}
        fields = {key: field for key, field in cls.model_fields.items() if marks[key].get("of", kind) == kind}
        for key in (key for key in values if key not in marks):  # first: what is misspelt is missing, too
            tables = {name: (field.annotation, *get_args(field.annotation)) for name, field in fields.items()}
            below = [name for name, types in tables.items() for t in types if key in getattr(t, "model_fields", ())]
            if len(below) == 1:
                hint = suggestion(close_names(key, fields))
                _refuse(key, f"found outside of a table, {hint}allowed: under [{below[0]}]")
            _refuse(key, f"unknown key, {nearest(key, fields)}")
        for key in (key for key in values if key not in fields):
            _refuse(key, f"found in the file of a {kind} arm, allowed: in that of a {marks[key]['of']} arm")
        for key, field in fields.items():
            if key not in values and (field.is_required() or marks[key].get("needed")):
                _refuse(key, missing(key))
        return values


def missing(key: str) -> str:
    """That a key is missing, and in which unit its value is, which stands at the end of its name."""
    unit = key.rpartition("_")[2]
    return f"is missing, allowed: a value for it{f' [{unit}]' if unit in ('mm', 'deg', 'kg') else ''}"


def _table(name: str, needed: str = "", check: Callable[..., Any] | None = None, /, **keys: Any) -> Any:
    """A table of these keys, each with the type of its value, or with that and what it is where it is left out;
    needed : keys that may not be left out;  check : of the whole table"""
    fields = {key: kind if isinstance(kind, tuple) else (kind | None, None) for key, kind in keys.items()}
    fields |= {key: (keys[key], ...) for key in needed.split()}
    validators: dict[str, Any] = {} if check is None else {"check": pydantic.model_validator(mode="after")(check)}
    return pydantic.create_model(name, __base__=StrictTable, __validators__=validators, **fields)  # type: ignore[call-overload]


def _table_of_kinds(title: str, place: str, /, **keys: Any) -> Any:
    """A table whose key `kind` says which of these keys it has and needs;  place : in `KEYS_OF_KIND`"""

    def check(table: Any, info: ValidationInfo) -> Any:
        arm = _kind(info)
        words = {word: of[arm].split() for word, of in KEYS_OF_KIND[place].items() if arm in of}
        if table.kind not in words:
            _refuse("kind", f"found {table.kind!r} for a {arm} arm, {nearest(table.kind, words)}")
        present = {key for key, value in table if value is not None and key != "kind"}
        allowed = {key.rstrip("?") for key in words[table.kind]}
        for key in (key for key in keys if key in present - allowed):
            owners = sorted(word for word, of in words.items() if {key, f"{key}?"} & {*of})
            elsewhere = f"for {', '.join(owners)}" if owners else f"left out for a {arm} arm"
            _refuse(key, f"found for kind {table.kind}, allowed: {elsewhere}")
        for key in (key for key in words[table.kind] if key[-1] != "?" and key not in present):
            _refuse(key, missing(key))
        for key, other in (("end_mm", "start_mm"), ("toward_mm", "tracker_mm")):
            if {key, other} <= present and table.kind != "capsule" and getattr(table, key) == getattr(table, other):
                _refuse(key, f"found {getattr(table, key)}, allowed: another point than {other}")
        for key, other in (("normal", "center_mm"), ("center_mm", "normal")):
            if "normal" in allowed and key not in present and other in present:
                _refuse(key, f"is missing beside {other}, allowed: both or none")
        if "acceptance_deg" in present and "facing" not in present:
            _refuse("acceptance_deg", "found without facing, allowed: with facing")
        return table

    kind = Annotated[str, Field(json_schema_extra={"enum": [*KEYS_OF_KIND[place]]})]
    return _table(title, "kind", check, kind=kind, **keys)


def _covariance(table: Any) -> Any:
    """A row and a column for each parameter, symmetric and without negative eigenvalues."""
    if table.covariance is None:
        return table
    if (names := table.parameters) is None:
        _refuse("parameters", "is missing, allowed: the names of the rows of covariance")
    for count, what in ((len(table.covariance), "rows"), *((len(row), "values in a row") for row in table.covariance)):
        if count != len(names):
            _refuse("covariance", f"found {count} {what} for {len(names)} parameters, allowed: {len(names)}")
    covariance = np.array(table.covariance).reshape(len(names), len(names))
    # to six digits of each variance, whatever its unit, and to twelve of the largest, by which all may be rounded
    scales, rounded = np.sqrt(np.abs(np.diagonal(covariance))), 1e-12 * np.abs(covariance).max(initial=0.0)
    unit = covariance / np.outer(*[np.where(scales > 0.0, scales, 1.0)] * 2)
    asymmetric = (np.abs(unit - unit.T) > 1e-6) & (np.abs(covariance - covariance.T) > rounded)
    for row, column in np.argwhere(asymmetric)[:1]:
        pair = f"{covariance[row, column]:g} in row {row + 1}, column {column + 1}, {covariance[column, row]:g} across"
        _refuse("covariance", f"found {pair}, allowed: a symmetric matrix")
    lowest, in_units = (np.linalg.eigvalsh(each).min(initial=0.0) for each in (unit, covariance))
    if lowest < -1e-6 and in_units < -rounded:
        state = f"found an eigenvalue of {lowest:.2g} with variances scaled to 1"
        _refuse("covariance", f"{state}, allowed: a covariance, which has none below 0")
    return table


def _together(file: Any) -> Any:
    """Keys that need or exclude each other."""
    if file.kind == "spatial" and (file.urdf is None) == (file.dh is None):
        state = "neither is there" if file.urdf is None else "both are there"
        _refuse("urdf, dh", f"{state}, allowed: a URDF file or [[dh]] tables")
    if len(conventions := dict.fromkeys(row.convention for row in file.dh or () if row.convention)) > 1:
        _refuse("dh", f"found conventions {' and '.join(conventions)}, allowed: one for all rows")
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
    __pydantic_extra__: dict[str, float]  # type: ignore[bad-override]
    name: str
    joint: int | None = None
    from_deg: Angle | None = None
    to_deg: Angle | None = None
    values_deg: list[Angle] | None = None
    geometry: dict[str, float] | None = None

    @pydantic.model_validator(mode="after")
    def _keys_of_a_curve(self) -> Self:
        """All of them for an error curve, and for nothing else."""
        for key in ("from_deg", "to_deg", "values_deg", "geometry"):
            if self.name != CURVE and getattr(self, key) is not None:
                _refuse(key, f"unknown key of {self.name}, allowed: for {CURVE} only")
            if self.name == CURVE and getattr(self, key) is None and key != "geometry":
                _refuse(key, "is missing, allowed: as `armcal diagnose --out` writes it")
        return self


class ProvenanceTable(BaseModel):
    """`[calibration.provenance]`: anything, of which the program reads these numbers again."""

    model_config = ConfigDict(extra="allow", strict=True)
    rows: Annotated[int, Field(ge=1)] = 1
    rms_after_mm: NotNegative = 0.0
    expected_tip_mm: NotNegative = 0.0
    joint_range_deg: list[Range] = []
    joint_range_mm: list[Range] = []


# a pose, its rotation about its own x, then y, then z axis; of a tool a measured point in the frame of the tip, whose
# rotation counts only where orientations are measured
PoseTable = _table(
    "PoseTable", **{f"{axis}_mm": (Number, 0.0) for axis in "xyz"} | {f"r{x}_deg": (Angle, 0.0) for x in "xyz"}
)
AngleLimits = _table("AngleLimits", "lower upper", lower=list[Angle], upper=list[Angle])
SlideLimits = _table("SlideLimits", "lower upper", lower=list[Number], upper=list[Number])
JointsTable = _table("JointsTable", sign=list[int], coupled_to=list[int], zero_deg=list[Angle])
MachiningTable = _table("MachiningTable", translation_mm=Length, rotation_deg=Annotated[Angle, Field(gt=0)])
MeasurementTable = _table("MeasurementTable", sigma_mm=Sigma, sigma_deg=_only("spatial", Annotated[Positive, Radians]))
RowTable = _table(
    "RowTable",
    "a_mm alpha_deg d_mm",
    a_mm=Number,
    alpha_deg=Angle,
    d_mm=Number,
    offset_deg=(Angle, 0.0),
    convention=Literal["standard", "modified"],
    joint=(Literal["revolute", "prismatic"], "revolute"),
)
GravityTable = _table(
    "GravityTable",
    "acceleration_m_s2 link_masses_kg",
    acceleration_m_s2=Point,
    link_masses_kg=list[NotNegative],
    center_of_mass=list[Annotated[float, Field(ge=0, le=1)]],
    center_of_mass_mm=_only("spatial", list[Point]),
    payload_kg=(NotNegative, 0.0),
    payload_at_mm=_only("spatial", Point),
)
ConstraintTable = _table_of_kinds(
    "ConstraintTable",
    "constraints",
    **dict.fromkeys(("x_mm", "y_mm", "z_mm"), Rising),
    **dict.fromkeys(("center_mm", "start_mm", "end_mm", "tracker_mm", "toward_mm"), Point),
    **dict.fromkeys(("half_angle_deg", "acceptance_deg"), Opening),
    radius_mm=Positive,
    range_mm=Annotated[Rising, _checked("two numbers >= 0, the lower one first", lambda pair: pair[0] >= 0.0)],
    facing=Direction,
)
BodyTable = _table_of_kinds(
    "BodyTable",
    "bodies",
    name=Annotated[str, Field(min_length=1)],
    joint=Annotated[int, Field(ge=1, le=MAX_LINKS)],
    size_mm=Lengths,
    **dict.fromkeys(("center_mm", "start_mm", "end_mm"), Point),
    radius_mm=Length,
    file=str,
    unit=Literal["mm", "m"],
    **{f"{axis}_mm": Number for axis in "xyz"},
    **{f"r{axis}_deg": Angle for axis in "xyz"},
)
CellTable = _table(
    "CellTable",
    floor_z_mm=_only("spatial", Number),
    clearance_mm=(NotNegative, CLEARANCE),
    bodies_of_urdf=_only("spatial", bool),
    srdf=_only("spatial", str),
    apart=(list[Annotated[tuple[str, str], Field(strict=False)]], []),
    bodies=(Tables[BodyTable], []),
)
InstrumentTable = _table_of_kinds(
    "InstrumentTable",
    "instrument",
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
    length_errors_mm=_only("planar", list[float], needed=True),
    joint_offsets_deg=_only("planar", list[float], needed=True),
    values=_only("spatial", dict[str, float], needed=True),
    base=_only("spatial", PoseTable),
    tools=_only("spatial", Named[str, PoseTable]),
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
    links_mm=_only("planar", Annotated[list[Length], Field(min_length=1, max_length=MAX_LINKS)], needed=True),
    urdf=_only("spatial", str),
    base_link=_only("spatial", str),
    tip_link=_only("spatial", str),
    dh=_only("spatial", Annotated[Tables[RowTable], Field(min_length=1, max_length=MAX_LINKS)]),
    link_width_mm=_only("planar", Length),
    joint_limits_deg=AngleLimits,
    joint_limits_mm=_only("spatial", SlideLimits),
    joints=JointsTable,
    base=_only("spatial", PoseTable),
    tool=_only("spatial", Annotated[Named[str, PoseTable], BeforeValidator(_by_marker)]),
    machining=_only("spatial", MachiningTable),
    measurement=(MeasurementTable, MeasurementTable()),
    instrument=InstrumentTable,
    gravity=GravityTable,
    gear_ratio=list[NotNegative],
    constraints=(Tables[ConstraintTable], []),
    cell=(CellTable, CellTable()),
    effects=(list[EffectTable], []),
    calibration=CalibrationTable,
)


# -- validation --------------------------------------------------------------------------------------------------------
def validated_arm(tables: Mapping[str, Any], place: str = "") -> Any:
    """The tables of an arm file. Raises `InputError` naming key, what was found and what is allowed;  place : before
    the key in messages"""
    kind = tables.get("kind", "planar")
    require(isinstance(kind, str) and kind in AXES, f"{place}kind: found {kind!r}, allowed: {' or '.join(AXES)}")
    return validated(ArmFile, tables, place, kind)


def validated(file: type[F], tables: Mapping[str, Any], place: str = "", kind: str = "planar") -> F:
    """The tables of any file; raises `InputError` as `validated_arm` does;  kind : of the arm, for keys and points that
    depend on it"""
    try:
        return file.model_validate(tables, context={"kind": kind})
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
    wrong, loc, value, allowed = detail["type"], list(detail["loc"]), detail["input"], detail["msg"]
    if wrong == "key":
        loc.append(detail["ctx"]["key"])
    # entries are counted from 1: `constraints[2].x_mm`
    key = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in loc if part != "")[1:]
    if wrong in ("key", "missing"):
        raise InputError(f"{place}{key}: {allowed if wrong == 'key' else missing(key)}")
    found = "a table" if isinstance(value, dict) else str(value).lower() if isinstance(value, bool) else repr(value)
    if wrong in ("too_long", "too_short"):
        found = f"{len(value)} values"
    for words, ours in (
        (r"^\w+ should (be|have) ", ""),
        (r"valid dictionary.*", "table"),
        (r"valid integer", "whole number"),
        (r"greater than or equal to", ">="),
        (r"less than or equal to", "<="),
        (r"greater than", ">"),
        (r"valid | after validation.*", ""),
    ):
        allowed = re.sub(words, ours, allowed)
    raise InputError(f"{place}{key}: found {found if len(found) <= 80 else f'{found[:77]}...'}, allowed: {allowed}")
