"""The tables of a planar arm's file and what each key allows."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from identification.arm import LARGEST_ACCELERATION, LARGEST_ANGLE, LARGEST_MASS, LENGTH_RANGE, MAX_LINKS, SIGMA_RANGE
from identification.arrays import Array
from identification.errors import InputError
from identification.files.schema import (
    Acceleration,
    Angle,
    Length,
    Mass,
    NotNegative,
    Pair,
    Positive,
    Schema,
    Sigma,
    StrictTable,
    require_count,
    require_rising,
)
from identification.kinematics.joint_range import KEYS

ROUNDED = 1e-5  # of a correlation, where a covariance is written with six digits


class LimitsTable(StrictTable):
    """`[joint_limits_deg]`."""

    lower: list[Angle] = Field(description=f"one angle [deg] for each link, up to {LARGEST_ANGLE:g}")
    upper: list[Angle] = Field(description=f"one angle [deg] for each link, up to {LARGEST_ANGLE:g}")


class JointsTable(StrictTable):
    """`[joints]`: how the controller counts them (identification/kinematics/counting.py)."""

    sign: list[int] | None = Field(None, description="1 or -1 for each joint")
    coupled_to: list[int] | None = Field(
        None, description="a joint from 1, negative: against its sense, or 0, for each"
    )
    zero_deg: list[Angle] | None = Field(None, description=f"one angle [deg] for each joint, up to {LARGEST_ANGLE:g}")


class MeasurementTable(StrictTable):
    """`[measurement]`."""

    sigma_mm: Sigma | None = Field(None, description=f"a number > 0 [mm], {SIGMA_RANGE[0]:g} to {SIGMA_RANGE[1]:g}")


class GravityTable(StrictTable):
    """`[gravity]`."""

    acceleration_m_s2: Annotated[list[Acceleration], Field(min_length=2, max_length=2)] = Field(
        description=f"two numbers [m/s^2], up to {LARGEST_ACCELERATION:g}"
    )
    link_masses_kg: list[Mass] = Field(description=f"one mass >= 0 [kg] for each link, up to {LARGEST_MASS:g}")
    center_of_mass: list[Annotated[float, Field(ge=0, le=1)]] | None = Field(
        None, description="one fraction 0 to 1 for each link"
    )
    payload_kg: Mass = Field(0.0, description=f"a number >= 0 [kg], up to {LARGEST_MASS:g}")


class BoxTable(StrictTable):
    """`kind = "workspace_box"`."""

    kind: Literal["workspace_box"]
    x_mm: Pair = Field(description="two numbers [mm], the lower one first")
    y_mm: Pair = Field(description="two numbers [mm], the lower one first")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for key in type(self).model_fields:
            if key != "kind":
                require_rising(key, getattr(self, key))
        return self


class CircleTable(StrictTable):
    """`kind = "keep_out_circle"`."""

    kind: Literal["keep_out_circle"]
    center_mm: Pair = Field(description="two numbers [mm]")
    radius_mm: Positive = Field(description="a number > 0 [mm]")


class SightTable(StrictTable):
    """`kind = "line_of_sight"`."""

    kind: Literal["line_of_sight"]
    tracker_mm: Pair = Field(description="two numbers [mm]")
    half_angle_deg: Annotated[float, Field(gt=0, le=180)] = Field(description="a number > 0 and <= 180 [deg]")
    toward_mm: Pair = Field(description="two numbers [mm], another point than tracker_mm")

    @model_validator(mode="after")
    def _has_axis(self) -> Self:
        if self.toward_mm == self.tracker_mm:
            raise ValueError(f"toward_mm: found {self.toward_mm}, allowed: another point than tracker_mm")
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
    def own(self) -> dict[str, float]:
        """The parameters, as in the file."""
        return dict(self.__pydantic_extra__)


def _listed(value: Any) -> list[Any]:
    """A list as it is, anything else as a list of it."""
    return value if isinstance(value, list) else [value]


class CovarianceTable(StrictTable):
    """What every `[calibration]` has."""

    effects: dict[str, float] = Field(
        default_factory=dict, description="a table of numbers, its keys as EFFECT:JOINT.PARAMETER"
    )
    parameters: list[str] | None = Field(None, description="a list of names")
    covariance: list[list[float]] | None = Field(
        None, description="a square matrix of numbers, one row for each of parameters"
    )
    provenance: dict[str, Any] = Field(default_factory=dict, description="a table")

    @property
    def matrix(self) -> Array:
        """(p, p) the covariance, in file units."""
        p = len(self.covariance or ())
        return np.array(self.covariance).reshape(p, p)

    @model_validator(mode="after")
    def _provenance_can_be(self) -> Self:
        rows = self.provenance.get("rows", 1)
        if isinstance(rows, bool) or not isinstance(rows, int) or rows < 1:
            raise InputError(f"calibration.provenance.rows: found {rows!r}, allowed: a whole number >= 1")
        for key in KEYS.values():
            for j, pair in enumerate(_listed(self.provenance.get(key, [])), start=1):
                ends = [x for x in _listed(pair) if isinstance(x, (int, float)) and not isinstance(x, bool)]
                if len(ends) != 2 or len(_listed(pair)) != 2 or not -np.inf < ends[0] <= ends[1] < np.inf:
                    allowed = "two finite numbers, the lower one first"
                    raise InputError(f"calibration.provenance.{key}[{j}]: found {pair!r}, allowed: {allowed}")
        return self

    @model_validator(mode="after")
    def _covariance_of_parameters(self) -> Self:
        if self.covariance is None:
            return self
        if self.parameters is None:
            raise InputError("calibration.parameters: is missing, allowed: the names of the rows of covariance")
        require_count("calibration.covariance", self.covariance, len(self.parameters), "rows for", "parameters")
        for row in self.covariance:
            require_count("calibration.covariance", row, len(self.parameters), "values in a row for", "parameters")
        check_covariance(self.matrix, self.parameters)
        return self


class CalibrationTable(CovarianceTable):
    """`[calibration]`."""

    length_errors_mm: list[float] = Field(description="one number [mm] for each link")
    joint_offsets_deg: list[float] = Field(description="one angle [deg] for each link")


ConstraintTable = Annotated[BoxTable | CircleTable | SightTable, Field(discriminator="kind")]


class ArmFile(StrictTable):
    """The whole file."""

    links_mm: list[Length] = Field(
        min_length=1,
        max_length=MAX_LINKS,
        description=f"1 to {MAX_LINKS} link lengths > 0 [mm], {LENGTH_RANGE[0]:g} to {LENGTH_RANGE[1]:g}",
    )
    kind: Literal["planar"] = Field("planar", description="planar or spatial")
    name: str = Field("arm", description="a text")
    joint_limits_deg: LimitsTable | None = Field(None, description="a table with lower and upper")
    joints: JointsTable | None = Field(None, description="a table with sign, coupled_to, zero_deg")
    measurement: MeasurementTable | None = Field(None, description="a table with sigma_mm")
    gravity: GravityTable | None = Field(
        None, description="a table with acceleration_m_s2, link_masses_kg, center_of_mass, payload_kg"
    )
    gear_ratio: list[NotNegative] | None = Field(
        None, description="one number >= 0 for each joint: turns of its motor per turn, 0 where it is not known"
    )
    constraints: list[ConstraintTable] = Field(default_factory=list, description="tables [[constraints]]")
    effects: list[EffectTable] = Field(default_factory=list, description="tables [[effects]]")
    calibration: CalibrationTable | None = Field(
        None, description="a table with length_errors_mm and joint_offsets_deg"
    )

    @model_validator(mode="after")
    def _one_value_for_each_link(self) -> Self:
        for place, table, keys in (
            ("gravity", self.gravity, ("link_masses_kg", "center_of_mass")),
            ("calibration", self.calibration, ("length_errors_mm", "joint_offsets_deg")),
        ):
            for key in keys:
                if (values := getattr(table, key, None)) is not None:
                    require_count(f"{place}.{key}", values, len(self.links_mm))
        if self.gear_ratio is not None:
            require_count("gear_ratio", self.gear_ratio, len(self.links_mm), "values for", "joints")
        return self

    @model_validator(mode="after")
    def _calibrated_lengths_are_positive(self) -> Self:
        errors = [] if self.calibration is None else self.calibration.length_errors_mm
        for j, (length, error) in enumerate(zip(self.links_mm, errors, strict=False), start=1):
            if length + error <= 0.0:
                found = f"found {error:g} for link {j} of {length:g} mm"
                raise InputError(f"calibration.length_errors_mm: {found}, allowed: more than {-length:g}")
        return self


PLANAR = Schema(
    {
        "": ArmFile,
        "joint_limits_deg": LimitsTable,
        "joints": JointsTable,
        "measurement": MeasurementTable,
        "gravity": GravityTable,
        "effects": EffectTable,
        "calibration": CalibrationTable,
        "constraints.workspace_box": BoxTable,
        "constraints.keep_out_circle": CircleTable,
        "constraints.line_of_sight": SightTable,
    },
    dict.fromkeys(
        ("urdf", "base_link", "tip_link", "dh", "joint_limits_mm", "base", "tool", "machining", "instrument"),
        'spatial (kind = "spatial")',
    ),
)


def check_covariance(matrix: Array, names: list[str]) -> None:
    """Raises `InputError` for a (p, p) matrix that is not symmetric and positive semidefinite, but for rounding."""
    variances = np.diag(matrix)
    if np.any(variances < 0.0):
        k = int(np.argmax(variances < 0.0))
        raise InputError(f"calibration.covariance: found variance {variances[k]:g} of {names[k]}, allowed: >= 0")
    largest = np.outer(np.sqrt(variances), np.sqrt(variances))
    _check_pairs(matrix, largest, names)
    scale = np.where(largest > 0.0, largest, 1.0)
    if matrix.size and (least := float(np.linalg.eigvalsh(matrix / scale)[0])) < -ROUNDED * len(matrix):
        found = f"a matrix of correlations with eigenvalue {least:.3g}"
        raise InputError(f"calibration.covariance: found {found}, allowed: positive semidefinite")


def _check_pairs(matrix: Array, largest: Array, names: list[str]) -> None:
    """Correlations and symmetry;  largest : (p, p) covariances at a correlation of one."""
    beyond = np.abs(matrix) > (1.0 + ROUNDED) * largest
    uneven = np.abs(matrix - matrix.T) > ROUNDED * largest
    for wrong, allowed in ((beyond, "a correlation of -1 to 1"), (uneven, "a symmetric matrix")):
        if np.any(wrong):
            i, j = (int(k) for k in np.argwhere(wrong)[0])
            found = f"{matrix[i, j]:g} and {matrix[j, i]:g} of {names[i]} and {names[j]}"
            raise InputError(f"calibration.covariance: found {found}, allowed: {allowed}")
