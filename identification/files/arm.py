"""Arm files, reading: TOML in millimetres and degrees -> `Arm` in millimetres and radians (`arm_text` writes)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from identification.arm import Arm, Calibration
from identification.arrays import readonly
from identification.errors import InputError
from identification.files.arm_effects import (
    FileName,
    calibrated_effects,
    check_tables,
    covariance_of,
    effects_of,
    file_names,
    gravity_of,
    with_geometry,
)
from identification.files.arm_schema import (
    PLANAR,
    ArmFile,
    BoxTable,
    CalibrationTable,
    CircleTable,
    ConstraintTable,
)
from identification.files.io import PathLike, read_toml
from identification.files.joint_counting import counting_of, limits_of_joints
from identification.files.schema import require_count
from identification.kinematics.parameters import REVOLUTE, chain_parameters
from identification.workspace import KeepOutCircle, LineOfSight, WorkspaceBox, WorkspaceConstraint


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
    _warn_if_radians(path, tables)
    return arm


def arm_from_tables(tables: dict[str, Any], folder: PathLike = ".") -> Arm:
    """The arm of parsed TOML; raises `InputError` as `load_arm` does, without the file's name.

    folder : where the files are that the tables name
    """
    if (kind := tables.get("kind", "planar")) == "spatial":
        from identification.files.arm_spatial import spatial_arm  # imports CasADi: planar arms do without

        return spatial_arm(tables, folder)
    if kind != "planar":
        raise InputError(f"kind: found {kind!r}, allowed: planar or spatial")
    file: ArmFile = PLANAR.validated(tables)
    links = len(file.links_mm)
    counting = counting_of(file.joints, (REVOLUTE,) * links)
    constraints: list[WorkspaceConstraint] = [_constraint(table) for table in file.constraints]
    lower, upper = None, None
    if (limits := file.joint_limits_deg) is not None:
        lower, upper = np.radians(limits.lower), np.radians(limits.upper)
        if counting is not None:
            for side, values in (("lower", limits.lower), ("upper", limits.upper)):
                require_count(f"joint_limits_deg.{side}", values, links)
            lower, upper, tied = limits_of_joints(counting, (REVOLUTE,) * links, lower, upper)
            constraints += tied
    effects = effects_of(file.effects, links)
    check_tables(file.gravity, effects)
    names = file_names(chain_parameters(np.ones(links)), effects)
    return Arm(
        lengths=readonly(file.links_mm),
        lower=lower,  # type: ignore[arg-type]
        upper=upper,  # type: ignore[arg-type]
        sigma=None if file.measurement is None else file.measurement.sigma_mm,
        name=file.name,
        gravity=gravity_of(file.gravity, links),
        constraints=tuple(constraints),
        effects=with_geometry(effects, file.effects, chain_parameters(np.ones(links))),
        calibration=None if file.calibration is None else _calibration(file.calibration, names),
        gear_ratios=None if file.gear_ratio is None else readonly(file.gear_ratio),
        counting=counting,
    )


# -- reading -----------------------------------------------------------------------------------------------------------
def _warn_if_radians(path: PathLike, tables: Mapping[str, Any]) -> None:
    limits = tables.get("joint_limits_deg")
    values = [abs(value) for key in ("lower", "upper") for value in limits[key]] if limits else []
    if values and max(values) <= 2.0 * np.pi + 0.01:
        message = "joint_limits_deg: all limits are within 6.3 deg and look like radians; write them in degrees"
        warnings.warn(f"{path}: {message}", UserWarning, stacklevel=3)


def _constraint(table: ConstraintTable) -> WorkspaceConstraint:
    if isinstance(table, BoxTable):
        return WorkspaceBox((table.x_mm[0], table.x_mm[1]), (table.y_mm[0], table.y_mm[1]))
    if isinstance(table, CircleTable):
        return KeepOutCircle((table.center_mm[0], table.center_mm[1]), table.radius_mm)
    tracker, toward = table.tracker_mm, table.toward_mm
    return LineOfSight((tracker[0], tracker[1]), float(np.radians(table.half_angle_deg)), (toward[0], toward[1]))


def _calibration(table: CalibrationTable, names: list[FileName]) -> Calibration:
    of_effects = names[2 * len(table.length_errors_mm) :]
    order, covariance = covariance_of(table, names)
    return Calibration.of(
        table.length_errors_mm,
        np.radians(table.joint_offsets_deg),
        calibrated_effects(table, of_effects),
        parameter_names=order,
        covariance=covariance,
        provenance=MappingProxyType(dict(table.provenance)),
    )
