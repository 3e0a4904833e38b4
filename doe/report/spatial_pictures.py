"""Pictures of spatial arms: skeletons from two sides, what constrains them, the tracker and what it sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from doe.problem.spatial_constraints import circle_across
from identification.arm import Arm
from identification.arrays import Array
from identification.model import Model
from identification.workspace import KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox

SIDES = ((22.0, -60.0), (22.0, 30.0))  # [deg] elevation and azimuth of the two views
TICKS = 4  # of an axis, at most
RING = np.linspace(0.0, 2.0 * np.pi, 49)
FORBIDDEN, SEEN = "#c44e52", "#888888"


def draw_spatial_plan(figure: Any, arm: Arm, postures: Array, colors: Array, said: str) -> list[Axes]:
    """The arm's skeletons at postures (m, n), from two sides, in the frame of its base.

    said : of how many postures, in the title
    """
    drawn = [figure.add_subplot(1, len(SIDES), k + 1, projection="3d") for k in range(len(SIDES))]
    for axes, side in zip(drawn, SIDES, strict=True):
        draw_side(axes, arm, postures, colors, side)
    figure.subplots_adjust(left=0.03, right=0.93, bottom=0.06, top=0.94, wspace=0.3)
    figure.suptitle(f"{said}, from two sides; light to dark in order of measurement", fontsize=9)
    return drawn


def draw_side(
    axes: Any, arm: Arm, postures: Array, colors: Array, side: tuple[float, float] = SIDES[0], zoom: float = 1.0
) -> None:
    """The skeletons and what constrains them, from one side.

    zoom : of the box in its place, whose sides have the same scale
    """
    for line, color in zip(Model(arm).points(postures), colors, strict=True):
        axes.plot(*line.T, color=color, lw=1.1, alpha=0.75)
        axes.plot(*line[-1:].T, "o", color=color, ms=3)
    axes.plot([0], [0], [0], "ks", ms=6)
    for outline, color in outlines(arm):
        axes.plot(*outline.T, color=color, lw=0.8)
    for constraint in arm.constraints:
        if isinstance(constraint, LineOfSight):
            axes.plot(*np.array([constraint.tracker]).T, "k^", ms=6)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.tick_params(labelsize=7)
    for one in (axes.xaxis, axes.yaxis, axes.zaxis):
        one.set_major_locator(MaxNLocator(TICKS))
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    axes.set_box_aspect(limits[:, 1] - limits[:, 0], zoom=zoom)
    axes.view_init(*side)


def outlines(arm: Arm) -> list[tuple[Array, str]]:
    """Lines (k, 3) and colors of boxes, spheres, cylinders and the tracker's cone."""
    found = []
    for constraint in arm.constraints:
        if isinstance(constraint, WorkspaceBox):
            found += [(edge, SEEN) for edge in _box(constraint)]
        elif isinstance(constraint, KeepOutCircle):
            center, axes = np.array(constraint.center), np.eye(3)
            found += [(center + constraint.radius * _ring(axis), FORBIDDEN) for axis in axes]
        elif isinstance(constraint, KeepOutCylinder):
            found += [(line, FORBIDDEN) for line in _cylinder(constraint)]
        elif isinstance(constraint, LineOfSight):
            found += [(line, SEEN) for line in _cone(constraint)]
    return found


def _ring(axis: Array) -> Array:
    """(49, 3) unit circle around an axis."""
    one, other = circle_across(axis)
    return np.asarray(np.cos(RING)[:, None] * one + np.sin(RING)[:, None] * other)


def _cylinder(cylinder: KeepOutCylinder) -> list[Array]:
    """Both ends, and lines from one to the other."""
    ends = np.array([cylinder.start, cylinder.end])
    rings = [end + cylinder.radius * _ring(ends[1] - ends[0]) for end in ends]
    return [*rings, *(np.array(pair) for pair in zip(rings[0][::12], rings[1][::12], strict=True))]


def _box(box: WorkspaceBox) -> list[Array]:
    """The twelve edges; without limits of height the floor's four."""
    low, high = box.z or (0.0, 0.0)
    corners = np.array([(box.x[i], box.y[j]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))])
    floors = [np.column_stack([corners, np.full(5, height)]) for height in {low, high}]
    return [*floors, *(np.array([(x, y, low), (x, y, high)]) for x, y in corners[:4])]


def _cone(sight: LineOfSight) -> list[Array]:
    """Its end, as far as the tracker reaches or as the arm is, and four lines from the tracker to it."""
    tracker = np.array(sight.tracker)
    axis = np.array(sight.toward) - tracker
    length = float(np.linalg.norm(axis)) * 1.2 if sight.reach is None else sight.reach[1]
    unit = axis / np.linalg.norm(axis)
    end = tracker + length * (np.cos(sight.half_angle) * unit + np.sin(sight.half_angle) * _ring(axis))
    return [end, *(np.stack([tracker, place]) for place in end[:-1:12])]
