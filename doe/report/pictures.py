"""Pictures of plans, certificates and residuals (matplotlib figures; the caller shows or saves them)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from doe.problem.problem import DesignProblem
from doe.report.page import check_picture
from doe.report.spatial_pictures import FORBIDDEN, RING, SEEN, draw_spatial_plan
from identification.arm import Arm
from identification.arrays import Array
from identification.files.io import write_whole
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, PRISMATIC, REVOLUTE
from identification.measurements import distances, rms_distance
from identification.model import Model
from identification.workspace import KeepOutCircle, LineOfSight, WorkspaceBox

POSITIONS = {REVOLUTE: "angle [deg]", PRISMATIC: "position [mm]"}
TICKS = 6  # at most, of a small picture: how many fit depends on the room that their own numbers leave
MOST = 500  # stick figures of one picture: more only cover each other
MANY = 500  # rows from which points are drawn smaller, and as pixels in vector formats
BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"


def save(figure: Figure, path: Path, force: bool = False) -> None:
    """Write a figure whole or not at all; the ending says the format (.png, .svg, .pdf). Raises `InputError`."""
    write_whole(path, picture_bytes(figure, path), force=force)


def picture_bytes(figure: Figure, path: Path) -> bytes:
    """The content of a picture file. Raises `InputError` for an ending that is no format."""
    check_picture(path)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix.lower().removeprefix("."), dpi=150)
    return buffer.getvalue()


def plan_figure(arm: Arm, postures: Array) -> Figure:
    """The postures of an arm as stick figures, of very many some, and every joint's angles within its limits."""
    shown = postures[np.linspace(0, len(postures) - 1, min(len(postures), MOST)).round().astype(int)]
    said = f"{len(postures)} postures" if len(shown) == len(postures) else f"{len(shown)} of {len(postures)} postures"
    if arm.chain is not None:
        figure = Figure(figsize=(10.0, 8.6))
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[2.2, 1.0]))
        draw_spatial_plan(top, arm, shown, run_colors(len(shown)), said)
        bottom.subplots_adjust(left=0.06, right=0.97, bottom=0.2)
        draw_joints(bottom.subplots(), arm, postures)
        return figure
    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    plane, joints = figure.subplots(1, 2, width_ratios=[1.0, 1.1])
    draw_arm(plane, arm, shown)
    plane.set_title(said, fontsize=9)
    draw_constraints(plane, arm)
    draw_joints(joints, arm, postures)
    return figure


def draw_joints(joints: Axes, arm: Arm, postures: Array) -> None:
    """Every joint's angles within its limits; of sliding joints where they are between them."""
    types = Model(arm).joint_types
    units = np.array([FILE_UNITS[JOINT_UNITS[kind]][1] for kind in types])
    for j in range(arm.links):
        low, high = units[j] * arm.lower[j], units[j] * arm.upper[j]
        joints.plot([low, high], [j, j], color=LIMIT, lw=6, alpha=0.35, solid_capstyle="butt")
        shown = units[j] * postures[:, j]
        joints.scatter(shown, np.full(len(shown), j), c=run_colors(len(shown)), s=26, zorder=3, lw=0)
    joints.set(yticks=range(arm.links), yticklabels=[f"$q_{j + 1}$" for j in range(arm.links)])
    joints.set_xlabel("angle [deg]" if arm.chain is None else " or ".join(sorted({POSITIONS[kind] for kind in types})))
    joints.set_title("angles within the joint limits, light to dark in order of measurement", fontsize=9)
    joints.invert_yaxis()


def run_colors(m: int) -> Array:
    """(m, 4) colours from the first run (light) to the last (dark)."""
    return np.asarray(colormaps["viridis_r"](np.linspace(0.1, 1.0, m)))


def draw_arm(axes: Axes, arm: Arm, postures: Array) -> None:
    """Stick figures of the arm as it is best known; in a plane, for an arm in one."""
    for line, color in zip(Model(arm).points(postures), run_colors(len(postures)), strict=True):
        axes.plot(line[:, 0], line[:, 1], color=color, lw=1.2, alpha=0.75)
        axes.plot(*line[-1], "o", color=color, ms=4)
    axes.plot(0, 0, "ks", ms=6)
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]")


def draw_constraints(axes: Axes, arm: Arm) -> None:
    """Workspace boxes, keep-out circles and the tracker's cone."""
    for line, color in planar_outlines(arm):
        axes.plot(*line.T, color=color, lw=1, ls="--")
        if color == FORBIDDEN:
            axes.fill(*line.T, color=color, alpha=0.25, lw=0)
    for constraint in arm.constraints:
        if isinstance(constraint, LineOfSight):
            axes.plot(*np.array([constraint.tracker]).T, "k^", ms=7)


def planar_outlines(arm: Arm) -> list[tuple[Array, str]]:
    """Lines (k, 2) and colors of what constrains an arm in a plane."""
    found = []
    for constraint in arm.constraints:
        if isinstance(constraint, WorkspaceBox):
            corners = [(constraint.x[i], constraint.y[j]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))]
            found.append((np.array(corners), SEEN))
        elif isinstance(constraint, KeepOutCircle):
            ring = np.column_stack([np.cos(RING), np.sin(RING)])
            found.append((np.array(constraint.center) + constraint.radius * ring, FORBIDDEN))
        elif isinstance(constraint, LineOfSight):
            found.append((_sides(constraint), SEEN))
    return found


def _sides(sight: LineOfSight) -> Array:
    """(3, 2) the sides of what the tracker sees, itself between their ends."""
    tracker, toward = np.array(sight.tracker), np.array(sight.toward)
    axis = np.arctan2(*(toward - tracker)[::-1])
    length = float(np.hypot(*(toward - tracker))) * 1.3
    one, other = (axis + sign * sight.half_angle for sign in (-1.0, 1.0))
    ends = [tracker + length * np.array([np.cos(angle), np.sin(angle)]) for angle in (one, other)]
    return np.stack([ends[0], tracker, ends[1]])


def certificate_figure(problem: DesignProblem, postures: Array, samples: int = 4096, steps: int = 61) -> Figure:
    """The equivalence theorem seen along each joint: the largest d(q) at each value, which must not exceed p.

    For every active joint the value is held at `steps` values while the other joints take `samples` random values,
    their limits and the plan's own, as far as constraints allow; the line is the largest d found. A plan is optimal
    where the line touches p and never crosses it.
    """
    active = problem.active_joints
    figure = Figure(figsize=(10.0, 2.9), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(active), sharey=True))
    prior, gradient = (
        problem.prior.per_new_run(len(postures)),
        problem.criterion.gradient(problem.information(postures)),
    )

    def d(somewhere: Array) -> Array:
        return prior.sensitivities(problem.scaled_jacobians(somewhere), gradient)

    others, at_plan = np.concatenate([posture_cloud(problem, samples), postures]), d(postures)
    for axis, joint in zip(axes, active, strict=True):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[problem.model.joint_types[joint]]]
        values = np.linspace(problem.lower[joint], problem.upper[joint], steps)
        held = (others_at(problem, others, joint, value) for value in values)
        axis.plot(factor * values, [d(some).max(initial=0.0) for some in held], color=AFTER)
        axis.plot(factor * postures[:, joint], at_plan, ".", color="k", ms=5)
        axis.axhline(problem.parameters, color=BEFORE, lw=1, ls="--")
        axis.set(xlabel=f"$q_{joint + 1}$ [{unit}]")
        axis.margins(y=0.12)
        axis.tick_params(labelleft=True)  # on a phone the columns stand below each other
    axes[0].set_ylabel("largest d(q), dashed: p")
    return figure


def others_at(problem: DesignProblem, others: Array, joint: int, value: float) -> Array:
    """(k, n) the postures that are allowed with a joint at this value."""
    held = others.copy()
    held[:, joint] = value
    return held[problem.feasible(held)]


def posture_cloud(problem: DesignProblem, samples: int) -> Array:
    """(s, n) postures over the limits: a fixed random cloud, and the corners of the active joints' box."""
    generator = np.random.default_rng(0)
    cloud = generator.uniform(problem.lower, problem.upper, (samples, problem.joints))
    choices = generator.integers(0, 2, (min(samples, 2 ** len(problem.active_joints) * 4), problem.joints))
    return np.concatenate([cloud, np.where(choices == 1, problem.upper, problem.lower)])


def residual_figure(arm: Arm, postures: Array, positions: Array, before: Array, after: Array) -> Figure:
    """Residuals (m, d) before and after, over the workspace (arrows, enlarged) and against each joint."""
    views = len(projections(before.shape[1]))
    figure = Figure(figsize=(10.0, 2.6 + 3.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.3 * views, 1.0]))
    pairs = ((before, BEFORE, "before"), (after, AFTER, "after"))
    scale = 0.12 * arm.reach / (float(distances(before).max()) or 1.0)  # the largest arrow is an eighth of the reach
    for column, (residuals, color, name) in zip(workspace_axes(top, before.shape[1]), pairs, strict=True):
        draw_residual_arrows(column, positions, residuals, color, name, scale, base_of(arm))
    draw_against_joints(bottom, postures, before, after)
    return figure


def draw_against_joints(figure: SubFigure, postures: Array, before: Array, after: Array) -> None:
    """Distances (m, d) [mm] before and after against each angle of postures (m, n)."""
    (strips,) = figure.subplots(1, postures.shape[1], sharey=True, squeeze=False)
    for j, axis in enumerate(strips):
        for residuals, color in ((before, BEFORE), (after, AFTER)):
            axis.plot(np.degrees(postures[:, j]), distances(residuals), ".", color=color, ms=4, alpha=0.7)
        axis.set(xlabel=f"$q_{j + 1}$ [deg]", yscale="log")
    strips[0].set_ylabel("residual [mm]")


def projections(dimension: int) -> list[tuple[int, int]]:
    """Pairs of coordinates that a workspace is seen in: from above, in space from the side too; of lengths one view."""
    return [(0, 1)] if dimension < 3 else [(0, 1), (0, 2)]


def workspace_axes(figure: Figure | SubFigure, dimension: int) -> list[list[Axes]]:
    """Two columns of axes, before and after, with one for each projection."""
    views = len(projections(dimension))
    columns = figure.subplots(views, 2, sharex=True, sharey="row", squeeze=False).T
    for axis in columns.flat:
        axis.tick_params(labelleft=True)  # on a phone the columns stand below each other
    return [list(column) for column in columns]


def to_scale(figure: Figure, columns: Sequence[Sequence[Axes]]) -> None:
    """Rows of pictures of one scale as high as what they show, and the figure as high as all of them."""
    boxes = [axis.dataLim for axis in columns[0]]
    shares = [float(np.clip(box.height / box.width, 0.25, 1.5)) if box.width else 1.0 for box in boxes]
    if (grid := columns[0][0].get_gridspec()) is not None:
        grid.set_height_ratios(shares)
    figure.set_figheight(0.2 + sum(0.5 + 0.88 * figure.get_figwidth() * share / len(columns) for share in shares))


def base_of(arm: Arm) -> tuple[float, float]:
    """Where a planar arm stands in the frame of its measurements [mm]."""
    known = Model(arm).best_known if arm.chain is None else {}
    return known.get("base_offset.x0", 0.0), known.get("base_offset.y0", 0.0)


def draw_residual_arrows(
    axes: Sequence[Axes],
    positions: Array,
    residuals: Array,
    color: str,
    name: str,
    scale: float,
    base: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Residuals (m, d) as arrows at the measured positions, enlarged by `scale`, in each projection; of lengths, d = 1,
    as they are, against what was measured."""
    if residuals.shape[1] == 1:
        axes[0].plot(positions[:, 0], residuals[:, 0], ".", color=color, ms=4, alpha=0.7)
        axes[0].set(xlabel="measured length [mm]", ylabel="residual [mm]")
        axes[0].set_title(f"{name}: RMS {rms_distance(residuals):.4g} mm", fontsize=9, parse_math=False)
        return
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004, "color": color}
    style["rasterized"] = len(positions) > MANY
    planar = residuals.shape[1] == 2
    for axis, (across, up) in zip(axes, projections(residuals.shape[1]), strict=True):
        seen = [values[:, place] for values in (positions, residuals * scale) for place in (across, up)]
        axis.quiver(*seen, **style)
        axis.update_datalim(np.column_stack([seen[0] + seen[2], seen[1] + seen[3]]))  # whole arrows
        axis.autoscale_view()
        axis.set(aspect="equal", xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]")
        if planar:
            axis.plot(*base, "ks", ms=5)
    axes[0].set_title(
        f"{name}: RMS {rms_distance(residuals):.4g} mm, arrows x {scale:.0f}", fontsize=9, parse_math=False
    )
