"""Pictures of plans, certificates, residuals and diagnoses (matplotlib figures; the caller shows or saves them)."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from doe.advise import Advice
from doe.problem.problem import DesignProblem
from doe.problem.spatial_constraints import circle_across
from doe.report.page import check_picture
from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.uncertainty import quantile_95
from identification.files.io import write_whole
from identification.gap.detectability import Detectability
from identification.gap.result import Diagnosis
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, PRISMATIC, REVOLUTE
from identification.measurements import distances, rms_distance
from identification.model import Model
from identification.validate import Validation
from identification.workspace import KeepOutCircle, KeepOutCylinder, LineOfSight, WorkspaceBox

BEFORE, AFTER, LIMIT, FORBIDDEN = "#c44e52", "#2a6f97", "#888888", "#c44e52"
MANY = 500  # more stick figures only cover each other; more points are drawn smaller, as pixels in vector formats
SIDES = ((22.0, -60.0), (22.0, 30.0))  # [deg] elevation and azimuth of the two views of a spatial arm
RING = np.linspace(0.0, 2.0 * np.pi, 49)


def save(figure: Figure, path: Path, force: bool = False) -> None:
    """Write a figure whole or not at all; the ending says the format (.png, .svg, .pdf). Raises `InputError`."""
    write_whole(path, picture_bytes(figure, path), force=force)


def picture_bytes(figure: Figure, path: Path) -> bytes:
    """The content of a picture file. Raises `InputError` for an ending that is no format."""
    check_picture(path)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=path.suffix.lower().removeprefix("."), dpi=150)
    return buffer.getvalue()


# -- plans -------------------------------------------------------------------------------------------------------------
def plan_figure(arm: Arm, postures: Array) -> Figure:
    """The postures of an arm as stick figures, of very many some, and every joint's angles within its limits."""
    shown = postures[np.linspace(0, len(postures) - 1, min(len(postures), MANY)).round().astype(int)]
    count = f"{len(postures)} postures" if len(shown) == len(postures) else f"{len(shown)} of {len(postures)} postures"
    if not arm.chain.planar:
        figure = Figure(figsize=(10.0, 8.6))
        top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[2.2, 1.0]))
        for k, side in enumerate(SIDES, start=1):
            draw_side(top.add_subplot(1, len(SIDES), k, projection="3d"), arm, shown, side)
        top.subplots_adjust(left=0.03, right=0.93, bottom=0.06, top=0.94, wspace=0.3)
        top.suptitle(f"{count}, from two sides; light to dark in order of measurement", fontsize=9)
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
    types = Model(arm).joint_types
    for j, kind in enumerate(types):
        factor = FILE_UNITS[JOINT_UNITS[kind]][1]
        limits = [factor * arm.lower[j], factor * arm.upper[j]]
        joints.plot(limits, [j, j], color=LIMIT, lw=6, alpha=0.35, solid_capstyle="butt")
        colors = run_colors(len(postures))
        joints.scatter(factor * postures[:, j], np.full(len(postures), j), c=colors, s=26, zorder=3, lw=0)
    joints.set(yticks=range(arm.links), yticklabels=[f"$q_{j + 1}$" for j in range(arm.links)])
    labels = {REVOLUTE: "angle [deg]", PRISMATIC: "position [mm]"}
    joints.set_xlabel(" or ".join(sorted({labels[kind] for kind in types})))
    joints.set_title("angles within the joint limits, light to dark in order of measurement", fontsize=9)
    joints.invert_yaxis()


def run_colors(m: int) -> Array:
    """(m, 4) colours from the first run (light) to the last (dark)."""
    return np.asarray(colormaps["viridis_r"](np.linspace(0.1, 1.0, m)))


def draw_arm(axes: Any, arm: Arm, postures: Array) -> None:
    """Stick figures of the arm as it is best known, in the frame of its base; axes : in a plane or in space, as it"""
    for line, color in zip(Model(arm).points(postures), run_colors(len(postures)), strict=True):
        axes.plot(*line.T, color=color, lw=1.2, alpha=0.75)
        axes.plot(*line[-1:].T, "o", color=color, ms=3)
    dimension = arm.dimension
    axes.plot(*np.zeros((dimension, 1)), "ks", ms=6)
    axes.set(aspect="equal" if dimension == 2 else "auto")
    axes.set(**{f"{axis}label": f"{axis} [mm]" for axis in "xyz"[:dimension]})


def draw_constraints(axes: Any, arm: Arm) -> None:
    """Workspace boxes, what to keep out of, the tracker and its cone."""
    for line, color in outlines(arm):
        axes.plot(*line.T, color=color, lw=0.8, ls="--")
        if color == FORBIDDEN and line.shape[1] == 2:
            axes.fill(*line.T, color=color, alpha=0.25, lw=0)
    for constraint in arm.constraints:
        if isinstance(constraint, LineOfSight):
            axes.plot(*np.array([constraint.tracker]).T, "k^", ms=6)


def draw_side(axes: Any, arm: Arm, postures: Array, side: tuple[float, float] = SIDES[0], zoom: float = 1.0) -> None:
    """A spatial arm at postures (m, n) and what constrains it, from one side.

    zoom : of the box in its place, whose sides have the same scale
    """
    draw_arm(axes, arm, postures)
    draw_constraints(axes, arm)
    axes.tick_params(labelsize=7)
    for one in (axes.xaxis, axes.yaxis, axes.zaxis):
        one.set_major_locator(MaxNLocator(4))
    limits = np.array([axes.get_xlim(), axes.get_ylim(), axes.get_zlim()])
    axes.set_box_aspect(limits[:, 1] - limits[:, 0], zoom=zoom)
    axes.view_init(*side)


def outlines(arm: Arm) -> list[tuple[Array, str]]:
    """Lines (k, d) and colors of what constrains an arm: boxes, circles, spheres, cylinders, the tracker's cone."""
    lines: list[tuple[Array, str]] = []
    for constraint in arm.constraints:
        if isinstance(constraint, WorkspaceBox):
            lines += [(edges, LIMIT) for edges in _box(constraint, not arm.chain.planar)]
        elif isinstance(constraint, KeepOutCircle):
            rings = [_ring(axis)[:, : arm.dimension] for axis in np.eye(3)[list(arm.chain.turning)]]
            lines += [(np.array(constraint.center) + constraint.radius * ring, FORBIDDEN) for ring in rings]
        elif isinstance(constraint, KeepOutCylinder):
            ends = np.array([constraint.start, constraint.end])
            first, last = (end + constraint.radius * _ring(ends[1] - ends[0]) for end in ends)
            sides = [np.array(pair) for pair in zip(first[::12], last[::12], strict=True)]
            lines += [(line, FORBIDDEN) for line in (first, last, *sides)]
        elif isinstance(constraint, LineOfSight):
            lines += [(line, LIMIT) for line in _cone(constraint)]
    return lines


def _ring(axis: Array) -> Array:
    """(49, 3) unit circle around an axis."""
    one, other = circle_across(axis)
    return np.asarray(np.cos(RING)[:, None] * one + np.sin(RING)[:, None] * other)


def _box(box: WorkspaceBox, space: bool) -> list[Array]:
    """The four edges in a plane or of a floor without limits of height, or the twelve in space."""
    corners = np.array([(box.x[i], box.y[j]) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))])
    if not space:
        return [corners]
    low, high = box.z or (0.0, 0.0)
    floors = [np.column_stack([corners, np.full(5, height)]) for height in {low, high}]
    return [*floors, *(np.array([(x, y, low), (x, y, high)]) for x, y in corners[:4])]


def _cone(sight: LineOfSight) -> list[Array]:
    """In a plane its two sides, in space its end and four lines to it; as far as the tracker or the arm reaches."""
    tracker = np.array(sight.tracker)
    axis = np.array(sight.toward) - tracker
    unit, far = axis / np.linalg.norm(axis), float(np.linalg.norm(axis))
    if len(tracker) == 2:
        turn = np.array(
            [
                [np.cos(sight.half_angle), -np.sin(sight.half_angle)],
                [np.sin(sight.half_angle), np.cos(sight.half_angle)],
            ]
        )
        return [np.stack([tracker + 1.3 * far * (turn.T @ unit), tracker, tracker + 1.3 * far * (turn @ unit)])]
    length = 1.2 * far if sight.reach is None else sight.reach[1]
    end = tracker + length * (np.cos(sight.half_angle) * unit + np.sin(sight.half_angle) * _ring(axis))
    return [end, *(np.stack([tracker, place]) for place in end[:-1:12])]


def certificate_figure(problem: DesignProblem, postures: Array, samples: int = 4096, steps: int = 61) -> Figure:
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
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[problem.model.joint_types[joint]]]
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
        axis.tick_params(labelleft=True)  # on a phone the columns stand below each other
    axes[0].set_ylabel("largest d(q), dashed: p")
    return figure


def advice_figure(advice: Advice) -> Figure:
    """Efficiency and expected accuracy against the number of runs."""
    accuracies = [advice.accuracy(design) for design in advice.designs]
    with_accuracy = all(accuracy is not None for accuracy in accuracies)
    figure = Figure(figsize=(10.0, 3.6) if with_accuracy else (6.0, 3.6), layout="constrained")
    axes = figure.subplots(1, 2 if with_accuracy else 1, squeeze=False)[0]
    good = set(advice.efficient_runs())
    efficiencies = [design.efficiency or float("nan") for design in advice.designs]
    axes[0].plot(advice.runs, efficiencies, color=AFTER, lw=1)
    colors = [AFTER if m in good else "white" for m in advice.runs]
    axes[0].scatter(advice.runs, efficiencies, c=colors, edgecolors=AFTER, s=30, zorder=3)
    axes[0].set(xlabel="runs m", ylabel="D-efficiency", title="filled: within 0.1 % of the bound")
    if with_accuracy:
        axes[1].plot(advice.runs, accuracies, "o-", color=AFTER, ms=4, lw=1)
        if advice.target is not None:
            axes[1].axhline(advice.target, color=BEFORE, ls="--", lw=1)
        what = "expected error of the tip, model right [mm]" if advice.of_tip else "largest std of a length [mm]"
        axes[1].set(xlabel="runs m", ylabel=what, ylim=(0, None))
    return figure


# -- residuals ---------------------------------------------------------------------------------------------------------
def residual_figure(arm: Arm, postures: Array, positions: Array, before: Array, after: Array) -> Figure:
    """Residuals (m, d) before and after, over the workspace (arrows, enlarged) and against each joint."""
    views = len(projections(before.shape[1]))
    figure = Figure(figsize=(10.0, 2.6 + 3.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.3 * views, 1.0]))
    draw_workspace(top, arm, positions, ((before, "before"), (after, "after")))
    (strips,) = bottom.subplots(1, postures.shape[1], sharey=True, squeeze=False)
    for j, axis in enumerate(strips):
        for residuals, color in ((before, BEFORE), (after, AFTER)):
            axis.plot(np.degrees(postures[:, j]), distances(residuals), ".", color=color, ms=4, alpha=0.7)
        axis.set(xlabel=f"$q_{j + 1}$ [deg]", yscale="log")
    strips[0].set_ylabel("residual [mm]")
    return figure


def workspace_arrows(arm: Arm, positions: Array, pairs: Sequence[tuple[Array, str]]) -> Figure:
    """Residual arrows (m, d) of two models, with their names, at positions (m, d), on one scale."""
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    columns = draw_workspace(figure, arm, positions, pairs)
    if len(columns[0]) > 1:  # rows of one scale as high as what they show, and the figure as high as all of them
        boxes = [axis.dataLim for axis in columns[0]]
        shares = [float(np.clip(box.height / box.width, 0.25, 1.5)) if box.width else 1.0 for box in boxes]
        if (grid := columns[0][0].get_gridspec()) is not None:
            grid.set_height_ratios(shares)
        figure.set_figheight(0.2 + sum(0.5 + 0.44 * figure.get_figwidth() * share for share in shares))
    return figure


def draw_workspace(
    figure: Figure | SubFigure, arm: Arm, positions: Array, pairs: Sequence[tuple[Array, str]]
) -> list[list[Axes]]:
    """Residual arrows of two models in two columns of axes, with one for each projection, on one scale: the largest
    arrow is an eighth of the reach; and where a planar arm stands."""
    dimension, values = pairs[0][0].shape[1], Model(arm).best_known if arm.chain.planar else {}
    grid = figure.subplots(len(projections(dimension)), 2, sharex=True, sharey="row", squeeze=False)
    scale = 0.12 * arm.reach / (max(float(distances(residuals).max()) for residuals, _ in pairs) or 1.0)
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004}
    for column, (residuals, name), color in zip(grid.T, pairs, (BEFORE, AFTER), strict=True):
        title = f"{name}: RMS {rms_distance(residuals):.4g} mm{f', arrows x {scale:.0f}' if dimension > 1 else ''}"
        column[0].set_title(title, fontsize=9, parse_math=False)
        for axis, (across, up) in zip(column, projections(dimension), strict=True):
            axis.tick_params(labelleft=True)  # on a phone the columns stand below each other
            if dimension == 1:  # lengths, as they are, against what was measured
                axis.plot(positions[:, 0], residuals[:, 0], ".", color=color, ms=4, alpha=0.7)
                axis.set(xlabel="measured length [mm]", ylabel="residual [mm]")
                continue
            x, y, along, upward = (v[:, k] for v in (positions, residuals * scale) for k in (across, up))
            axis.quiver(x, y, along, upward, color=color, rasterized=len(positions) > MANY, **style)
            axis.update_datalim(np.column_stack([x + along, y + upward]))  # whole arrows
            axis.autoscale_view()
            axis.set(aspect="equal", xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]")
            if arm.chain.planar:
                axis.plot(values.get("base_offset.x0", 0.0), values.get("base_offset.y0", 0.0), "ks", ms=5)
    return [list(column) for column in grid.T]


def projections(dimension: int) -> list[tuple[int, int]]:
    """Pairs of coordinates that a workspace is seen in: from above, in space from the side too; of lengths one view."""
    return [(0, 1)] if dimension < 3 else [(0, 1), (0, 2)]


def draw_distances(axis: Axes, x: Array, pairs: Sequence[tuple[Array, str]]) -> None:
    """Distances (m,) [mm] of two models as points, and their RMS in up to twelve groups of rows as lines."""
    few: dict[str, Any] = {"ms": 3, "alpha": 0.5}
    style = few if len(x) <= MANY else {"ms": 1, "alpha": 0.2, "rasterized": True}
    groups = np.array_split(np.argsort(x, kind="stable"), min(12, max(1, len(x) // 4)))
    middle = [np.mean(x[g]) for g in groups]
    for (values, name), color in zip(pairs, (BEFORE, AFTER), strict=True):
        axis.plot(x, values, ".", color=color, **style)
        axis.plot(middle, [np.sqrt(np.mean(values[g] ** 2)) for g in groups], color=color, lw=1.8, label=name)
    axis.set(ylim=(0, None))


def validation_figure(result: Validation) -> Figure:
    """Distances of drawing and model in the order of measurement, and their residuals over the workspace."""
    views = len(projections(result.residuals.shape[1]))
    figure = Figure(figsize=(10.0, 2.8 + 4.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.0, 1.7 * views]))
    pairs = ((result.nominal_residuals, "drawing"), (result.residuals, "model"))
    axis, order = top.subplots(), result.measurements.sequence
    row = np.arange(1.0, len(order) + 1.0)
    draw_distances(axis, row, [(distances(residuals[order]), name) for residuals, name in pairs])
    axis.set(xlabel="measurement, in order", ylabel="distance [mm]")
    axis.legend(frameon=False, fontsize=8)
    draw_workspace(bottom, result.arm, result.measurements.positions, pairs)
    return figure


# -- diagnoses ---------------------------------------------------------------------------------------------------------
def gap_figure(diagnosis: Diagnosis) -> Figure:
    """Residual arrows over the workspace, before and after, without outlier rows."""
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    pairs = (shown.before[kept], "before"), (shown.after[kept], "after")
    return workspace_arrows(diagnosis.extended_arm(), shown.positions[kept], pairs)


def against_figure(diagnosis: Diagnosis) -> Figure:
    """Residual distances before and after, against each joint, time, torque.

    Outlier rows are left out, as they were in the tests: a single displaced target would set the scale.
    """
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    pairs = [(distances(r[kept]), name) for r, name in ((shown.before, "before"), (shown.after, "after"))]

    def draw(axis: Axes, name: str) -> None:
        turn = "[rad]" in name
        values = shown.against[name][kept]
        draw_distances(axis, np.degrees(values) if turn else values, pairs)
        axis.set(xlabel=name.replace("[rad]", "[deg]"), ylabel="residual [mm]")

    return panels([*shown.against], 3, 2.3, draw, sharey=True)


def curves_figure(diagnosis: Diagnosis) -> Figure:
    """Error curves with 95 % bands, and what up to 200 groups of rows say along the lever arm, as angles."""
    half, kept = quantile_95(min(diagnosis.named.freedom, default=np.inf)), rows_kept(diagnosis)
    model, after = Model(diagnosis.arm), diagnosis.residuals.after[kept]
    joints = [diagnosis.residuals.against[f"joint {j + 1} [rad]"] for j in range(model.joints)]
    postures = np.column_stack(joints)[kept]
    levers = model.joint_levers(postures)

    def draw(axis: Axes, curve: Any) -> None:
        q, lever = postures[:, curve.joint - 1], levers[:, :, curve.joint - 1]
        weight = np.sum(lever**2, axis=1)
        along = np.sum(lever * after, axis=1) + weight * curve.table.at(q)
        groups = np.array_split(np.argsort(q, kind="stable"), min(200, max(1, len(q) // 2)))
        means = [(float(np.mean(q[g])), float(along[g].sum() / weight[g].sum())) for g in groups]
        axis.plot(*np.degrees(means).T, ".", color=LIMIT, ms=3, label="rows, in groups")
        angles, error, band = np.degrees([curve.angles, curve.error, half * curve.std])
        axis.fill_between(angles, error - band, error + band, color=AFTER, alpha=0.25, lw=0, label="95 %")
        axis.plot(angles, error, color=AFTER, lw=1.4, label="curve")
        axis.set(xlabel=f"$q_{curve.joint}$ [deg]", ylabel="error [deg]")

    return panels(sorted(diagnosis.curves, key=lambda curve: curve.joint), 2, 2.2, draw)


def panels(
    items: Sequence[Any], columns: int, height: float, draw: Callable[[Axes, Any], None], **style: Any
) -> Figure:
    """One picture of a panel for each item, the first with a legend."""
    rows = -(-len(items) // columns)
    figure = Figure(figsize=(10.0, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **style).ravel()
    for axis, item in zip(axes, items, strict=False):
        draw(axis, item)
        axis.locator_params(axis="y", nbins=6)
        axis.tick_params(labelleft=True)  # on a phone the columns stand below each other
    for axis in axes[len(items) :]:
        axis.set_visible(False)
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def rows_kept(diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """(m,) False for outlier rows."""
    kept = np.ones(len(diagnosis.residuals.before), dtype=bool)
    kept[np.array(diagnosis.outlier_rows, dtype=int) - 1] = False
    return kept


def alias_figure(detectability: Detectability) -> Figure:
    """Heat map: how much of one effect (row) another one (column) explains on this plan, base model projected off."""
    size = len(detectability.names)
    figure = Figure(figsize=(3.2 + 0.27 * size, 2.2 + 0.27 * size), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(detectability.likeness, vmin=0.0, vmax=1.0, cmap="magma_r")
    axis.set_xticks(range(size), detectability.names, rotation=90, fontsize=9)
    axis.set_yticks(range(size), detectability.names, fontsize=9)
    axis.set_title("likeness of effects on these postures: 1 = indistinguishable", fontsize=10)
    figure.colorbar(image, ax=axis, shrink=0.7)
    return figure
