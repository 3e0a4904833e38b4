"""Where an arm may move: constraints on its postures. Plain data, in millimetres and radians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class WorkspaceBox:
    """The tip stays inside `x`, `y` and, in space, `z` [mm]."""

    x: tuple[float, float]
    y: tuple[float, float]
    z: tuple[float, float] | None = None


@dataclass(frozen=True)
class KeepOutCircle:
    """Every link stays outside the circle, in space the sphere [mm]."""

    center: tuple[float, ...]
    radius: float


@dataclass(frozen=True)
class KeepOutCylinder:
    """Every link stays outside a cylinder with flat ends [mm]."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class LineOfSight:
    """The tracker sees the tip: inside its cone, nothing of the arm between; in space in its range and from in front.

    reach : smallest and largest distance [mm];  facing : direction of the reflector in the frame of the tip
    acceptance : [rad] largest angle between that direction and the one to the tracker
    """

    tracker: tuple[float, ...]  # [mm]
    half_angle: float  # [rad]
    toward: tuple[float, ...]  # [mm] a point on the cone's axis
    reach: tuple[float, float] | None = None
    facing: tuple[float, float, float] | None = None
    acceptance: float = float(np.pi / 2.0)


Constraint = WorkspaceBox | KeepOutCircle | KeepOutCylinder | LineOfSight
