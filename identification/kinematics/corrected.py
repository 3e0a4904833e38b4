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
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.errors import InputError
from identification.kinematics.chain import BASE, STANDARD, TOOL, DHRow, Joint, KinematicChain, Numbers
from identification.kinematics.counting import Counting
from identification.kinematics.frames import (
    X,
    Y,
    Z,
    displacement,
    point_table,
    pose,
    pose_table,
    roll_pitch_yaw,
    rotation_about,
    tool_tables,
)
from identification.kinematics.parameters import JOINT_OFFSET, REVOLUTE, error_names


def _moved(joint: Joint, q: float) -> Array:
    """(4, 4) motion of a joint by q [rad, mm]."""
    return pose(rotation=rotation_about(joint.axis, q)) if joint.type == REVOLUTE else pose(joint.axis * q)


def corrected(chain: KinematicChain, values: Numbers) -> KinematicChain:
    """The chain whose nominal geometry is this one's with its errors."""
    joints = []
    for j, joint in enumerate(chain.joints, start=1):
        zero = _moved(joint, values.get(f"{JOINT_OFFSET}:{j}", 0.0))
        joints.append(replace(joint, origin=joint.origin @ pose(*displacement(values, error_names(j))) @ zero))
    return replace(standing_in(chain, values), joints=tuple(joints))


def standing_in(chain: KinematicChain, values: Numbers, back: bool = False) -> KinematicChain:
    """The chain with base and measured points or frames where their errors bring them, or `back` from there; its joints
    as they are."""

    def moved(frame: str, place: Array, turn: Array) -> tuple[Array, Array]:
        shift, rotation = displacement(values, error_names(frame))
        return (place - shift, turn @ rotation.T) if back else (place + shift, turn @ rotation)

    base = pose(*moved(BASE, chain.base[:3, 3], chain.base[:3, :3]))
    axes = {name: chain.tool_axes.get(name, np.eye(3)) for name in chain.tools}
    frames = {name: moved(f"tool[{name}]", np.asarray(place), axes[name]) for name, place in chain.tools.items()}
    tools = {name: place for name, (place, _) in frames.items()}
    axes = dict(chain.tool_axes) if chain.angle_scale is None else {name: turn for name, (_, turn) in frames.items()}
    return replace(chain, base=base, tools=tools, tool_axes=axes)


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
    def places(self) -> dict[str, Any]:
        """`base`, `tools` and `tool_axes` of a `Calibration`: those that were to be found."""
        tools = {} if TOOL in self.chain.settled else dict(self.real.tools)
        axes = dict(self.real.tool_axes) if self.chain.angle_scale is not None and tools else {}
        return {"base": None if BASE in self.chain.settled else self.real.base, "tools": tools, "tool_axes": axes}

    def to_json(self) -> dict[str, Any]:
        """Keys of `identify` for spatial arms (identification/files/README.md, "JSON keys")."""
        n, offsets = len(self.chain), []
        shares = np.eye(n) if self.counting is None else self.counting.matrix
        for j, kind in enumerate(self.chain.joint_types, start=1):
            # what the joint adds to a command, and what a controller has to add to its own, as it counts
            value = float(shares[j - 1] @ [self.values.get(f"{JOINT_OFFSET}:{i}", 0.0) for i in range(1, n + 1)])
            value, unit = (float(np.degrees(value)), "deg") if kind == REVOLUTE else (value, "mm")
            offsets.append({"joint": j, "unit": unit, "value": value, "command": 0.0 - value})
        return {**self.tables(), "joint_offsets": offsets}

    def tables(self) -> dict[str, Any]:
        """The keys `base`, `tools` and `geometry` of these."""
        rows = []
        for j, joint in enumerate(self.chain.joints, start=1):
            origin = self.origin(j)  # its angles the nearest to those drawn of all that make the same rotation
            turn = roll_pitch_yaw(origin[:3, :3], near=roll_pitch_yaw(joint.origin[:3, :3]))
            angles = zip(("roll_deg", "pitch_deg", "yaw_deg"), np.degrees(turn).tolist(), strict=True)
            rows.append({"joint": j, "name": joint.name, **point_table(origin[:3, 3]), **dict(angles)})
        base, tools, axes = self.places.values()
        base = None if base is None else pose_table(base)
        return {"base": base, "tools": tool_tables(tools, axes), "geometry": rows}

    def origin(self, j: int) -> Array:
        """(4, 4) pose of the frame of a joint, counted from 1, in that of the joint before, its offset apart [mm]."""
        offset = self.values.get(f"{JOINT_OFFSET}:{j}", 0.0)
        return self.real.joints[j - 1].origin @ _moved(self.chain.joints[j - 1], -offset)


class Link(NamedTuple):
    """Rz(theta) Tz(d) Tx(a) Rx(alpha) Ry(beta) from the axis of a joint to the next [rad, mm]; beta None: axes are not
    parallel."""

    theta: float
    d: float
    a: float
    alpha: float
    beta: float | None = None


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


def corrected_links(chain: KinematicChain, drawn: Sequence[Link]) -> tuple[tuple[Link, ...], Array, Array]:
    """The n - 1 links of a chain of n revolute joints about their z axes (as `corrected`), nearest to those drawn; the
    pose (4, 4) of the first axis's frame in that of the base, and of the tip's in that of the last axis.

    By the common normal of two axes; where they are drawn parallel by the point in which the second axis meets the
    plane of d as drawn.
    """
    *places, tip = np.array(list(accumulate([joint.origin for joint in chain.joints] + [chain.end], np.matmul)))
    first = frame = places[0]
    links = list[Link]()
    for link, following in zip(drawn, places[1:], strict=True):
        z, w, away, d = frame[:3, 2], following[:3, 2], following[:3, 3] - frame[:3, 3], link.d
        parallel = link.beta is not None
        away = away - d * z if parallel else away
        away = away - w * float(away @ z) / float(w @ z) if parallel else away
        normal = away if parallel else np.cross(z, w)
        normal = normal / np.linalg.norm(normal)
        normal = normal if normal @ (frame[:3, :3] @ rotation_about(Z, link.theta) @ X) >= 0.0 else -normal
        x, y, _ = frame[:3, :3].T @ normal
        theta, alpha = np.arctan2(y, x), float(np.arctan2(-np.cross(z, normal) @ w, z @ w))
        beta = float(np.arcsin(np.clip(normal @ w, -1.0, 1.0))) if parallel else None
        d = d if parallel else float(np.cross(away, w) @ normal / np.sin(alpha))
        between = Link(_near(theta, link.theta), d, float(away @ normal), _near(alpha, link.alpha), beta)
        if not links:  # where the first frame stands on its axis is free: theta and d as drawn
            frame = frame @ pose((0.0, 0.0, between.d - link.d), rotation_about(Z, between.theta - link.theta))
            between, first = between._replace(theta=link.theta, d=link.d), frame
        tilt = rotation_about(X, between.alpha) @ rotation_about(Y, between.beta or 0.0)
        frame = frame @ pose(rotation=rotation_about(Z, between.theta)) @ pose((between.a, 0.0, between.d), tilt)
        links.append(between)
    return tuple(links), first, np.linalg.inv(frame) @ tip


def _near(angle: float, drawn: float) -> float:
    return float(angle) - 2.0 * np.pi * round((float(angle) - drawn) / (2.0 * np.pi))
