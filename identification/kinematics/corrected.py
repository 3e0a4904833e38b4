"""A chain with its errors composed into it: where base, tools and joints really are, for people and controllers: a
table of the joints, their offsets, and a Denavit-Hartenberg table.

Between axes that the drawing has parallel the common normal stands anywhere, and the strict table explodes. There d
stays as drawn, the next origin is where the next axis meets the plane of that d, and a turn beta about the new y axis
follows alpha (S. A. Hayati, "Robot arm geometric link parameter estimation", CDC 1983):

    Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)

What is before the first axis is the base, what is behind the last axis the tip: there the table stays as drawn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.chain import ALIGNED, BASE, STANDARD, TOOL, DHRow, KinematicChain, X, Z
from identification.kinematics.counting import Counting
from identification.kinematics.frames import (
    AXES,
    from_own_axes,
    own_axes_angles,
    point_table,
    pose,
    pose_table,
    roll_pitch_yaw,
    rotation_about,
    tool_tables,
)
from identification.kinematics.parameters import JOINT_OFFSET, REVOLUTE

Numbers = Mapping[str, float]  # parameter name -> value [mm, rad]; what is not there is zero


def corrected(chain: KinematicChain, values: Numbers) -> KinematicChain:
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


def standing_in(chain: KinematicChain, values: Numbers) -> KinematicChain:
    """The chain with base and measured points or frames where its errors bring them; its joints as they are."""
    tools, axes = composed_tools(chain, values), composed_axes(chain, values)
    return replace(chain, base=composed_base(chain, values), tools=tools, tool_axes=axes)


def composed_base(chain: KinematicChain, values: Numbers) -> Array:
    """(4, 4) pose of the base in the frame of the instrument [mm]."""
    shift, turn = _six(values, "base.", "base.r", "")
    return pose(chain.base[:3, 3] + shift, chain.base[:3, :3] @ turn)


def composed_tools(chain: KinematicChain, values: Numbers) -> dict[str, Array]:
    """Name of each measured point -> (3,) its place in the tip's frame [mm]."""
    return {name: np.asarray(place) + _tool_error(values, name) for name, place in chain.tools.items()}


def composed_axes(chain: KinematicChain, values: Numbers) -> dict[str, Array]:
    """Name of each measured frame -> (3, 3) its axes in the tip's frame; where only points are measured as they are."""
    if chain.angle_scale is None:
        return dict(chain.tool_axes)
    return {name: chain.tool_axes.get(name, np.eye(3)) @ _tool_turn(values, name) for name in chain.tools}


def errors_between(chain: KinematicChain, other: KinematicChain) -> dict[str, float]:
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
    chain: KinematicChain,
    values: Numbers,
    base: Array | None,
    tools: Mapping[str, Array],
    axes: Mapping[str, Array] = MappingProxyType({}),
) -> KinematicChain:
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


class CommonNormal(NamedTuple):
    """Of the axes of a joint, counted from 1, and the next: the angle between them [rad], and how far from the two
    joints' frames it stands along their axes [mm]."""

    joint: int
    angle: float
    distance: float


@dataclass(frozen=True)
class CorrectedGeometry:
    """A chain with the errors that were found.

    chain : as nominal;  values : parameter name -> value [mm, rad];  counting : of the controller, None: as the chain's
    """

    chain: KinematicChain
    values: Mapping[str, float]
    counting: Counting | None = None

    @cached_property
    def real(self) -> KinematicChain:
        """The chain whose nominal geometry is the corrected one."""
        return corrected(self.chain, self.values)

    @property
    def base(self) -> Array | None:
        """(4, 4) pose of the base for the instrument [mm], None where it is known."""
        return None if BASE in self.chain.settled else composed_base(self.chain, self.values)

    @property
    def tools(self) -> dict[str, Array]:
        """Name -> (3,) place of each measured point in the frame of the tip [mm], empty where they are known."""
        return {} if TOOL in self.chain.settled else composed_tools(self.chain, self.values)

    @property
    def tool_axes(self) -> dict[str, Array]:
        """Name -> (3, 3) axes of each measured frame in the frame of the tip, empty where only points are measured or
        they are known."""
        measured = self.chain.angle_scale is not None and TOOL not in self.chain.settled
        return composed_axes(self.chain, self.values) if measured else {}

    @property
    def common_normals(self) -> list[CommonNormal]:
        """Of successive axes of revolute joints that are not exactly parallel, in the corrected geometry."""
        normals, frame = [], np.eye(4)
        axes: list[tuple[Array, Array] | None] = []
        for joint in self.real.joints:
            frame = frame @ joint.origin
            axes.append((frame[:3, 3], frame[:3, :3] @ joint.axis) if joint.type == REVOLUTE else None)
        for j, (one, other) in enumerate(pairwise(axes), start=1):
            if one is None or other is None:
                continue
            cross, between = np.cross(one[1], other[1]), other[0] - one[0]
            if (sine := float(np.linalg.norm(cross))) > 1e-12:  # else parallel but for rounding
                feet = [float(np.cross(between, axis) @ cross) / sine**2 for axis in (other[1], one[1])]
                angle = float(np.arctan2(sine, abs(one[1] @ other[1])))
                normals.append(CommonNormal(j, angle, max(map(abs, feet))))
        return normals

    @property
    def strict_table(self) -> list[str]:
        """Why a Denavit-Hartenberg table of the corrected geometry is of no use, in sentences; empty: it is."""
        return [
            f"the axes of joints {j} and {j + 1} are {np.degrees(angle):.2g} deg from parallel and their common normal "
            f"{distance / 1000.0:.3g} m away: a strict Denavit-Hartenberg table would have it as d; "
            "use this table of six numbers, or the URDF"
            for j, angle, distance in self.common_normals
            if distance > self.chain.reach
        ]

    def to_json(self) -> dict[str, Any]:
        """Keys of `identify` for spatial arms (identification/files/README.md, "JSON keys")."""
        return {
            **self.tables(),
            "joint_offsets": [self._offset(j) for j in range(1, len(self.chain) + 1)],
            "strict_table": self.strict_table,
        }

    def tables(self) -> dict[str, Any]:
        """The keys `base`, `tools` and `geometry` of these."""
        return {
            "base": None if self.base is None else pose_table(self.base),
            "tools": tool_tables(self.tools, self.tool_axes),
            "geometry": [self._row(j) for j in range(1, len(self.chain) + 1)],
        }

    def origin(self, j: int) -> Array:
        """(4, 4) pose of the frame of a joint, counted from 1, in that of the joint before, its offset apart [mm]."""
        joint, offset = self.chain.joints[j - 1], self._offset_of(j)
        back = pose(rotation=rotation_about(joint.axis, -offset))
        return self.real.joints[j - 1].origin @ (back if joint.type == REVOLUTE else pose(-offset * joint.axis))

    def _row(self, j: int) -> dict[str, Any]:
        """That frame as numbers, its angles the nearest to those drawn of all that make the same rotation."""
        joint, origin = self.chain.joints[j - 1], self.origin(j)
        turn = roll_pitch_yaw(origin[:3, :3], near=roll_pitch_yaw(joint.origin[:3, :3]))
        angles = zip(("roll", "pitch", "yaw"), np.degrees(turn), strict=True)
        return {"joint": j, "name": joint.name, **point_table(origin[:3, 3])} | {
            f"{axis}_deg": float(angle) for axis, angle in angles
        }

    def _offset(self, j: int) -> dict[str, Any]:
        """What the joint adds to a command, and what a controller has to add to its own, as it counts."""
        turning, n = self.chain.joints[j - 1].type == REVOLUTE, len(self.chain)
        shares = np.eye(n) if self.counting is None else self.counting.matrix
        value = float(shares[j - 1] @ [self._offset_of(i) for i in range(1, n + 1)])
        value = float(np.degrees(value)) if turning else value
        return {"joint": j, "unit": "deg" if turning else "mm", "value": value, "command": 0.0 - value}

    def _offset_of(self, j: int) -> float:
        return self.values.get(f"{JOINT_OFFSET}:{j}", 0.0)


@dataclass(frozen=True)
class Link:
    """From the axis of a joint to the next: theta, alpha, beta [rad], d, a [mm]; beta None: axes are not parallel."""

    theta: float
    d: float
    a: float
    alpha: float
    beta: float | None = None

    @property
    def matrix(self) -> Array:
        """(4, 4) Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta)."""
        turn, tilt = (
            rotation_about(Z, self.theta),
            rotation_about(X, self.alpha) @ rotation_about([0.0, 1.0, 0.0], self.beta or 0.0),
        )
        return np.asarray(pose(rotation=turn) @ pose((self.a, 0.0, self.d), tilt))


@dataclass(frozen=True)
class CorrectedLinks:
    """The n - 1 links between n axes.

    first : (4, 4) pose of the first axis's frame in that of the base;  last : of the tip's in that of the last axis
    """

    links: tuple[Link, ...]
    first: Array
    last: Array


def drawn_links(rows: Sequence[DHRow], convention: str = STANDARD) -> tuple[Link, ...]:
    """The links between the axes of a table.

    Raises `InputError` for prismatic joints, whose axes have no place, and for successive axes that are one.
    """
    if any(row.type != REVOLUTE for row in rows):
        raise InputError("dh: found prismatic joints, allowed: a table of revolute joints")
    behind = rows[:-1] if convention == STANDARD else rows[1:]  # whose a and alpha lead to the next axis
    links = tuple(  # beta where the drawing has axes parallel
        Link(row.offset, row.d, after.a, after.alpha, 0.0 if abs(np.sin(after.alpha)) < 1e-6 else None)
        for row, after in zip(rows, behind, strict=False)
    )
    if any(link.beta is not None and link.a == 0.0 for link in links):
        raise InputError("dh: found successive joints with one axis, allowed: different axes")
    return links


def corrected_links(chain: KinematicChain, drawn: Sequence[Link]) -> CorrectedLinks:
    """The links of a chain of revolute joints about their z axes (as `corrected`), nearest to those drawn."""
    at, places = np.eye(4), []
    for joint in chain.joints:
        at = at @ joint.origin
        places.append(at)
    frame, links = places[0], []
    for k, link in enumerate(drawn):
        next_place = places[k + 1]
        between = _parallel(frame, next_place, link) if link.beta is not None else _skew(frame, next_place, link)
        if k == 0:  # where the first frame stands on its axis is free: theta and d as drawn
            frame = frame @ pose((0.0, 0.0, between.d - link.d), rotation_about(Z, between.theta - link.theta))
            between = Link(link.theta, link.d, between.a, between.alpha, between.beta)
            first = frame
        frame = frame @ between.matrix
        links.append(between)
    return CorrectedLinks(tuple(links), first if links else places[0], np.linalg.inv(frame) @ at @ chain.end)


def _skew(frame: Array, following: Array, drawn: Link) -> Link:
    """By the common normal of two axes, the z axes of both frames (4, 4)."""
    z, w, between = frame[:3, 2], following[:3, 2], following[:3, 3] - frame[:3, 3]
    normal = np.cross(z, w)
    normal = normal / np.linalg.norm(normal)
    wanted = frame[:3, :3] @ rotation_about(Z, drawn.theta) @ X
    normal = normal if normal @ wanted >= 0.0 else -normal
    alpha = float(np.arctan2(np.cross(z, w) @ normal, z @ w))
    d = float(np.cross(between, w) @ normal / np.sin(alpha))
    return Link(_angle(frame, normal, drawn.theta), d, float(between @ normal), _near(alpha, drawn.alpha))


def _parallel(frame: Array, following: Array, drawn: Link) -> Link:
    """By the point in which the second axis meets the plane of d as drawn."""
    z, w, start = frame[:3, 2], following[:3, 2], frame[:3, 3] + drawn.d * frame[:3, 2]
    point = following[:3, 3] + w * float((start - following[:3, 3]) @ z) / float(w @ z)
    away = point - start
    wanted = frame[:3, :3] @ rotation_about(Z, drawn.theta) @ X
    normal = away / np.linalg.norm(away)
    normal = normal if normal @ wanted >= 0.0 else -normal
    alpha = float(np.arctan2(-np.cross(z, normal) @ w, z @ w))
    beta = float(np.arcsin(np.clip(normal @ w, -1.0, 1.0)))
    return Link(_angle(frame, normal, drawn.theta), drawn.d, float(away @ normal), _near(alpha, drawn.alpha), beta)


def _angle(frame: Array, normal: Array, drawn: float) -> float:
    """Of a normal about the frame's z axis, nearest to that drawn [rad]."""
    x, y, _ = frame[:3, :3].T @ normal
    return _near(float(np.arctan2(y, x)), drawn)


def _near(angle: float, drawn: float) -> float:
    return angle - 2.0 * np.pi * round((angle - drawn) / (2.0 * np.pi))
