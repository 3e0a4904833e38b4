"""Spatial arms in arm files, writing: the tables of the geometry, with the drawing as the text of a URDF file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import tomlkit

from identification.arm import Arm, Calibration, Machining
from identification.errors import InputError
from identification.files.toml import Plain
from identification.files.urdf import BASE_LINK, TIP, urdf_text
from identification.kinematics.corrected import standing_in
from identification.kinematics.frames import pose_table, tool_tables
from identification.kinematics.parameters import PRISMATIC
from identification.kinematics.spatial import BASE, TOOL, SpatialChain


def chain_tables(arm: Arm, chain: SpatialChain) -> Plain:
    """What an arm file says of the geometry, the joint limits, and what is known of base and measured points."""
    if chain.fixed:
        raise InputError(
            f"arm {arm.name}: has a chosen set of parameters, allowed: all of them; a file has no such key"
        )
    sliding = np.array(arm.joint_types) == PRISMATIC
    tables: Plain = {"name": arm.name, "kind": "spatial"}
    tables["urdf"] = tomlkit.string(urdf_text(chain, arm.name), literal=True, multiline=True)
    tables |= {"base_link": BASE_LINK, "tip_link": TIP}
    lower, upper = arm.column_limits
    for unit, own, factor in (("deg", ~sliding, 180.0 / np.pi), ("mm", sliding, 1.0)):
        if own.any() and np.all(np.isfinite([lower[own], upper[own]])):  # else those of the drawing
            sides = (("lower", lower[own]), ("upper", upper[own]))
            tables[f"joint_limits_{unit}"] = {side: [_tidy(factor * x) for x in values] for side, values in sides}
    if BASE in chain.known:
        tables["base"] = pose_table(chain.base)
    if TOOL in chain.known:
        tables["tool"] = tool_tables(chain.tools, chain.tool_axes)
    if chain.angle_scale is not None and arm.sigma is not None:
        tables["measurement"] = {"sigma_deg": _tidy(np.degrees(arm.sigma / chain.angle_scale))}
    if not (instrument := chain.instrument).whole:
        tables["instrument"] = {"kind": instrument.kind}
        tables["instrument"] |= {} if instrument.radius is None else {"radius_mm": float(instrument.radius)}
    if arm.machining != Machining():
        rotation = _tidy(np.degrees(arm.machining.rotation))
        tables["machining"] = {"translation_mm": arm.machining.translation, "rotation_deg": rotation}
    return tables


def _tidy(value: float) -> float:
    return float(f"{value:.15g}")


def calibration_with_places(chain: SpatialChain, found: Calibration | None) -> Calibration | None:
    """The calibration, with where base and measured points are if they are somewhere without being known."""
    somewhere = BASE not in chain.known and not np.array_equal(chain.base, np.eye(4))
    named = TOOL not in chain.known and (
        list(chain.tools) != ["1"] or bool(np.any(chain.tools["1"])) or bool(chain.tool_axes)
    )
    if not somewhere and not named:
        return found
    kept = found or Calibration({})
    stands = standing_in(chain, kept.values)
    if somewhere:
        kept = replace(kept, base=stands.base)
    return replace(kept, tools=stands.tools, tool_axes=stands.tool_axes) if named else kept
