"""A spatial chain with its errors composed into it: where base, tools and joints really are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from identification.arrays import Array
from identification.kinematics.frames import AXES, from_own_axes, own_axes_angles, pose, rotation_about
from identification.kinematics.parameters import REVOLUTE
from identification.kinematics.spatial import ALIGNED, SpatialChain

Numbers = Mapping[str, float]  # parameter name -> value [mm, rad]; what is not there is zero


def corrected(chain: SpatialChain, values: Numbers) -> SpatialChain:
    """The chain whose nominal geometry is this one's with its errors."""
    joints = []
    for j, joint in enumerate(chain.joints, start=1):
        shift, turn = _six(values, "translation_", "rotation_", f":{j}")
        offset = values.get(f"joint_offset:{j}", 0.0)
        zero = (
            pose(rotation=rotation_about(joint.axis, offset)) if joint.type == REVOLUTE else pose(joint.axis * offset)
        )
        joints.append(replace(joint, origin=np.asarray(joint.origin @ pose(shift, turn) @ zero)))
    return replace(standing_in(chain, values), joints=tuple(joints))


def standing_in(chain: SpatialChain, values: Numbers) -> SpatialChain:
    """The chain with base and measured points or frames where its errors bring them; its joints as they are."""
    tools, axes = composed_tools(chain, values), composed_axes(chain, values)
    return replace(chain, base=composed_base(chain, values), tools=tools, tool_axes=axes)


def composed_base(chain: SpatialChain, values: Numbers) -> Array:
    """(4, 4) pose of the base in the frame of the instrument [mm]."""
    shift, turn = _six(values, "base.", "base.r", "")
    return pose(chain.base[:3, 3] + shift, chain.base[:3, :3] @ turn)


def composed_tools(chain: SpatialChain, values: Numbers) -> dict[str, Array]:
    """Name of each measured point -> (3,) its place in the tip's frame [mm]."""
    return {name: np.asarray(place) + _tool_error(values, name) for name, place in chain.tools.items()}


def composed_axes(chain: SpatialChain, values: Numbers) -> dict[str, Array]:
    """Name of each measured frame -> (3, 3) its axes in the tip's frame; where only points are measured as they are."""
    if chain.angle_scale is None:
        return dict(chain.tool_axes)
    return {name: chain.tool_axes.get(name, np.eye(3)) @ _tool_turn(values, name) for name in chain.tools}


def errors_between(chain: SpatialChain, other: SpatialChain) -> dict[str, float]:
    """Small errors of a chain that bring its base, joints and measured points to those of another, to first order; the
    shift of the base along its own axes."""
    named = _named(chain.base, other.base, "base.", "base.r", "")
    for j, (joint, moved) in enumerate(zip(chain.joints, other.joints, strict=True), start=1):
        errors = _named(joint.origin, moved.origin, "translation_", "rotation_", f":{j}")
        name = "rotation" if joint.type == REVOLUTE else "translation"
        along = [errors[f"{name}_{axis}:{j}"] for axis in AXES]
        about_axis = max(abs(joint.axis)) >= ALIGNED  # else all six are parameters
        named |= {**errors, f"joint_offset:{j}": float(joint.axis @ along) if about_axis else 0.0}
    for name, place in chain.tools.items():
        axes, moved_axes = (each.tool_axes.get(name, np.eye(3)) for each in (chain, other))
        turned = _named(pose(rotation=axes), pose(rotation=moved_axes), "", f"tool[{name}].r", "")
        shift = np.subtract(other.tools[name], place).tolist()
        named |= turned | {f"tool[{name}].{axis}": float(x) for axis, x in zip(AXES, shift, strict=True)}
    return named


def _named(frame: Array, other: Array, translation: str, rotation: str, suffix: str) -> dict[str, float]:
    """The six errors of a frame (4, 4) that make it another."""
    relative: Array = np.linalg.inv(frame) @ other
    shifts = {f"{translation}{axis}{suffix}": float(x) for axis, x in zip(AXES, relative[:3, 3], strict=True)}
    angles = own_axes_angles(relative[:3, :3])
    return shifts | {f"{rotation}{axis}{suffix}": float(x) for axis, x in zip(AXES, angles, strict=True)}


def before_errors(
    chain: SpatialChain,
    values: Numbers,
    base: Array | None,
    tools: Mapping[str, Array],
    axes: Mapping[str, Array] = MappingProxyType({}),
) -> SpatialChain:
    """The chain of which the errors make these: the reverse of `standing_in`.

    base : (4, 4) or None: as it is;  tools, axes : those of these names, the others as they are
    """
    if base is not None:
        shift, turn = _six(values, "base.", "base.r", "")
        chain = replace(chain, base=pose(base[:3, 3] - shift, base[:3, :3] @ turn.T))
    if tools:
        chain = replace(chain, tools={name: place - _tool_error(values, name) for name, place in tools.items()})
    if axes:
        chain = replace(chain, tool_axes={name: frame @ _tool_turn(values, name).T for name, frame in axes.items()})
    return chain


def _six(values: Numbers, translation: str, rotation: str, suffix: str) -> tuple[Array, Array]:
    """(3,) translation and (3, 3) rotation of six errors."""
    shift = np.array([values.get(f"{translation}{axis}{suffix}", 0.0) for axis in AXES])
    return shift, from_own_axes(*(values.get(f"{rotation}{axis}{suffix}", 0.0) for axis in AXES))


def _tool_error(values: Numbers, name: str) -> Array:
    return np.array([values.get(f"tool[{name}].{axis}", 0.0) for axis in AXES])


def _tool_turn(values: Numbers, name: str) -> Array:
    return _six(values, "", f"tool[{name}].r", "")[1]
