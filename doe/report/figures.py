"""Pictures of plans and certificates (matplotlib figures; the caller shows or saves them); and an arm in space as
scene.js draws it: its chain, the bodies of its cell, trackers, and measured errors as arrows."""

from base64 import b64encode
from collections.abc import Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from numpy.typing import NDArray

from doe.bounds.certificate import sensitivity
from doe.problem.model import PRISMATIC
from doe.problem.problem import DesignProblem
from identification import Arm, Array, design_model

BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"
LINK, CELL, SIGHT = "#a9bccb", "#cdbfa8", "#2f8f5b"  # as in page.css
DRAWN = 6000  # triangles of all bodies
WHOLE = np.iinfo(np.uint16).max  # largest whole number of a vertex


# -- plans -------------------------------------------------------------------------------------------------------------
def plan_figure(arm: Arm, postures: Array) -> Figure:
    """The postures of an arm as stick figures, of so many that they hide each other 500, and every joint's angles."""
    shown = postures[np.linspace(0, len(postures) - 1, min(len(postures), 500)).round().astype(int)]
    count = f"{len(postures)} postures" if len(shown) == len(postures) else f"{len(shown)} of {len(postures)} postures"
    in_space, (up, around) = arm.chain.projection is not None, side(arm)
    seen = {"projection": arm.chain.projection, "elev": up}
    views = {"front": seen | {"azim": around}, "aside": seen | {"azim": around + 90.0}} if in_space else {"front": {}}
    # its margins know nothing of labels in space
    layout = ConstrainedLayoutEngine(rect=(0.03, 0.0, 0.94, 1.0), wspace=0.15 if in_space else 0.02)
    figure = Figure(figsize=(10.0, 8.6 if in_space else 4.6), layout=layout)
    axes: Any = figure.subplot_mosaic(
        [["front", "aside"], ["joints", "joints"]] if in_space else [["front", "joints"]],
        height_ratios=[2.6, 1.0] if in_space else None,
        per_subplot_kw=views,
    )
    for name in views:
        draw_arm(axes[name], arm, shown)
        if arm.cell is not None:
            draw_bodies(axes[name], arm, shown[0])
        if in_space:
            axes[name].tick_params(labelsize=7)
            # of the arm: a tracker may be far from it
            limits = np.array([axes[name].get_xlim(), axes[name].get_ylim(), axes[name].get_zlim()])
            axes[name].set(xlim=limits[0], ylim=limits[1], zlim=limits[2])
            sizes = limits[:, 1] - limits[:, 0]
            axes[name].set_box_aspect(sizes, zoom=0.95)  # the same scale on all axes
            for axis, size in zip("xyz", sizes.tolist(), strict=True):  # labels of a short one would overlap
                axes[name].locator_params(axis, nbins=max(round(5.0 * size / sizes.max()), 2))
            axes[name].zaxis.labelpad = 2.0
        draw_constraints(axes[name], arm)
    first = "; bodies as in the first" * (arm.cell is not None)
    figure.suptitle(f"{count}{', from two sides' * in_space}{first}", fontsize=9)
    joints, types, colors = axes["joints"], arm.joint_types, run_colors(len(postures))
    labels, scale = [f"$q_{j + 1}$" for j in range(arm.links)], "position [mm]" if PRISMATIC in types else "angle [deg]"
    for j, kind in enumerate(types):
        unit, factor = ("mm", 1.0) if kind == PRISMATIC else ("deg", np.degrees(1.0))
        ends, at = factor * np.array([arm.lower[j], arm.upper[j]]), factor * postures[:, j]
        if len({*types}) > 1:  # degrees and millimetres have no scale in common
            labels[j], scale = f"{labels[j]}, {ends[0]:.5g} to {ends[1]:.5g} {unit}", "from one limit to the other [%]"
            ends, at = (100.0 * (x - ends[0]) / (ends[1] - ends[0]) for x in (ends, at))
        joints.plot(ends, [j, j], color=LIMIT, lw=6, alpha=0.35, solid_capstyle="butt")
        joints.scatter(at, np.full(len(postures), j), c=colors, s=26, zorder=3, lw=0)
    joints.set(yticks=range(arm.links), yticklabels=labels, xlabel=scale)
    joints.set_title("joints within their limits, light to dark in order of measurement", fontsize=9)
    joints.invert_yaxis()
    return figure


def run_colors(m: int) -> Array:
    """(m, 4) colours from the first run (light) to the last (dark)."""
    return np.asarray(colormaps["viridis_r"](np.linspace(0.1, 1.0, m)))


def draw_arm(axes: Any, arm: Arm, postures: Array) -> None:
    """Stick figures of the arm as it is best known, in the frame of its base; axes : in a plane or in space, as it"""
    for line, color in zip(design_model(arm).points(postures), run_colors(len(postures)), strict=True):
        axes.plot(*line.T, color=color, lw=1.2, alpha=0.75)
        axes.plot(*line[-1:].T, "o", color=color, ms=3)
    axes.plot(*np.zeros((arm.dimension, 1)), "ks", ms=6)
    axes.set(aspect="equal")
    axes.locator_params(nbins=5)
    axes.set(**{f"{axis}label": f"{axis} [mm]" for axis in arm.chain.axes})


def draw_constraints(axes: Any, arm: Arm) -> None:
    """Workspace boxes, what to keep out of, the tracker and its cone; in space as far as the axes reach."""
    cut = {"axlim_clip": True} if axes.name == "3d" else {}
    for line, forbidden in outlines(arm):
        color = BEFORE if forbidden else LIMIT
        dense = np.concatenate([np.linspace(start, end, 20) for start, end in pairwise(line)])
        axes.plot(*dense.T, color=color, lw=0.8, ls="--", **cut)
        if forbidden and not cut:
            axes.fill(*line.T, color=color, alpha=0.25, lw=0)
    for tracker in trackers(arm):
        axes.plot(*np.array([tracker]).T, "k^", ms=6, **cut)


def draw_bodies(axes: Any, arm: Arm, posture: Array) -> None:
    """The bodies of a cell with the arm at a posture (n,); in space lit from the viewer, with the edge of the floor and
    the lines of sight from trackers."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    assert arm.cell is not None
    frames = design_model(arm).joint_frames(posture[None])[0]
    corners, colors, floor = [np.empty((0, 3, 3))], list[str](), arm.cell.floor
    for body in (one for one in arm.cell.bodies if len(one.looks())):
        vertices, faces = simplified(body.looks(), DRAWN // len(arm.cell.bodies))
        corners.append((vertices @ frames[body.joint, :3, :3].T + frames[body.joint, :3, 3])[faces.astype(int)])
        colors += [LINK if body.joint else CELL] * len(faces)
    if axes.name != "3d":
        axes.add_collection(PolyCollection(np.concatenate(corners)[..., :2], color=colors, zorder=0))
        return
    if colors:
        light: Any = LightSource(90.0 - axes.azim, axes.elev)
        look = {"facecolors": colors, "edgecolors": colors, "lw": 0.3, "shade": True, "lightsource": light}
        axes.add_collection3d(Poly3DCollection(np.concatenate(corners), **look))
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
    d = partial(sensitivity, problem, problem.information(postures), runs=len(postures))
    cloud = generator.uniform(problem.lower, problem.upper, (samples, problem.joints))
    upper = generator.integers(0, 2, (min(samples, 4 * 2 ** len(active)), problem.joints)) == 1
    others = np.concatenate([cloud, np.where(upper, problem.upper, problem.lower), postures])

    at_plan = d(postures)
    for axis, joint in zip(axes, active, strict=True):
        unit, factor = ("mm", 1.0) if problem.model.joint_types[joint] == PRISMATIC else ("deg", np.degrees(1.0))
        values, largest = np.linspace(problem.lower[joint], problem.upper[joint], steps), []
        for value in values:
            held = others.copy()
            held[:, joint] = value
            largest.append(d(held[problem.feasible(held)]).max(initial=0.0))
        axis.plot(factor * values, [each or np.nan for each in largest], color=AFTER)  # none is allowed: no line
        axis.plot(factor * postures[:, joint], at_plan, ".", color="k", ms=5)
        axis.axhline(problem.parameters, color=BEFORE, lw=1, ls="--")
        axis.set(xlabel=f"$q_{joint + 1}$ [{unit}]")
        axis.margins(y=0.12)
    axes[0].set_ylabel("largest d(q), dashed: p")
    return figure


# -- an arm in space for scene.js -------------------------------------------------------------------------------------
def scene(model: Any, postures: Array, tests: Mapping[str, Any]) -> dict[str, Any]:
    """What scene.js draws of an arm at postures (m, n) [rad, mm], and of measurements.

    model : of the arm, as `design_model` gives it;  tests : name of measurements -> their `Validation`

    The chain is a list of n + 1 steps from frame to frame, each a fixed pose and then a motion about or along an
    axis, but for the last one, which leads to the measured point: joint_frames(q) are their products.
    """
    frames = model.joint_frames(np.zeros((1, model.joints)))[0]
    moves = [{"axis": joint.axis.tolist(), "type": joint.type} for joint in model.arm.chain.joints]
    bodies = () if model.cell is None else model.cell.bodies
    most = 30_000 // max(len(bodies), 1)  # triangles of each: some 400 kB in all
    return {
        "chain": [
            {"pose": step[:3].ravel().tolist()} | move
            for step, move in zip(np.linalg.inv(frames[:-1]) @ frames[1:], [*moves, {}], strict=True)
        ],
        "postures": np.asarray(postures).round(9).tolist(),
        "bodies": [
            {"name": body.name, "joint": body.joint} | shape(looks, most)
            for body in bodies
            if len(looks := body.looks())
        ],
        "floor": None if model.cell is None else model.cell.floor,
        "trackers": [list(tracker) for tracker in trackers(model.arm)],
        "view": side(model.arm),
        "errors": [one for name, test in tests.items() for one in error_arrows(name, test)],
    }


def trackers(arm: Arm) -> list[tuple[float, ...]]:
    """Where the trackers stand [mm] that are to see the measured point."""
    return [one.tracker for one in arm.constraints if hasattr(one, "tracker")]


def side(arm: Arm) -> tuple[float, float]:
    """[deg] elevation and azimuth from which an arm in space is seen: its tracker stands behind it, to the right."""
    for tracker in trackers(arm):
        return 22.0, float(np.degrees(np.arctan2(tracker[1], tracker[0]))) - 130.0
    return 22.0, -60.0


def shape(triangles: Array, most: int) -> dict[str, Any]:
    """Triangles (t, 3, 3) as scene.js reads them, at most `most`: vertices are low + step * whole numbers."""
    vertices, faces = simplified(triangles, most)
    low, step = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-6) / WHOLE
    whole = np.round((vertices - low) / step).astype("<u2")
    texts = {name: b64encode(array.tobytes()).decode() for name, array in (("vertices", whole), ("faces", faces))}
    return {"low": low.tolist(), "step": step} | texts


def simplified(triangles: Array, most: int) -> tuple[Array, NDArray[np.uint16]]:
    """(v, 3) vertices and (f, 3) their numbers for triangles (t, 3, 3), of which at most `most` stay: vertices that are
    in one cell of a grid are one, at their mean (J. Rossignac, P. Borrel, "Multi-resolution 3D approximations", 1993);
    of few triangles only those that are equal.
    """
    vertices, faces = triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)
    low, size = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-6)
    cells = 2.0**14 if len(triangles) <= most else 2.0 * most**0.5  # along the longest side
    while True:
        places = np.floor((vertices - low) * (cells / size)).astype(np.int64) @ [1 << 42, 1 << 21, 1]
        _, number, count = np.unique(places, return_inverse=True, return_counts=True)
        vertices = np.column_stack([np.bincount(number, weights=each) for each in vertices.T]) / count[:, None]
        faces = number[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # not those that are a line now
        faces = faces[np.unique(faces @ [len(vertices) ** 2, len(vertices), 1], return_index=True)[1]]  # each once
        if len(faces) <= most and len(vertices) <= WHOLE:
            return vertices, faces.astype("<u2")
        cells *= 0.95 * min(most / len(faces), WHOLE / len(vertices)) ** 0.5  # there are as many as cells of a surface


def error_arrows(name: str, test: Any) -> list[dict[str, Any]]:
    """What drawing and calibrated arm leave of measurements, as arrows in the frame of the arm's base; none where no
    points are measured.

    Measured positions are in the frame of the instrument. The rotation from there to the base is the one that brings
    the measured points nearest to those of the arm, for each session (W. Kabsch, Acta Crystallographica A32, 1976).

    name : of the measurements;  test : their `Validation`
    """
    arm, measured, residuals = test.arm, test.measurements, (test.nominal_residuals, test.residuals)
    if residuals[0].shape[1] < len("xyz") or not arm.chain.instrument.reads_positions:
        return []
    frames, tools = design_model(arm).joint_frames(measured.postures)[:, -1], dict(arm.chain.tools)
    tools |= {} if arm.calibration is None else arm.calibration.tools
    at = frames[:, :3, 3]
    if measured.marker is not None and len(tools) > 1:
        beside = np.array([(tools[marker] - next(iter(tools.values())))[:3, 3] for marker in measured.marker])
        at = at + np.einsum("mij,mj->mi", frames[:, :3, :3], beside)
    arrows = np.zeros((2, *at.shape))
    for rows in measured.session_rows:
        there, here = (each[rows] - each[rows].mean(axis=0) for each in (measured.positions[:, :3], at))
        left, _, right = np.linalg.svd(there.T @ here)
        turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0]) @ right
        arrows[:, rows] = [each[rows, :3] @ turn for each in residuals]
    shown = np.linspace(0, len(at) - 1, min(len(at), 500)).astype(int)  # more only cover each other
    of_models = ("before", "drawing", test.nominal), ("after", "calibrated arm", test.model)
    models = [
        {"kind": kind, "name": model, "rms": figures.rms, "arrows": arrow[shown].round(5).tolist()}
        for (kind, model, figures), arrow in zip(of_models, arrows, strict=True)
    ]
    return [{"name": name, "rows": len(at), "at": at[shown].round(2).tolist(), "models": models}]
