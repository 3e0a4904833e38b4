"""A calibrated arm placed for other measurements: the base refitted, the rest unchanged.

The calibrated geometry of a spatial arm is composed into its chain, so that base and measured points are found by the
closed form on it and then, with the effects of the arm, by least squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from identification.arm import Arm, EffectSpec
from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.corrected import composed_axes, composed_base, composed_tools, corrected, errors_between
from identification.kinematics.frames import own_axes_angles
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet, of_effects
from identification.kinematics.spatial import BASE, TOOL, SpatialChain
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.model.placed import one_unnamed, placed_model, with_markers
from identification.sessions import BASE as PLANAR_BASE
from identification.sessions import start_at_bases, with_base_offset


def as_calibrated(arm: Arm) -> Arm:
    """The arm with its calibrated geometry as the nominal one; values of effects stay."""
    values = {} if arm.calibration is None else arm.calibration.values
    bare: dict[str, Any] = {"values": of_effects(values), "base": None, "tools": {}, "tool_axes": {}}
    kept = None if arm.calibration is None else replace(arm.calibration, **bare)
    effects = (_composed(spec, arm.chain, values) for spec in arm.effects)
    return replace(arm, chain=corrected(arm.chain, values), calibration=kept).with_effects(*effects)


def _composed(spec: EffectSpec, chain: SpatialChain, values: Mapping[str, float]) -> EffectSpec:
    """An effect whose curve says its geometry as errors of the corrected chain."""
    if spec.curve is None or not spec.curve.geometry:
        return spec
    of_curve = dict(spec.curve.geometry)
    of_curve |= {name: float(x) for name, x in chain.along_base(of_curve, values).items()}
    without = {name: values.get(name, 0.0) - of_curve.get(name, 0.0) for name in {*values, *of_curve}}
    errors = errors_between(corrected(chain, values), corrected(chain, without))
    geometry = {name: -error for name, error in errors.items()} | of_effects(of_curve)
    return replace(spec, curve=replace(spec.curve, geometry=geometry))


def refit_parameters(arm: Arm, measurements: Measurements) -> ParameterSet:
    """Those that a refit may estimate, among others."""
    if arm.chain.planar:
        return Model(with_base_offset(arm)).all_parameters
    return with_markers(one_unnamed(arm.chain, measurements), measurements).every_parameter


def check_names(chain: SpatialChain, measurements: Measurements) -> None:
    """Raise `InputError` for measured points that a chain does not have, where they are not to be estimated."""
    if len(chain.tools) == 1 == len(measurements.marker_names):
        return  # one point is the one that is measured, whatever the data call it
    fault = "no column marker, and the arm has several measured points" if not measurements.marker_names else ""
    fresh = [repr(name) for name in measurements.marker_names if name not in chain.tools]
    fault = f"unknown name {', '.join(fresh)}" if fresh else fault if len(chain.tools) > 1 else ""
    if fault:
        allowed = f"allowed: {', '.join(chain.tools)}; or --refit base, which finds where they are"
        raise InputError(f"measurements.marker: {fault}, {allowed}")


def fresh_points(chain: SpatialChain, measurements: Measurements) -> list[str]:
    """What is said of measured points that the calibration does not have: they are fitted to these measurements."""
    names = measurements.marker_names
    if not names and len(chain.tools) > 1:
        several = "where they are of several, name them in the column marker"
        return [
            f"no column marker: the rows are taken as of one reflector, whose position was fitted to them; {several}"
        ]
    if len(chain.tools) == 1 == len(names) or not (fresh := [name for name in names if name not in chain.tools]):
        return []
    its = "its position was" if len(fresh) == 1 else "their positions were"
    return [f"the calibration has no reflector {', '.join(fresh)}: {its} fitted to these rows"]


def refit_model(arm: Arm, measurements: Measurements, conditions: Conditions, refit: str) -> tuple[Model, Array]:
    """The calibrated arm of which only what is refitted is free (`validate`), and (p,) where it starts."""
    if not arm.chain.planar:
        model = _spatial(arm, measurements, refit)
        return model, model.values
    if refit == "none":
        return Model(arm), np.zeros(0)
    offsets = [f"{JOINT_OFFSET}:{j}" for j in range(2, arm.links + 1)] if refit == "offsets" else []
    values = Model(arm).best_known
    model = Model(with_base_offset(arm), {k: value for k, value in values.items() if k not in (*PLANAR_BASE, *offsets)})
    start = model.parameters.vector(values)
    computed = model.position(measurements.postures, start, conditions)
    return model, start_at_bases(start, model, computed, measurements.positions)


def _spatial(arm: Arm, measurements: Measurements, refit: str) -> Model:
    """Starts at the closed form.

    refit : `base`: base and measured points; `offsets`: those and the offsets of the joints between the first and the
        last, which base and points stand for; `none`: nothing
    """
    arm = as_calibrated(arm)
    if refit == "none":
        check_names(arm.chain, measurements)
        model = Model(replace(arm, chain=with_markers(arm.chain, measurements)))
        free: set[str] = set()
    else:
        chain = replace(one_unnamed(arm.chain, measurements), known=frozenset())
        model = placed_model(Model(replace(arm, chain=chain)), measurements)
        model = replace(model, arm=_of_points(model.arm, chain))
        free = {p.name for p in model.geometry_parameters if p.kind in (BASE, TOOL)}
    if refit == "offsets":
        free |= {f"{JOINT_OFFSET}:{j}" for j in range(2, arm.links)}
    best = model.best_known
    return replace(model, known={name: value for name, value in best.items() if name not in free})


def _of_points(arm: Arm, before: SpatialChain) -> Arm:
    """The arm with the geometry of its curves for the one measured point that data call by another name."""
    if len(arm.chain.tools) != 1 or len(before.tools) != 1:
        return arm
    (old,), (new,) = before.tools, arm.chain.tools
    effects = []
    for spec in arm.effects:
        if spec.curve is not None:
            geometry = {k.replace(f"{TOOL}[{old}]", f"{TOOL}[{new}]"): v for k, v in spec.curve.geometry.items()}
            spec = replace(spec, curve=replace(spec.curve, geometry=geometry))
        effects.append(spec)
    return arm.with_effects(*effects)


def placed_values(chain: SpatialChain, values: Mapping[str, float]) -> dict[str, float]:
    """Where base and measured points are, by the names of their parameters [mm, rad]; other values as they are.

    values : corrections of base and points
    """
    base: Array = composed_base(chain, values)
    placed = dict(zip([f"base.{axis}" for axis in "xyz"], base[:3, 3].tolist(), strict=True))
    placed |= dict(zip([f"base.r{axis}" for axis in "xyz"], own_axes_angles(base[:3, :3]).tolist(), strict=True))
    for name, place in composed_tools(chain, values).items():
        placed |= {f"{TOOL}[{name}].{axis}": float(x) for axis, x in zip("xyz", np.asarray(place), strict=True)}
    for name, axes in composed_axes(chain, values).items():
        placed |= {f"{TOOL}[{name}].r{axis}": float(x) for axis, x in zip("xyz", own_axes_angles(axes), strict=True)}
    return {name: placed.get(name, value) for name, value in values.items()}
