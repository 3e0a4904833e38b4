"""The tables of a spatial arm's file, `kind = "spatial"`, and what each key allows."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, Field, model_validator

from identification.arm import LARGEST_ACCELERATION, LARGEST_ANGLE, LENGTH_RANGE, MAX_LINKS
from identification.errors import InputError
from identification.files.arm_schema import (
    BoxTable,
    CovarianceTable,
    EffectTable,
    GravityTable,
    JointsTable,
    MeasurementTable,
)
from identification.files.schema import (
    Acceleration,
    Angle,
    Coordinate,
    Length,
    NotNegative,
    Pair,
    Positive,
    Schema,
    StrictTable,
    Triple,
    require_count,
    require_rising,
)

POINT = "three numbers [mm]"
COORDINATE = f"a number [mm], up to {LENGTH_RANGE[1]:g}"
ANGLE = f"an angle [deg], up to {LARGEST_ANGLE:g}"


class DHTable(StrictTable):
    """`[[dh]]`: one joint."""

    a_mm: Coordinate = Field(description=COORDINATE)
    alpha_deg: Angle = Field(description=ANGLE)
    d_mm: Coordinate = Field(description=COORDINATE)
    offset_deg: Angle = Field(0.0, description=ANGLE)
    convention: Literal["standard", "modified"] | None = Field(None, description="standard or modified")
    joint: Literal["revolute", "prismatic"] = Field("revolute", description="revolute or prismatic")


class AnglesTable(StrictTable):
    """`[joint_limits_deg]`."""

    lower: list[Angle] = Field(description=f"one angle [deg] for each revolute joint, up to {LARGEST_ANGLE:g}")
    upper: list[Angle] = Field(description=f"one angle [deg] for each revolute joint, up to {LARGEST_ANGLE:g}")


class TravelsTable(StrictTable):
    """`[joint_limits_mm]`."""

    lower: list[Coordinate] = Field(description=f"one number [mm] for each prismatic joint, up to {LENGTH_RANGE[1]:g}")
    upper: list[Coordinate] = Field(description=f"one number [mm] for each prismatic joint, up to {LENGTH_RANGE[1]:g}")


class PoseTable(StrictTable):
    """`[base]`, `[tool]` or `[tool.MARKER]`: a pose, its rotation about its own x, then y, then z.

    A tool is a measured point in the frame of the tip; only where orientations are measured its rotation counts.
    """

    x_mm: Coordinate = Field(0.0, description=COORDINATE)
    y_mm: Coordinate = Field(0.0, description=COORDINATE)
    z_mm: Coordinate = Field(0.0, description=COORDINATE)
    rx_deg: Angle = Field(0.0, description=ANGLE)
    ry_deg: Angle = Field(0.0, description=ANGLE)
    rz_deg: Angle = Field(0.0, description=ANGLE)


class MachiningTable(StrictTable):
    """`[machining]`."""

    translation_mm: Length | None = Field(None, description=f"a number > 0 [mm], up to {LENGTH_RANGE[1]:g}")
    rotation_deg: Annotated[float, Field(gt=0, le=LARGEST_ANGLE)] | None = Field(
        None, description=f"a number > 0 [deg], up to {LARGEST_ANGLE:g}"
    )


class SpatialMeasurementTable(MeasurementTable):
    """`[measurement]`."""

    sigma_deg: Positive | None = Field(None, description="a number > 0 [deg]")


class InstrumentTable(StrictTable):
    """`[instrument]`: what is measured where it is not positions."""

    kind: Literal["distance", "sphere", "plane"] = Field(description="distance, sphere or plane")
    radius_mm: Positive | None = Field(None, description="a number > 0 [mm]")
    center_mm: Triple | None = Field(None, description=POINT)
    normal: Triple | None = Field(None, description="three numbers, a direction in the frame of the base")

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        if self.radius_mm is not None and self.kind != "sphere":
            raise InputError(
                f"instrument.radius_mm: found for kind {self.kind}, allowed: for sphere, left out where unknown"
            )
        if (self.normal is None) != (self.center_mm is None or self.kind != "plane"):
            found = "is missing beside center_mm" if self.normal is None else "found"
            raise InputError(f"instrument.normal: {found}, allowed: of a plane, with center_mm")
        if self.normal is not None and not any(self.normal):
            raise InputError(f"instrument.normal: found {self.normal}, allowed: a direction, not zero")
        return self


class SpatialGravityTable(GravityTable):
    """`[gravity]`."""

    acceleration_m_s2: Annotated[list[Acceleration], Field(min_length=3, max_length=3)] = Field(
        description=f"three numbers [m/s^2], up to {LARGEST_ACCELERATION:g}"
    )
    payload_at_mm: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = Field(
        None, description=f"three numbers [mm], up to {LENGTH_RANGE[1]:g}"
    )


class SpatialBoxTable(BoxTable):
    """`kind = "workspace_box"`."""

    z_mm: Pair = Field(description="two numbers [mm], the lower one first")


class SphereTable(StrictTable):
    """`kind = "keep_out_sphere"`."""

    kind: Literal["keep_out_sphere"]
    center_mm: Triple = Field(description=POINT)
    radius_mm: Positive = Field(description="a number > 0 [mm]")


class CylinderTable(StrictTable):
    """`kind = "keep_out_cylinder"`."""

    kind: Literal["keep_out_cylinder"]
    start_mm: Triple = Field(description=POINT)
    end_mm: Triple = Field(description=f"{POINT}, another point than start_mm")
    radius_mm: Positive = Field(description="a number > 0 [mm]")

    @model_validator(mode="after")
    def _has_axis(self) -> Self:
        if self.end_mm == self.start_mm:
            raise ValueError(f"end_mm: found {self.end_mm}, allowed: another point than start_mm")
        return self


class SpatialSightTable(StrictTable):
    """`kind = "line_of_sight"`."""

    kind: Literal["line_of_sight"]
    tracker_mm: Triple = Field(description=POINT)
    half_angle_deg: Annotated[float, Field(gt=0, le=180)] = Field(description="a number > 0 and <= 180 [deg]")
    toward_mm: Triple = Field(description=f"{POINT}, another point than tracker_mm")
    range_mm: Annotated[list[NotNegative], Field(min_length=2, max_length=2)] | None = Field(
        None, description="two numbers >= 0 [mm], the lower one first"
    )
    facing: Triple | None = Field(None, description="three numbers, a direction in the frame of the tip")
    acceptance_deg: Annotated[float, Field(gt=0, le=180)] | None = Field(
        None, description="a number > 0 and <= 180 [deg]"
    )

    @model_validator(mode="after")
    def _has_directions(self) -> Self:
        if self.toward_mm == self.tracker_mm:
            raise ValueError(f"toward_mm: found {self.toward_mm}, allowed: another point than tracker_mm")
        if self.range_mm is not None:
            require_rising("range_mm", self.range_mm)
        if self.facing is not None and not any(self.facing):
            raise ValueError(f"facing: found {self.facing}, allowed: a direction, not zero")
        if self.acceptance_deg is not None and self.facing is None:
            raise ValueError("acceptance_deg: found without facing, allowed: with facing")
        return self


class SpatialCalibrationTable(CovarianceTable):
    """`[calibration]`; `base` and `tools` are what the corrections of values amount to, where they were estimated."""

    values: dict[str, float] = Field(description="a table of numbers [mm, deg], its keys as translation_x:2")
    base: PoseTable | None = Field(None, description="a table with x_mm, y_mm, z_mm, rx_deg, ry_deg, rz_deg")
    tools: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="a table of x_mm, y_mm, z_mm for each marker"
    )


SpatialConstraint = Annotated[
    SpatialBoxTable | SphereTable | CylinderTable | SpatialSightTable, Field(discriminator="kind")
]


class SpatialArmFile(StrictTable):
    """The whole file."""

    kind: Literal["spatial"] = Field(description="spatial, or left out for a planar arm")
    name: str = Field("arm", description="a text")
    urdf: str | None = Field(None, description="the name of a URDF file beside this one, or its text")
    base_link: str | None = Field(None, description="the name of a link of the URDF file")
    tip_link: str | None = Field(None, description="the name of a link of the URDF file")
    dh: list[DHTable] | None = Field(None, min_length=1, max_length=MAX_LINKS, description=f"1 to {MAX_LINKS} [[dh]]")
    joint_limits_deg: AnglesTable | None = Field(None, description="a table with lower and upper")
    joint_limits_mm: TravelsTable | None = Field(None, description="a table with lower and upper")
    joints: JointsTable | None = Field(None, description="a table with sign, coupled_to, zero_deg")
    base: PoseTable | None = Field(None, description="a table with x_mm, y_mm, z_mm, rx_deg, ry_deg, rz_deg")
    tool: dict[str, Any] | None = Field(None, description="a table with x_mm, y_mm, z_mm, or one for each marker")
    machining: MachiningTable | None = Field(None, description="a table with translation_mm, rotation_deg")
    measurement: SpatialMeasurementTable | None = Field(None, description="a table with sigma_mm, sigma_deg")
    instrument: InstrumentTable | None = Field(None, description="a table with kind, radius_mm, center_mm, normal")
    gravity: SpatialGravityTable | None = Field(
        None, description="a table with acceleration_m_s2, link_masses_kg, center_of_mass, payload_kg, payload_at_mm"
    )
    gear_ratio: list[NotNegative] | None = Field(
        None, description="one number >= 0 for each joint: turns of its motor per turn, 0 where it is not known"
    )
    constraints: list[SpatialConstraint] = Field(default_factory=list, description="tables [[constraints]]")
    effects: list[EffectTable] = Field(default_factory=list, description="tables [[effects]]")
    calibration: SpatialCalibrationTable | None = Field(None, description="a table with a table values")

    @model_validator(mode="after")
    def _one_instrument(self) -> Self:
        if self.instrument is not None and self.measurement is not None and self.measurement.sigma_deg is not None:
            raise InputError("measurement.sigma_deg: found beside [instrument], allowed: one of them")
        if self.base is not None and self.instrument is not None and self.instrument.center_mm is not None:
            raise InputError("instrument.center_mm: found beside [base], allowed: one of them")
        return self

    @model_validator(mode="after")
    def _one_geometry(self) -> Self:
        if (self.urdf is None) == (self.dh is None):
            found = "neither is there" if self.urdf is None else "both are there"
            raise InputError(f"urdf, dh: {found}, allowed: a URDF file or [[dh]] tables")
        for key in ("base_link", "tip_link"):
            if (getattr(self, key) is None) != (self.urdf is None):
                found, allowed = ("is missing", "the name of a link") if self.urdf else ("found", "with urdf")
                raise InputError(f"{key}: {found}, allowed: {allowed}")
        return self

    def require_counts(self, joints: int) -> None:
        """Raises `InputError` for lists that do not have a value for each joint."""
        for key in ("link_masses_kg", "center_of_mass"):
            if (values := getattr(self.gravity, key, None)) is not None:
                require_count(f"gravity.{key}", values, joints, whose="joints")
        if self.gear_ratio is not None:
            require_count("gear_ratio", self.gear_ratio, joints, whose="joints")


_TABLES: dict[str, type[BaseModel]] = {
    "": SpatialArmFile,
    "dh": DHTable,
    "joint_limits_deg": AnglesTable,
    "joint_limits_mm": TravelsTable,
    "joints": JointsTable,
    "base": PoseTable,
    "machining": MachiningTable,
    "measurement": SpatialMeasurementTable,
    "instrument": InstrumentTable,
    "gravity": SpatialGravityTable,
    "effects": EffectTable,
    "calibration": SpatialCalibrationTable,
    "calibration.base": PoseTable,
    "constraints.workspace_box": SpatialBoxTable,
    "constraints.keep_out_sphere": SphereTable,
    "constraints.keep_out_cylinder": CylinderTable,
    "constraints.line_of_sight": SpatialSightTable,
}
SPATIAL, TOOLS = Schema(_TABLES, {"links_mm": "planar"}), Schema({"": PoseTable})
