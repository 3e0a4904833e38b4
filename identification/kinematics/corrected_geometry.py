"""An identified spatial arm for people and controllers: base, tools, a table of the joints, their offsets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from identification.arrays import Array
from identification.kinematics.corrected import composed_axes, composed_base, composed_tools, corrected
from identification.kinematics.counting import Counting
from identification.kinematics.frames import point_table, pose, pose_table, roll_pitch_yaw, rotation_about, tool_tables
from identification.kinematics.parameters import JOINT_OFFSET, REVOLUTE
from identification.kinematics.spatial import BASE, TOOL, SpatialChain

PARALLEL = 1e-12  # sine of an angle between axes that are parallel but for rounding


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

    chain: SpatialChain
    values: Mapping[str, float]
    counting: Counting | None = None

    @cached_property
    def real(self) -> SpatialChain:
        """The chain whose nominal geometry is the corrected one."""
        return corrected(self.chain, self.values)

    @property
    def base(self) -> Array | None:
        """(4, 4) pose of the base for the instrument [mm], None where it is known."""
        return None if BASE in self.chain.known else composed_base(self.chain, self.values)

    @property
    def tools(self) -> dict[str, Array]:
        """Name -> (3,) place of each measured point in the frame of the tip [mm], empty where they are known."""
        return {} if TOOL in self.chain.known else composed_tools(self.chain, self.values)

    @property
    def tool_axes(self) -> dict[str, Array]:
        """Name -> (3, 3) axes of each measured frame in the frame of the tip, empty where only points are measured or
        they are known."""
        measured = self.chain.angle_scale is not None and TOOL not in self.chain.known
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
            if (sine := float(np.linalg.norm(cross))) > PARALLEL:
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
