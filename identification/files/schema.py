"""The tables of an arm file, of the plane or of space, and one line for what cannot be.

Keys that only one kind of arm has are marked; points have a number for each of its axes. What pydantic says of a value
is the end of a message, or the sentence of a check of ours.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NoReturn, Self, TypeVar, get_args

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
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


T = TypeVar("T")
F = TypeVar("F", bound=BaseModel)
InSpace = Annotated[T | None, Field(json_schema_extra={"of": 3})]
NeededInPlane = Annotated[T | None, Field(json_schema_extra={"of": 2, "needed": True})]
NeededInSpace = Annotated[T | None, Field(json_schema_extra={"of": 3, "needed": True})]
ARMS = {2: "a planar arm", 3: "a spatial arm"}
NUMBERS = {2: "two numbers", 3: "three numbers"}
Coordinate = Annotated[float, Field(ge=-LARGEST_LENGTH, le=LARGEST_LENGTH)]
Angle = Annotated[float, Field(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE)]
Length = Annotated[float, Field(ge=LENGTH_RANGE[0], le=LENGTH_RANGE[1])]
Mass = Annotated[float, Field(ge=0, le=LARGEST_MASS)]
Acceleration = Annotated[float, Field(ge=-LARGEST_ACCELERATION, le=LARGEST_ACCELERATION)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
HalfTurn = Annotated[float, Field(gt=0, le=180)]
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
        fields = {key: field for key, field in cls.model_fields.items() if _of(field, _dimension(info))}
        for key in (key for key in values if key not in cls.model_fields):  # first: what is misspelt is missing, too
            tables = {name: (field.annotation, *get_args(field.annotation)) for name, field in fields.items()}
            below = [name for name, types in tables.items() for t in types if key in getattr(t, "model_fields", ())]
            if len(below) == 1:
                _refuse(key, f"found outside of a table, allowed: under [{below[0]}]")
            _refuse(key, f"unknown key, {nearest(key, fields, OTHER_KEYS)}")
        for key in (key for key in values if key not in fields):
            _refuse(
                key, f"found in the file of {ARMS[_dimension(info)]}, allowed: in that of {ARMS[5 - _dimension(info)]}"
            )
        for key, field in fields.items():
            if key not in values and (field.is_required() or _mark(field).get("needed")):
                _refuse(key, "is missing, allowed: a value for it")
        return values


def _mark(field: FieldInfo) -> dict[str, Any]:
    return field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}


def _of(field: FieldInfo, dimension: int) -> bool:
    """Whether a key is one of arms of a dimension."""
    return bool(_mark(field).get("of", dimension) == dimension)


class LimitsTable(StrictTable):
    """`[joint_limits_deg]` of the turning joints, `[joint_limits_mm]` of the prismatic ones."""

    lower: list[Angle]
    upper: list[Angle]


class JointsTable(StrictTable):
    """`[joints]`: how the controller counts them (identification/kinematics/counting.py)."""

    sign: list[int] | None = None
    coupled_to: list[int] | None = None
    zero_deg: list[Angle] | None = None


class DHTable(StrictTable):
    """`[[dh]]`: one joint."""

    a_mm: Coordinate
    alpha_deg: Angle
    d_mm: Coordinate
    offset_deg: Angle = 0.0
    convention: Literal["standard", "modified"] | None = None
    joint: Literal["revolute", "prismatic"] = "revolute"


class PoseTable(StrictTable):
    """`[base]`, `[tool]` or `[tool.MARKER]`: a pose, its rotation about its own x, then y, then z.

    A tool is a measured point in the frame of the tip; only where orientations are measured its rotation counts.
    """

    x_mm: Coordinate = 0.0
    y_mm: Coordinate = 0.0
    z_mm: Coordinate = 0.0
    rx_deg: Angle = 0.0
    ry_deg: Angle = 0.0
    rz_deg: Angle = 0.0


class MachiningTable(StrictTable):
    """`[machining]`."""

    translation_mm: Length | None = None
    rotation_deg: Annotated[float, Field(gt=0, le=LARGEST_ANGLE)] | None = None


class MeasurementTable(StrictTable):
    """`[measurement]`."""

    sigma_mm: Annotated[float, Field(ge=SIGMA_RANGE[0], le=SIGMA_RANGE[1])] | None = None
    sigma_deg: InSpace[Positive] = None


class GravityTable(StrictTable):
    """`[gravity]`."""

    acceleration_m_s2: Annotated[list[Acceleration], PerAxis]
    link_masses_kg: list[Mass]
    center_of_mass: list[Annotated[float, Field(ge=0, le=1)]] | None = None
    payload_kg: Mass = 0.0
    payload_at_mm: InSpace[Annotated[list[Coordinate], Triple]] = None


class TableOfKind(StrictTable):
    """A table whose kind decides which other keys it has."""

    kind: str

    @classmethod
    def kinds(cls, dimension: int) -> dict[str, str]:
        """Of an arm: kind -> its keys, ? behind those that may be left out."""
        raise NotImplementedError

    @model_validator(mode="after")
    def _has_the_keys_of_its_kind(self, info: ValidationInfo) -> Self:
        keys = {kind: set(words.split()) for kind, words in self.kinds(_dimension(info)).items()}
        if self.kind not in keys:
            _refuse("kind", f"found {self.kind!r} for {ARMS[_dimension(info)]}, {nearest(self.kind, keys)}")
        for key in type(self).model_fields.keys() - {"kind"}:
            present = getattr(self, key) is not None
            if present and not {key, f"{key}?"} & keys[self.kind]:
                owners = sorted(kind for kind, words in keys.items() if {key, f"{key}?"} & words)
                _refuse(
                    key, f"found for kind {self.kind}, allowed: {'for ' if owners else 'left out'}{', '.join(owners)}"
                )
            if not present and key in keys[self.kind]:
                _refuse(key, "is missing, allowed: a value for it")
        return self


class ConstraintTable(TableOfKind):
    """`[[constraints]]`."""

    kind: str = Field(json_schema_extra={"enum": [*CONSTRAINTS]})
    x_mm: Annotated[list[float], Rising] | None = None
    y_mm: Annotated[list[float], Rising] | None = None
    z_mm: Annotated[list[float], Rising] | None = None
    center_mm: Point | None = None
    radius_mm: Positive | None = None
    start_mm: Point | None = None
    end_mm: Point | None = None
    tracker_mm: Point | None = None
    half_angle_deg: HalfTurn | None = None
    toward_mm: Point | None = None
    range_mm: Annotated[list[NotNegative], Rising] | None = None
    facing: Direction | None = None
    acceptance_deg: HalfTurn | None = None

    @classmethod
    def kinds(cls, dimension: int) -> dict[str, str]:
        return {kind: of[dimension] for kind, of in CONSTRAINTS.items() if dimension in of}

    @model_validator(mode="after")
    def _has_directions(self) -> Self:
        for key, other in (("end_mm", "start_mm"), ("toward_mm", "tracker_mm")):
            if (value := getattr(self, key)) is not None and value == getattr(self, other):
                _refuse(key, f"found {value}, allowed: another point than {other}")
        if self.acceptance_deg is not None and self.facing is None:
            _refuse("acceptance_deg", "found without facing, allowed: with facing")
        return self


class InstrumentTable(TableOfKind):
    """`[instrument]`: what is measured where it is not positions."""

    kind: str = Field(json_schema_extra={"enum": [*KINDS]})
    radius_mm: Positive | None = None
    center_mm: Point | None = None
    normal: Direction | None = None
    cups: dict[str, Point] | None = None
    distances_mm: list[Annotated[tuple[str, str, Length], Field(strict=False)]] | None = None

    @classmethod
    def kinds(cls, dimension: int) -> dict[str, str]:
        of_arm = kinds("xyz"[:dimension])
        return {kind: " ".join(f"{key}?" for key in each.keys) for kind, each in of_arm.items()}

    @model_validator(mode="after")
    def _center_and_normal_go_together(self) -> Self:
        if "normal" in KINDS[self.kind].keys and (self.normal is None) != (self.center_mm is None):
            here, missing = ("center_mm", "normal") if self.normal is None else ("normal", "center_mm")
            _refuse(missing, f"is missing beside {here}, allowed: both or none")
        return self


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


class CalibrationTable(StrictTable):
    """`[calibration]`; `base` and `tools` are what the corrections of values amount to, where they were estimated."""

    length_errors_mm: NeededInPlane[list[float]] = None
    joint_offsets_deg: NeededInPlane[list[float]] = None
    values: NeededInSpace[dict[str, float]] = None
    base: InSpace[PoseTable] = None
    tools: InSpace[dict[str, PoseTable]] = None
    effects: dict[str, float] = {}
    parameters: list[str] | None = None
    covariance: list[list[float]] | None = None
    provenance: ProvenanceTable = ProvenanceTable()

    @model_validator(mode="after")
    def _covariance_can_be(self) -> Self:
        """Symmetric and positive semidefinite, but for rounding."""
        if self.covariance is None:
            return self
        if (names := self.parameters) is None:
            _refuse("parameters", "is missing, allowed: the names of the rows of covariance")
        counts = {"rows": {len(self.covariance)}, "values in a row": {len(row) for row in self.covariance}}
        for what, count in ((what, count) for what, found in counts.items() for count in found - {len(names)}):
            _refuse("covariance", f"found {count} {what} for {len(names)} parameters, allowed: {len(names)}")
        matrix: Array = np.array(self.covariance).reshape(len(names), len(names))
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
        return self


def _by_marker(table: Any) -> Any:
    """Tables of markers by name; the table of an arm with a single marker under an empty name."""
    several = isinstance(table, dict) and table and all(isinstance(value, dict) for value in table.values())
    return table if several or not isinstance(table, dict) else {"": table}


class ArmFile(StrictTable):
    """The whole file."""

    kind: Literal["planar", "spatial"] = "planar"
    name: str = "arm"
    links_mm: NeededInPlane[Annotated[list[Length], Field(min_length=1, max_length=MAX_LINKS)]] = None
    urdf: InSpace[str] = None
    base_link: InSpace[str] = None
    tip_link: InSpace[str] = None
    dh: InSpace[Annotated[list[DHTable], Field(min_length=1, max_length=MAX_LINKS)]] = None
    joint_limits_deg: LimitsTable | None = None
    joint_limits_mm: InSpace[LimitsTable] = None
    joints: JointsTable | None = None
    base: InSpace[PoseTable] = None
    tool: InSpace[Annotated[dict[str, PoseTable], BeforeValidator(_by_marker)]] = None
    machining: InSpace[MachiningTable] = None
    measurement: MeasurementTable | None = None
    instrument: InstrumentTable | None = None
    gravity: GravityTable | None = None
    gear_ratio: list[NotNegative] | None = None
    constraints: list[ConstraintTable] = []
    effects: list[EffectTable] = []
    calibration: CalibrationTable | None = None

    @model_validator(mode="after")
    def _keys_go_together(self) -> Self:
        if self.kind == "spatial" and (self.urdf is None) == (self.dh is None):
            state = "neither is there" if self.urdf is None else "both are there"
            _refuse("urdf, dh", f"{state}, allowed: a URDF file or [[dh]] tables")
        for key in ("base_link", "tip_link"):
            if (getattr(self, key) is None) != (self.urdf is None):
                _refuse(key, f"{'is missing' if self.urdf else 'found without urdf'}, allowed: with urdf, a link of it")
        instrument, calibration = self.instrument, self.calibration
        for key, one, other, table in (
            ("measurement.sigma_deg", self.measurement and self.measurement.sigma_deg, instrument, "instrument"),
            ("instrument.center_mm", instrument and instrument.center_mm, self.base, "base"),
            ("calibration.base", calibration and calibration.base, self.base, "base"),
            ("calibration.tools", calibration and calibration.tools, self.tool, "tool"),
        ):
            if one and other is not None:
                _refuse(key, f"found beside [{table}], allowed: one of them")
        return self

    def require_counts(self, joints: int) -> None:
        """Raises `InputError` for lists that do not have a value for each joint, and for links of no length."""
        for place, table, keys in (
            ("gravity.", self.gravity, ("link_masses_kg", "center_of_mass")),
            ("calibration.", self.calibration, ("length_errors_mm", "joint_offsets_deg")),
            ("joints.", self.joints, ("sign", "coupled_to", "zero_deg")),
            ("", self, ("gear_ratio",)),
        ):
            for key in keys:
                if (values := getattr(table, key, None)) is not None:
                    require_count(f"{place}{key}", values, joints)
        errors = getattr(self.calibration, "length_errors_mm", None) or ()
        for j, (length, error) in enumerate(zip(self.links_mm or (), errors, strict=False), start=1):
            if length + error <= 0.0:
                state = f"found {error:g} for link {j} of {length:g} mm"
                raise InputError(f"calibration.length_errors_mm: {state}, allowed: more than {-length:g}")


def require_count(key: str, values: list[Any], count: int, whose: str = "joints") -> None:
    """Raises `InputError` unless there is one value for each joint."""
    if len(values) != count:
        raise InputError(f"{key}: found {len(values)} values for {count} {whose}, allowed: {count}")


# -- validation --------------------------------------------------------------------------------------------------------
def validated_arm(tables: Mapping[str, Any], place: str = "") -> ArmFile:
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
        raise InputError(f"{place}{key}: is missing, allowed: a value for it")
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
