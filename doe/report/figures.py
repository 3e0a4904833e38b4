"""Pictures of plans and certificates (matplotlib figures; the caller shows or saves them)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from doe.problem.model import PRISMATIC
from doe.problem.problem import DesignProblem
from doe.report.scene import side, simplified, trackers
from identification import Arm, Array, design_model

BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"
LINK, CELL, SIGHT = "#a9bccb", "#cdbfa8", "#2f8f5b"  # as in page.css
DRAWN = 6000  # triangles of all bodies
PLANE = "xy"


# -- plans -------------------------------------------------------------------------------------------------------------
def plan_figure(arm: Arm, postures: Array) -> Figure:
    """The postures of an arm as stick figures, of very many some, and every joint's angles within its limits."""
    most = min(len(postures), 500)  # more stick figures only cover each other
    shown = postures[np.linspace(0, len(postures) - 1, most).round().astype(int)]
    count = f"{len(postures)} postures" if len(shown) == len(postures) else f"{len(shown)} of {len(postures)} postures"
    if arm.chain.projection:
        figure = Figure(figsize=(10.0, 8.6))
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[2.2, 1.0]))
        up, around = side(arm)
        for k, view in enumerate(((up, around), (up, around + 90.0)), start=1):
            axes: Any = top.add_subplot(1, 2, k, projection="3d")
            axes.view_init(*view)
            draw_arm(axes, arm, shown)
            if arm.cell is not None:
                draw_bodies(axes, arm, shown[0])
            # of the arm: a tracker may be far from it
            limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
            axes.set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
            draw_constraints(axes, arm)
            axes.tick_params(labelsize=7)
            axes.locator_params(nbins=4)
            axes.set_box_aspect(limits[:, 1] - limits[:, 0], zoom=1.1)  # the same scale on all axes
        first = "" if arm.cell is None else "; bodies as in the first"
        top.subplots_adjust(left=0.09, right=0.9, bottom=0.06, top=0.94, wspace=0.3)
        top.suptitle(f"{count}, from two sides; light to dark in order of measurement{first}", fontsize=9)
        bottom.subplots_adjust(left=0.06, right=0.97, bottom=0.2)
        draw_joints(bottom.subplots(), arm, postures)
        return figure
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    plane, joints = figure.subplots(1, 2, width_ratios=[1.0, 1.1])
    draw_arm(plane, arm, shown)
    plane.set_title(count, fontsize=9)
    draw_constraints(plane, arm)
    draw_joints(joints, arm, postures)
    return figure


def draw_joints(joints: Axes, arm: Arm, postures: Array) -> None:
    """Every joint's angles within its limits; of sliding joints where they are between them."""
    types, colors = design_model(arm).joint_types, run_colors(len(postures))
    for j, kind in enumerate(types):
        factor = 1.0 if kind == PRISMATIC else np.degrees(1.0)
        limits = [factor * arm.lower[j], factor * arm.upper[j]]
        joints.plot(limits, [j, j], color=LIMIT, lw=6, alpha=0.35, solid_capstyle="butt")
        joints.scatter(factor * postures[:, j], np.full(len(postures), j), c=colors, s=26, zorder=3, lw=0)
    joints.set(yticks=range(arm.links), yticklabels=[f"$q_{j + 1}$" for j in range(arm.links)])
    joints.set_xlabel(" or ".join(sorted({"position [mm]" if kind == PRISMATIC else "angle [deg]" for kind in types})))
    joints.set_title("angles within the joint limits, light to dark in order of measurement", fontsize=9)
    joints.invert_yaxis()


def run_colors(m: int) -> Array:
    """(m, 4) colours from the first run (light) to the last (dark)."""
    return np.asarray(colormaps["viridis_r"](np.linspace(0.1, 1.0, m)))


def draw_arm(axes: Any, arm: Arm, postures: Array) -> None:
    """Stick figures of the arm as it is best known, in the frame of its base; axes : in a plane or in space, as it"""
    for line, color in zip(design_model(arm).points(postures), run_colors(len(postures)), strict=True):
        axes.plot(*line.T, color=color, lw=1.2, alpha=0.75)
        axes.plot(*line[-1:].T, "o", color=color, ms=3)
    axes.plot(*np.zeros((arm.dimension, 1)), "ks", ms=6)
    axes.set(aspect="auto" if arm.chain.projection else "equal")
    axes.set(**{f"{axis}label": f"{axis} [mm]" for axis in arm.chain.axes})


def draw_constraints(axes: Any, arm: Arm) -> None:
    """Workspace boxes, what to keep out of, the tracker and its cone; in space as far as the axes reach."""
    cut = {} if arm.dimension == len(PLANE) else {"axlim_clip": True}
    for line, forbidden in outlines(arm):
        color = BEFORE if forbidden else LIMIT
        dense = np.concatenate([np.linspace(start, end, 20) for start, end in pairwise(line)])
        axes.plot(*dense.T, color=color, lw=0.8, ls="--", **cut)
        if forbidden and not cut:
            axes.fill(*line.T, color=color, alpha=0.25, lw=0)
    for tracker in (one.tracker for one in arm.constraints if hasattr(one, "tracker")):
        axes.plot(*np.array([tracker]).T, "k^", ms=6, **cut)


def draw_bodies(axes: Any, arm: Arm, posture: Array) -> None:
    """The bodies of a cell with the arm at a posture (n,), lit from the viewer; the edge of the floor, and the lines of
    sight from trackers."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    assert arm.cell is not None
    frames = np.concatenate([np.eye(4)[None], design_model(arm).joint_frames(posture[None])[0]])
    elevation, azimuth = np.radians([axes.elev, axes.azim])
    viewer = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    corners, colors = [np.empty((0, 3, 3))], [np.empty((0, 3))]
    for body in (one for one in arm.cell.bodies if len(one.looks())):
        vertices, faces = simplified(body.looks(), DRAWN // len(arm.cell.bodies))
        corners.append((vertices @ frames[body.joint, :3, :3].T + frames[body.joint, :3, 3])[faces.astype(int)])
        normals = np.cross(corners[-1][:, 1] - corners[-1][:, 0], corners[-1][:, 2] - corners[-1][:, 0])
        lit = np.abs(normals @ viewer) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        colors.append((0.5 + 0.5 * lit)[:, None] * to_rgb(LINK if body.joint else CELL))
    paint, floor = np.concatenate(colors), arm.cell.floor
    if len(paint):
        axes.add_collection3d(Poly3DCollection(np.concatenate(corners), facecolors=paint, edgecolors=paint, lw=0.3))
    within = [*(each.reshape(-1, 3) for each in corners), frames[:, :3, 3], np.array([[0.0, 0.0, floor or 0.0]])]
    axes.auto_scale_xyz(*np.concatenate(within).T, had_data=True)
    axes.autoscale(False)
    if floor is not None:
        (left, right), (near, far) = axes.get_xlim(), axes.get_ylim()
        axes.plot([left, right, right, left, left], [near, near, far, far, near], floor, color=CELL, lw=1.0)
    for tracker in trackers(arm):
        axes.plot(*np.linspace(np.array(tracker), frames[-1, :3, 3], 50).T, color=SIGHT, lw=0.8, axlim_clip=True)


def outlines(arm: Arm) -> list[tuple[Array, bool]]:
    """Lines (k, d) of what constrains an arm, and whether it keeps out of them: boxes, circles, spheres, cylinders, the
    tracker's cone."""
    return [(line, one.forbidden) for one in arm.constraints for line in one.outlines(arm.dimension)]


def certificate_figure(problem: DesignProblem, postures: Array, samples: int = 1000, steps: int = 41) -> Figure:
    """The equivalence theorem seen along each joint: the largest d(q) at each value, which must not exceed p.

    For every active joint the value is held at `steps` values while the other joints take `samples` random values,
    corners of their limits and the plan's own, as far as constraints allow; the line is the largest d found. A plan is
    optimal where the line touches p and never crosses it.
    """
    active, generator = problem.active_joints, np.random.default_rng(0)
    figure = Figure(figsize=(10.0, 2.9), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(active), sharey=True))
    prior = problem.prior.per_new_run(len(postures))
    gradient = problem.criterion.gradient(problem.information(postures))
    cloud = generator.uniform(problem.lower, problem.upper, (samples, problem.joints))
    upper = generator.integers(0, 2, (min(samples, 4 * 2 ** len(active)), problem.joints)) == 1
    others = np.concatenate([cloud, np.where(upper, problem.upper, problem.lower), postures])

    def d(somewhere: Array) -> Array:
        return prior.sensitivities(problem.scaled_jacobians(somewhere), gradient)

    at_plan = d(postures)
    for axis, joint in zip(axes, active, strict=True):
        sliding = problem.model.joint_types[joint] == PRISMATIC
        unit, factor = ("mm", 1.0) if sliding else ("deg", np.degrees(1.0))
        values, largest = np.linspace(problem.lower[joint], problem.upper[joint], steps), []
        for value in values:
            held = others.copy()
            held[:, joint] = value
            largest.append(d(held[problem.feasible(held)]).max(initial=0.0))
        axis.plot(factor * values, largest, color=AFTER)
        axis.plot(factor * postures[:, joint], at_plan, ".", color="k", ms=5)
        axis.axhline(problem.parameters, color=BEFORE, lw=1, ls="--")
        axis.set(xlabel=f"$q_{joint + 1}$ [{unit}]")
        axis.margins(y=0.12)
    axes[0].set_ylabel("largest d(q), dashed: p")
    return figure
