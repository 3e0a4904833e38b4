"""The tables of an arm file, of the plane or of space, what each key allows, and one-line messages for wrong values.

The description of a type or of a key is the end of its error message; COORDINATES in it stands for `two numbers` or
`three numbers`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

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
from pydantic_core import PydanticCustomError

from identification.arm import (
    LARGEST_ACCELERATION,
    LARGEST_ANGLE,
    LARGEST_MASS,
    LENGTH_RANGE,
    MAX_LINKS,
    SIGMA_RANGE,
)
from identification.arrays import Array
from identification.errors import InputError, close_names, nearest
from identification.instruments import IN_PLANE, KINDS
from identification.kinematics.counting import KEYS

DIMENSIONS = {"planar": 2, "spatial": 3}
NUMBERS = {2: "two numbers", 3: "three numbers"}
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


# -- types of values ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Of:
    """Marks a key that only files of planar arms (2) or of spatial arms (3) have;  required : there it must be."""

    dimension: int
    required: bool = False

    def __get_pydantic_json_schema__(self, core_schema: Any, handler: Any) -> dict[str, Any]:
        """Keeps the mark for `json_schema`."""
        return {**handler(core_schema), "of": self}


def _dimension(info: ValidationInfo) -> int:
    """Of the arm."""
    return int((info.context or {})["dimension"])


def _one_for_each_axis(values: list[float], info: ValidationInfo) -> list[float]:
    if len(values) != _dimension(info):
        raise PydanticCustomError("too_short", "one number for each axis")
    return values


def _rising(values: list[float]) -> list[float]:
    if values[0] >= values[1]:
        raise PydanticCustomError("falling", "the lower one first")
    return values


def _direction(values: list[float]) -> list[float]:
    if not any(values):
        raise PydanticCustomError("zero", "a direction, not zero")
    return values


T = TypeVar("T")
F = TypeVar("F", bound=BaseModel)
InSpace = Annotated[T | None, Of(3)]
NeededInPlane = Annotated[T | None, Of(2, required=True)]
NeededInSpace = Annotated[T | None, Of(3, required=True)]
UP_TO_LENGTH, UP_TO_ANGLE = f"up to {LENGTH_RANGE[1]:g}", f"up to {LARGEST_ANGLE:g}"
LINKS = f"1 to {MAX_LINKS} link lengths > 0 [mm], {LENGTH_RANGE[0]:g} to {LENGTH_RANGE[1]:g}"
TWO, THREE = Field(min_length=2, max_length=2), Field(min_length=3, max_length=3)
UPON_AXES, RISING = AfterValidator(_one_for_each_axis), AfterValidator(_rising)

Coordinate = Annotated[
    float, Field(ge=-LENGTH_RANGE[1], le=LENGTH_RANGE[1], description=f"a number [mm], {UP_TO_LENGTH}")
]
Angle = Annotated[float, Field(ge=-LARGEST_ANGLE, le=LARGEST_ANGLE, description=f"an angle [deg], {UP_TO_ANGLE}")]
Length = Annotated[float, Field(ge=LENGTH_RANGE[0], le=LENGTH_RANGE[1])]
Mass = Annotated[float, Field(ge=0, le=LARGEST_MASS, description=f"a number >= 0 [kg], up to {LARGEST_MASS:g}")]
Acceleration = Annotated[float, Field(ge=-LARGEST_ACCELERATION, le=LARGEST_ACCELERATION)]
Distance = Annotated[
    tuple[str, str, Length], Field(strict=False, description="[cup, other cup, mm between their centers]")
]
Radius = Annotated[float, Field(gt=0, description="a number > 0 [mm]")]
HalfTurn = Annotated[float, Field(gt=0, le=180, description="a number > 0 and <= 180 [deg]")]
Point = Annotated[list[float], UPON_AXES, Field(description="COORDINATES [mm]")]
Direction = Annotated[
    list[float], THREE, AfterValidator(_direction), Field(description="a direction of three numbers, not zero")
]
Pair = Annotated[list[float], TWO, RISING, Field(description="the lower one first, two numbers [mm]")]


# -- tables ------------------------------------------------------------------------------------------------------------
class StrictTable(BaseModel):
    """A table without unknown keys, its numbers finite; validated with the context `dimension` of the arm."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _has_no_key_of_other_arms(cls, values: Any, info: ValidationInfo) -> Any:
        if not isinstance(values, dict) or values.keys() - cls.model_fields.keys():
            return values  # a misspelt key says more
        for key, mark in _marks(cls):
            if key in values and mark.dimension != _dimension(info):
                raise PydanticCustomError("other_arm", "of another kind of arm", {"key": key, "value": values[key]})
        return values

    @model_validator(mode="after")
    def _has_every_key_of_this_arm(self, info: ValidationInfo) -> Self:
        for key, mark in _marks(type(self)):
            if mark.required and mark.dimension == _dimension(info) and getattr(self, key) is None:
                raise PydanticCustomError("missing", "is missing", {"key": key})
        return self


def _marks(table: type[BaseModel]) -> Iterator[tuple[str, Of]]:
    for key, field in table.model_fields.items():
        yield from ((key, mark) for mark in field.metadata if isinstance(mark, Of))


class LimitsTable(StrictTable):
    """`[joint_limits_deg]`."""

    lower: list[Angle] = Field(description=f"one angle [deg] for each turning joint, {UP_TO_ANGLE}")
    upper: list[Angle] = Field(description=f"one angle [deg] for each turning joint, {UP_TO_ANGLE}")


class TravelsTable(StrictTable):
    """`[joint_limits_mm]`."""

    lower: list[Coordinate] = Field(description=f"one number [mm] for each prismatic joint, {UP_TO_LENGTH}")
    upper: list[Coordinate] = Field(description=f"one number [mm] for each prismatic joint, {UP_TO_LENGTH}")


class JointsTable(StrictTable):
    """`[joints]`: how the controller counts them (identification/kinematics/counting.py)."""

    sign: list[int] | None = Field(None, description="1 or -1 for each joint")
    coupled_to: list[int] | None = Field(
        None, description="a joint from 1, negative: against its sense, or 0, for each"
    )
    zero_deg: list[Angle] | None = Field(None, description=f"one angle [deg] for each joint, {UP_TO_ANGLE}")


class DHTable(StrictTable):
    """`[[dh]]`: one joint."""

    a_mm: Coordinate
    alpha_deg: Angle
    d_mm: Coordinate
    offset_deg: Angle = 0.0
    convention: Literal["standard", "modified"] | None = Field(None, description="standard or modified")
    joint: Literal["revolute", "prismatic"] = Field("revolute", description="revolute or prismatic")


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

    translation_mm: Length | None = Field(None, description=f"a number > 0 [mm], {UP_TO_LENGTH}")
    rotation_deg: Annotated[float, Field(gt=0, le=LARGEST_ANGLE)] | None = Field(
        None, description=f"a number > 0 [deg], {UP_TO_ANGLE}"
    )


class MeasurementTable(StrictTable):
    """`[measurement]`."""

    sigma_mm: Annotated[float, Field(ge=SIGMA_RANGE[0], le=SIGMA_RANGE[1])] | None = Field(
        None, description=f"a number > 0 [mm], {SIGMA_RANGE[0]:g} to {SIGMA_RANGE[1]:g}"
    )
    sigma_deg: InSpace[Annotated[float, Field(gt=0)]] = Field(None, description="a number > 0 [deg]")


class InstrumentTable(StrictTable):
    """`[instrument]`: what is measured where it is not positions."""

    kind: Literal[tuple(KINDS)] = Field(description=" or ".join([", ".join([*KINDS][:-1]), [*KINDS][-1]]))  # type: ignore[valid-type]
    radius_mm: Radius | None = None
    center_mm: Point | None = None
    normal: Direction | None = None
    cups: dict[str, Point] | None = Field(None, description="COORDINATES [mm] for each cup")
    distances_mm: list[Distance] | None = Field(
        None, description="a list of [cup, other cup, mm between their centers]"
    )

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        keys = KINDS[self.kind].keys
        if self.radius_mm is not None and "radius_mm" not in keys:
            raise ValueError(f"radius_mm: found for kind {self.kind}, allowed: for sphere, left out where unknown")
        for key in ("cups", "distances_mm"):
            if getattr(self, key) is not None and key not in keys:
                owners = " or ".join(name for name, kind in KINDS.items() if key in kind.keys)
                raise ValueError(f"{key}: found for kind {self.kind}, allowed: for {owners}")
        if self.center_mm is not None and "center_mm" not in keys:
            raise ValueError(f"center_mm: found for kind {self.kind}, allowed: left out")
        if (self.normal is None) != (self.center_mm is None or "normal" not in keys):
            state = "is missing beside center_mm" if self.normal is None else "found"
            raise ValueError(f"normal: {state}, allowed: of a plane, with center_mm")
        return self


class GravityTable(StrictTable):
    """`[gravity]`."""

    acceleration_m_s2: Annotated[list[Acceleration], UPON_AXES] = Field(
        description=f"COORDINATES [m/s^2], up to {LARGEST_ACCELERATION:g}"
    )
    link_masses_kg: list[Mass] = Field(description=f"one mass >= 0 [kg] for each link, up to {LARGEST_MASS:g}")
    center_of_mass: list[Annotated[float, Field(ge=0, le=1)]] | None = Field(
        None, description="one fraction 0 to 1 for each link"
    )
    payload_kg: Mass = 0.0
    payload_at_mm: InSpace[Annotated[list[Coordinate], THREE]] = Field(
        None, description=f"three numbers [mm], {UP_TO_LENGTH}"
    )


class BoxTable(StrictTable):
    """`kind = "workspace_box"`."""

    kind: Literal["workspace_box"]
    x_mm: Pair
    y_mm: Pair
    z_mm: NeededInSpace[Pair] = None


class CircleTable(StrictTable):
    """`kind = "keep_out_circle"`."""

    kind: Annotated[Literal["keep_out_circle"], Of(2)]
    center_mm: Point
    radius_mm: Radius


class SphereTable(StrictTable):
    """`kind = "keep_out_sphere"`."""

    kind: Annotated[Literal["keep_out_sphere"], Of(3)]
    center_mm: Point
    radius_mm: Radius


class CylinderTable(StrictTable):
    """`kind = "keep_out_cylinder"`."""

    kind: Annotated[Literal["keep_out_cylinder"], Of(3)]
    start_mm: Point
    end_mm: Point
    radius_mm: Radius

    @model_validator(mode="after")
    def _has_axis(self) -> Self:
        if self.end_mm == self.start_mm:
            raise ValueError(f"end_mm: found {self.end_mm}, allowed: another point than start_mm")
        return self


class SightTable(StrictTable):
    """`kind = "line_of_sight"`."""

    kind: Literal["line_of_sight"]
    tracker_mm: Point
    half_angle_deg: HalfTurn
    toward_mm: Point
    range_mm: InSpace[Annotated[list[Annotated[float, Field(ge=0)]], TWO, RISING]] = Field(
        None, description="the lower one first, two numbers >= 0 [mm]"
    )
    facing: InSpace[Direction] = None
    acceptance_deg: InSpace[HalfTurn] = None

    @model_validator(mode="after")
    def _has_directions(self) -> Self:
        if self.toward_mm == self.tracker_mm:
            raise ValueError(f"toward_mm: found {self.toward_mm}, allowed: another point than tracker_mm")
        if self.acceptance_deg is not None and self.facing is None:
            raise ValueError("acceptance_deg: found without facing, allowed: with facing")
        return self


class EffectTable(BaseModel):
    """`[[effects]]`: the keys besides these are the effect's own parameters."""

    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)
    __pydantic_extra__: dict[str, float]

    name: str = Field(description="the name of an effect")
    joint: int | None = Field(None, description="the whole number of a joint, from 1")
    from_deg: Angle | None = Field(None, description="the angle [deg] of the first of values_deg")
    to_deg: Angle | None = Field(None, description="the angle [deg] of the last of values_deg")
    values_deg: list[Angle] | None = Field(None, description="the values [deg] at equally spaced angles")
    geometry: dict[str, float] | None = Field(
        None, description="a table of numbers, its keys names of parameters, as `armcal diagnose --out` writes it"
    )

    @property
    def parameters(self) -> dict[str, float]:
        """Of the effect, as in the file."""
        return dict(self.__pydantic_extra__)


class CalibrationTable(StrictTable):
    """`[calibration]`; `base` and `tools` are what the corrections of values amount to, where they were estimated."""

    length_errors_mm: NeededInPlane[list[float]] = Field(None, description="one number [mm] for each link")
    joint_offsets_deg: NeededInPlane[list[float]] = Field(None, description="one angle [deg] for each link")
    values: NeededInSpace[dict[str, float]] = Field(
        None, description="a table of numbers [mm, deg], its keys as translation_x:2"
    )
    base: InSpace[PoseTable] = None
    tools: InSpace[dict[str, PoseTable]] = None
    effects: dict[str, float] = Field({}, description="a table of numbers, its keys as EFFECT:JOINT.PARAMETER")
    parameters: list[str] | None = Field(None, description="a list of names")
    covariance: list[list[float]] | None = Field(
        None, description="a square matrix of numbers, one row for each of parameters"
    )
    provenance: dict[str, Any] = Field({}, description="a table")

    @model_validator(mode="after")
    def _provenance_can_be(self) -> Self:
        """Of numbers that the program reads again."""
        rows = self.provenance.get("rows", 1)
        if isinstance(rows, bool) or not isinstance(rows, int) or rows < 1:
            raise ValueError(f"provenance.rows: found {rows!r}, allowed: a whole number >= 1")
        for key in KEYS.values():
            pairs = self.provenance.get(key, [])
            for j, pair in enumerate(pairs if isinstance(pairs, list) else [pairs], start=1):
                ends = [x for x in pair if type(x) in (int, float)] if isinstance(pair, list) else []
                if len(ends) != 2 or len(pair) != 2 or not -np.inf < ends[0] <= ends[1] < np.inf:
                    allowed = "two finite numbers, the lower one first"
                    raise ValueError(f"provenance.{key}[{j}]: found {pair!r}, allowed: {allowed}")
        return self

    @model_validator(mode="after")
    def _covariance_can_be(self) -> Self:
        """Symmetric and positive semidefinite, but for rounding."""
        if self.covariance is None:
            return self
        if (names := self.parameters) is None:
            raise ValueError("parameters: is missing, allowed: the names of the rows of covariance")
        require_count("calibration.covariance", self.covariance, len(names), "rows for", "parameters")
        for row in self.covariance:
            require_count("calibration.covariance", row, len(names), "values in a row for", "parameters")
        matrix: Array = np.array(self.covariance).reshape(len(names), len(names))
        variances = np.diag(matrix)
        if np.any(variances < 0.0):
            k = int(np.argmax(variances < 0.0))
            raise ValueError(f"covariance: found variance {variances[k]:g} of {names[k]}, allowed: >= 0")
        largest = np.outer(np.sqrt(variances), np.sqrt(variances))  # at a correlation of one
        beyond = np.abs(matrix) > (1.0 + ROUNDED) * largest
        uneven = np.abs(matrix - matrix.T) > ROUNDED * largest
        for wrong, allowed in ((beyond, "a correlation of -1 to 1"), (uneven, "a symmetric matrix")):
            if np.any(wrong):
                i, j = np.argwhere(wrong)[0].tolist()
                pair = f"{matrix[i, j]:g} and {matrix[j, i]:g} of {names[i]} and {names[j]}"
                raise ValueError(f"covariance: found {pair}, allowed: {allowed}")
        correlations = matrix / np.where(largest > 0.0, largest, 1.0)
        if matrix.size and (least := float(np.linalg.eigvalsh(correlations)[0])) < -ROUNDED * len(matrix):
            state = f"a matrix of correlations with eigenvalue {least:.3g}"
            raise ValueError(f"covariance: found {state}, allowed: positive semidefinite")
        return self


ConstraintTable = BoxTable | CircleTable | SphereTable | CylinderTable | SightTable


def _by_marker(table: Any) -> Any:
    """Tables of markers by name; the table of an arm with a single marker under an empty name."""
    several = isinstance(table, dict) and table and all(isinstance(value, dict) for value in table.values())
    return table if several or not isinstance(table, dict) else {"": table}


class ArmFile(StrictTable):
    """The whole file."""

    kind: Literal["planar", "spatial"] = Field("planar", description="planar or spatial")
    name: str = Field("arm", description="a text")
    links_mm: NeededInPlane[Annotated[list[Length], Field(min_length=1, max_length=MAX_LINKS)]] = Field(
        None, description=LINKS
    )
    urdf: InSpace[str] = Field(None, description="the name of a URDF file beside this one, or its text")
    base_link: InSpace[str] = Field(None, description="the name of a link of the URDF file")
    tip_link: InSpace[str] = Field(None, description="the name of a link of the URDF file")
    dh: InSpace[Annotated[list[DHTable], Field(min_length=1, max_length=MAX_LINKS)]] = Field(
        None, description=f"1 to {MAX_LINKS} [[dh]]"
    )
    joint_limits_deg: LimitsTable | None = None
    joint_limits_mm: InSpace[TravelsTable] = None
    joints: JointsTable | None = None
    base: InSpace[PoseTable] = None
    tool: Annotated[dict[str, PoseTable] | None, BeforeValidator(_by_marker), Of(3)] = None
    machining: InSpace[MachiningTable] = None
    measurement: MeasurementTable | None = None
    instrument: InstrumentTable | None = None
    gravity: GravityTable | None = None
    gear_ratio: list[Annotated[float, Field(ge=0)]] | None = Field(
        None, description="one number >= 0 for each joint: turns of its motor per turn, 0 where it is not known"
    )
    constraints: list[Annotated[ConstraintTable, Field(discriminator="kind")]] = Field(
        [], description="tables [[constraints]]"
    )
    effects: list[EffectTable] = Field([], description="tables [[effects]]")
    calibration: CalibrationTable | None = None

    @model_validator(mode="after")
    def _keys_go_together(self) -> Self:
        if self.kind == "planar":
            if self.instrument is not None and self.instrument.kind not in IN_PLANE:
                state = f"found {self.instrument.kind!r} for a planar arm"
                raise InputError(f"instrument.kind: {state}, allowed: {' or '.join(IN_PLANE)}")
            return self
        if self.instrument is not None and self.measurement is not None and self.measurement.sigma_deg is not None:
            raise InputError("measurement.sigma_deg: found beside [instrument], allowed: one of them")
        if self.base is not None and self.instrument is not None and self.instrument.center_mm is not None:
            raise InputError("instrument.center_mm: found beside [base], allowed: one of them")
        if (self.urdf is None) == (self.dh is None):
            state = "neither is there" if self.urdf is None else "both are there"
            raise InputError(f"urdf, dh: {state}, allowed: a URDF file or [[dh]] tables")
        for key in ("base_link", "tip_link"):
            if (getattr(self, key) is None) != (self.urdf is None):
                state, allowed = ("is missing", "the name of a link") if self.urdf else ("found", "with urdf")
                raise InputError(f"{key}: {state}, allowed: {allowed}")
        for key, estimated in (("base", "base"), ("tool", "tools")):
            if getattr(self, key) is not None and getattr(self.calibration, estimated, None):
                raise InputError(f"calibration.{estimated}: found beside [{key}], allowed: one of them")
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
                    whose = "links" if self.links_mm and key != "gear_ratio" and table is not self.joints else "joints"
                    require_count(f"{place}{key}", values, joints, whose=whose)
        errors = getattr(self.calibration, "length_errors_mm", None) or ()
        for j, (length, error) in enumerate(zip(self.links_mm or (), errors, strict=False), start=1):
            if length + error <= 0.0:
                state = f"found {error:g} for link {j} of {length:g} mm"
                raise InputError(f"calibration.length_errors_mm: {state}, allowed: more than {-length:g}")


def require_count(key: str, values: list[Any], count: int, what: str = "values for", whose: str = "links") -> None:
    """Raises `InputError` unless there is one value for each link, joint or other item."""
    if len(values) != count:
        raise InputError(f"{key}: found {len(values)} {what} {count} {whose}, allowed: {count}")


# -- validation --------------------------------------------------------------------------------------------------------
def validated_arm(tables: Mapping[str, Any], place: str = "") -> ArmFile:
    """The tables of an arm file. Raises `InputError` naming key, what was found and what is allowed.

    place : before the key in messages
    """
    kind = tables.get("kind", "planar")
    if not isinstance(kind, str) or kind not in DIMENSIONS:
        raise InputError(f"kind: found {kind!r}, allowed: planar or spatial")
    return validated(ArmFile, tables, place, DIMENSIONS[kind])


def validated(file: type[F], tables: Mapping[str, Any], place: str = "", dimension: int = 2) -> F:
    """The tables of any file; raises `InputError` as `validated_arm` does.

    dimension : of the arm, for keys and points that depend on it
    """
    try:
        return file.model_validate(tables, context={"dimension": dimension})
    except ValidationError as error:
        # a misspelt key is both unknown and missing: the first of the two says more
        says_most = {"extra_forbidden": 0, "other_arm": 1}
        first = min(error.errors(include_url=False), key=lambda detail: says_most.get(detail["type"], 2))
        raise InputError(f"{place}{_sentence(first, file, dimension)}") from None


def _sentence(detail: Any, file: type[BaseModel], dimension: int) -> str:
    """What is wrong, in one line."""
    kind, context = detail["type"], detail.get("ctx", {})
    loc = (*detail["loc"], context["key"]) if "key" in context else detail["loc"]
    table, description = _place(loc, file)
    # entries are counted from 1, and the kind of a constraint is no part of the key: `constraints[2].x_mm`
    shown = (*loc[:2], *loc[3:]) if loc and loc[0] == "constraints" else loc
    key = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in shown if part != "")[1:]
    if kind == "extra_forbidden":
        return f"{key}: {_unknown(str(loc[-1]), table, table is file, dimension)}"
    kinds = [
        tag
        for each in get_args(ConstraintTable)
        if all(name != "kind" or mark.dimension == dimension for name, mark in _marks(each))
        for tag in get_args(each.model_fields["kind"].annotation)
    ]
    if kind == "union_tag_not_found":
        return f"{key}.kind: is missing, allowed: {', '.join(sorted(kinds))}"
    if kind == "union_tag_invalid" or (kind == "other_arm" and loc[-1] == "kind"):
        tag = str(context["tag"] if kind == "union_tag_invalid" else context["value"])
        return f"{key.removesuffix('.kind')}.kind: found {tag!r}, {nearest(tag, kinds)}"
    if kind == "other_arm":
        other = {2: 'spatial (kind = "spatial")', 3: "planar"}[dimension]
        return f"{key}: found in the file of an arm that is not {other}, allowed: in one that is"
    if kind == "value_error":  # from a validator: a sentence already
        return f"{key}.{context['error']}"
    state = "is missing" if kind == "missing" else f"found {_shown(detail)}"
    return f"{key}: {state}, allowed: {description.replace('COORDINATES', NUMBERS[dimension])}"


def _place(loc: tuple[int | str, ...], file: type[BaseModel]) -> tuple[type[BaseModel], str]:
    """The innermost table that a place in the file lies in, and what the innermost key on the way allows."""
    table = file
    description, inner = "a table", [table]
    for part in loc:
        tagged = [
            each for each in inner if part in get_args(getattr(each.model_fields.get("kind"), "annotation", None))
        ]
        if tagged and len(inner) > 1:
            inner = tagged
        elif isinstance(part, str) and part in inner[0].model_fields:
            field = inner[0].model_fields[part]
            description, inner = _allowed(field.description, field.annotation), _tables(field.annotation) or inner
        elif inner[0] is EffectTable and isinstance(part, str):
            description = "a finite number"
        table = inner[0]
    return table, description


def _allowed(description: str | None, annotation: Any) -> str:
    """What a key allows: its description, that of its type, or the keys of its table."""
    types = [annotation, *get_args(annotation)]
    described = [getattr(part, "description", None) for each in types for part in getattr(each, "__metadata__", ())]
    if len(tables := _tables(annotation)) == 1 and not description:
        *first, last = tables[0].model_fields
        return f"a table with {', '.join(first)} and {last}"
    return description or next(filter(None, described), "a table")


def _tables(annotation: Any) -> list[type[BaseModel]]:
    """The tables in a type."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in get_args(annotation) for table in _tables(part)]


def _unknown(key: str, table: type[BaseModel], outermost: bool, dimension: int) -> str:
    """What to do about a key that a table does not have."""
    others = {name for name, mark in _marks(table) if mark.dimension != dimension}
    names = [name for name in table.model_fields if name not in others]
    if outermost and not close_names(key, names):
        inner = {name: _tables(table.model_fields[name].annotation) for name in names}
        below = [name for name, tables in inner.items() if len(tables) == 1 and key in tables[0].model_fields]
        if len(below) == 1:
            return f"found outside of a table, allowed: under [{below[0]}]"
    return f"unknown key, {nearest(key, names, OTHER_KEYS)}"


def _shown(detail: Any) -> str:
    value = detail["input"]
    if detail["type"] in ("too_long", "too_short"):
        return f"{len(value)} values"
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, bool):
        return str(value).lower()
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def json_schema(kind: str) -> dict[str, Any]:
    """The JSON schema of arm files of a kind, for editors."""
    whole = ArmFile.model_json_schema()
    for table in (whole, *whole["$defs"].values()):
        marks = {key: value.pop("of") for key, value in table["properties"].items() if "of" in value}
        for key, mark in marks.items():
            if mark.dimension != DIMENSIONS[kind]:
                del table["properties"][key]
            elif mark.required:
                table.setdefault("required", []).append(key)
    text = json.dumps(whole).replace("COORDINATES", NUMBERS[DIMENSIONS[kind]])
    return dict(json.loads(text))
