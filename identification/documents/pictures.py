"""Residuals with their sign against each joint, as the error of that joint that they mean, with the curve of the model.

A joint that turns by e too far moves the tip by e times its lever d tip / d q_j. The error that explains most of a
row's residual r is e = r . lever / |lever|^2; where the lever is short a row says little, and e is held small.

Where effects of the model turn a joint by a function of its angle, this function is the line, and the points before are
the residuals of the same model without these effects: partial residuals (W. A. Larsen, S. J. McCleary, "The use of
partial residual plots in regression analysis", Technometrics 1972), which scatter about the line as the points after
scatter about zero. A model fitted without the effects would bend lengths and zeros to make up for them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array
from identification.conditions import Conditions
from identification.document import Pictures
from identification.effects import Effect
from identification.error_curve import all_hold
from identification.estimation.uncertainty import quantile_95
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.measurements import POINT, distances, rms_distance
from identification.model import Model

if TYPE_CHECKING:
    from identification.gap.detectability import Detectability
    from identification.gap.result import Diagnosis
    from identification.validate import Validation

BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"
MANY = 500  # more points are drawn smaller, as pixels in vector formats

POINTS = 721  # of a line
FAR = 0.1  # share of the range without rows over which no line is drawn
READ = "Each dot is one row: the error of this joint that would best explain what is left (measured less computed)."


@dataclass(frozen=True)
class Compared:
    """Residuals (m, d) [mm], measured less computed, of two models at postures (m, n).

    model : the later one;  named : labels of its effects that the earlier one has not; where it has none of these, the
        line is what lies between the two models, in groups of rows
    """

    arm: Arm
    postures: Array
    before: Array
    after: Array
    conditions: Conditions | None = None
    model: Model | None = None
    named: Collection[str] = ()

    @property
    def errors(self) -> tuple[Array, Array]:
        """(m, n) errors of each joint [rad, mm] that the residuals of either model mean."""
        levers = Model(self.arm).joint_levers(self.postures, conditions=self.conditions)[:, POINT]
        before, after = (joint_errors(levers, r[:, : levers.shape[1]]) for r in (self.before, self.after))
        return before, after

    def pictures(self, before: str, after: str) -> Pictures:
        """The pictures and how they are read; before, after : the models in words."""
        return Pictures(lambda: [caption(before, after, self.named), *signed_figures(self)])


def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, 0.3**2 * squares.max(axis=0))  # of shorter levers a row counts less
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def line_between(q: Array, lever: Array, change: Array) -> tuple[Array, Array]:
    """Angles, and the error of a joint there that the change (m, d) [mm] between two models means: of groups of rows by
    least squares; broken by NaN where no rows are."""
    size = int(np.clip(len(q) // 8, 3, 10))  # rows of one point of the line, at most an eighth of all
    groups = np.array_split(np.argsort(q, kind="stable"), max(1, len(q) // size))
    weight, along = np.sum(lever**2, axis=1), np.sum(lever * change, axis=1)
    angles = [float(np.mean(q[g])) for g in groups]
    errors = [float(along[g].sum() / weight[g].sum()) if weight[g].sum() > 0.0 else np.nan for g in groups]
    gaps = 1 + np.flatnonzero(np.diff(angles) > FAR * np.ptp(q))
    return np.insert(angles, gaps, np.nan), np.insert(errors, gaps, np.nan)


def share_of(model: Model, effect: Effect, rows: Compared, lever: Array) -> tuple[Array, Array, Array, bool]:
    """What an effect adds at its joint: (POINTS,) angles over the range of the rows and the errors there, NaN where it
    is off, in the mean of eight postures; (m, d) what it does to the rows [mm]; whether it is a function of the angle
    alone, as far as the rows show: a backlash is none.

    A curve acts where all curves hold, and is drawn where there are such rows.
    """
    assert effect.joint is not None
    joint = effect.joint - 1
    q = rows.postures[:, joint]
    grid = np.linspace(q.min(), q.max(), POINTS)
    if effect.curve is not None:
        curves = [(e.joint - 1, e.curve) for e in model.effects if e.curve is not None and e.joint is not None]
        hold = all_hold(curves, rows.postures)
        places = np.concatenate([[-np.inf], np.sort(q[hold > 0.5]), [np.inf]])
        after = np.searchsorted(places, grid)
        near = np.minimum(grid - places[after - 1], places[after] - grid) < FAR * (float(np.ptp(q)) or 1.0)
        line = np.where(near, effect.curve.at(grid), np.nan)
        return grid, line, lever * (hold * effect.curve.at(q))[:, None], True
    names = {p.name for p in effect.parameters}
    without = np.where([name in names for name in model.names], 0.0, model.values)

    def moved_by_it(postures: Array, conditions: Conditions | None, dimension: int) -> Array:
        position = (model.position(postures, values, conditions) for values in (None, without))
        return np.nan_to_num(np.subtract(*position))[:, :dimension]

    chosen = rows.postures[np.linspace(0, len(q) - 1, min(len(q), 8)).astype(int)]
    densely = np.tile(chosen, (POINTS, 1))
    densely[:, joint] = np.repeat(grid, len(chosen))
    levers = model.joint_levers(densely)[:, POINT, joint]
    along = np.sum(levers * moved_by_it(densely, None, levers.shape[1]), axis=1).reshape(POINTS, -1).sum(axis=1)
    square = np.sum(levers**2, axis=1).reshape(POINTS, -1).sum(axis=1)
    line = np.divide(along, square, out=np.zeros(POINTS), where=square > 0.0)
    moved = moved_by_it(rows.postures, rows.conditions, lever.shape[1])
    left = moved - lever * np.interp(q, grid, line)[:, None]
    # True: its function of the angle is nearly all that the effect does
    return grid, line, moved, bool(np.linalg.norm(left) <= 0.1 * np.linalg.norm(moved))


def signed_figures(rows: Compared) -> list[Figure]:
    """A picture for each joint: its error by the residuals of both models, and the model's line between the two.

    Shown are the named effects that are functions of the joint's angle, as lines, or else those that are not, at rows.
    """
    model, named = Model(rows.arm), set(rows.named)
    levers = model.joint_levers(rows.postures, conditions=rows.conditions)[:, POINT]
    before, after = (values[:, : levers.shape[1]] for values in (rows.before, rows.after))
    figures = []
    for j, kind in enumerate(model.joint_types):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes, q, lever = figure.subplots(), rows.postures[:, j], levers[:, :, j]
        effects = [] if rows.model is None else [e for e in rows.model.effects if e.joint == j + 1 and e.label in named]
        shares = {e.label: share_of(rows.model, e, rows, lever) for e in effects if rows.model}
        smooth = {label: share for label, share in shares.items() if share[3]}
        shares = smooth or shares
        moved = sum((share[2] for share in shares.values()), np.zeros_like(after))
        errors = [joint_errors(levers, values)[:, j] for values in (after + moved if shares else before, after)]
        draw_errors(axes, factor * q, [factor * values for values in errors], ("before", "after"))
        if smooth:
            line = np.sum([share[1] for share in shares.values()], axis=0)
            axes.plot(factor * next(iter(smooth.values()))[0], factor * line, color="k", lw=1.3)
        elif shares:
            axes.plot(factor * q, factor * joint_errors(levers, moved)[:, j], "k.", ms=3)
        elif not at_joints(named):
            axes.plot(*(factor * values for values in line_between(q, lever, before - after)), color="k", lw=1.3)
        title = "\n".join(label + ("" if share[2].any() else " (off here)") for label, share in shares.items())
        # a joint with shorter levers says little
        still = np.linalg.norm(lever, axis=1).max() < 0.02 * rows.arm.reach
        axes.set(xlabel=f"joint {j + 1} [{unit}]", ylabel=f"error [{unit}]")
        axes.set_title("hardly moves the measured point" if still else title, fontsize=9, parse_math=False)
        if j == 0:
            axes.plot([], [], color="k", lw=1.3, label="effects" if at_joints(named) else "change")
            axes.legend(frameon=False, fontsize=8, ncols=3, handletextpad=0.3, columnspacing=1.0)
        figures.append(figure)
    return figures


def at_joints(named: Collection[str]) -> list[str]:
    """Of labels those of effects at a joint: `backlash:2`."""
    return [label for label in named if ":" in label]


def caption(before: str, after: str, named: Collection[str] = ()) -> str:
    """How the pictures are read; before, after : the models in words, a comma may follow."""
    if not at_joints(named):
        return f"{READ} Red: {before}. Blue: {after}. Line: the difference of the two, in groups of rows."
    return (
        f"{READ} Blue: {after}. Red: {before}; but where effects stand above a picture, the blue model without these. "
        "Line, or the smallest dots: what these effects add, as the model has them. A wave in the red dots that the "
        "line follows and the blue dots lack is explained."
    )


def draw_errors(axes: Axes, angles: Array, errors: Sequence[Array], names: Sequence[str]) -> None:
    """Points of two models; the one in a hundred that is farthest does not set the scale."""
    few: dict[str, Any] = {"ms": 4, "alpha": 0.7}
    style = few if len(angles) <= MANY else {"ms": 1.5, "alpha": 0.25, "rasterized": True}
    axes.axhline(0.0, color=LIMIT, lw=0.8)
    for values, color, name in zip(errors, (BEFORE, AFTER), names, strict=True):
        axes.plot(angles, values, ".", color=color, **style)
        axes.plot([], [], ".", color=color, label=name)
    scale = 1.25 * max(float(np.percentile(np.abs(values), 99.0)) for values in errors) or 1.0
    axes.set(ylim=(-scale, scale))
    axes.locator_params(axis="y", nbins=6)


# -- residuals ---------------------------------------------------------------------------------------------------------
def residual_figure(arm: Arm, postures: Array, positions: Array, before: Array, after: Array) -> Figure:
    """Residuals (m, d) before and after, over the workspace (arrows, enlarged) and against each joint."""
    views = 1 + (before.shape[1] > 2)
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
    dimension, values = pairs[0][0].shape[1], Model(arm).best_known
    stand = [values.get(name, 0.0) for name in arm.chain.base_shift if not arm.chain.frame_kinds]
    views = [(0, 1)] if dimension < 3 else [(0, 1), (0, 2)]  # from above, in space from the side too
    grid = figure.subplots(len(views), 2, sharex=True, sharey="row", squeeze=False)
    scale = 0.12 * arm.reach / (max(float(distances(residuals).max()) for residuals, _ in pairs) or 1.0)
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004}
    for column, (residuals, name), color in zip(grid.T, pairs, (BEFORE, AFTER), strict=True):
        title = f"{name}: RMS {rms_distance(residuals):.4g} mm{f', arrows x {scale:.0f}' if dimension > 1 else ''}"
        column[0].set_title(title, fontsize=9, parse_math=False)
        for axis, (across, up) in zip(column, views, strict=True):
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
            axis.plot(*(stand or ([], [])), "ks", ms=5)
    return [list(column) for column in grid.T]


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
    views = 1 + (result.residuals.shape[1] > 2)
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
def signed_of(diagnosis: Diagnosis) -> list[Figure | str]:
    """Residuals of the data with their sign, against each joint, and how they are read."""
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    named = (*diagnosis.effects, *(curve.key for curve in diagnosis.curves))
    postures, before, after = (values[kept] for values in (postures_of(diagnosis), shown.before, shown.after))
    rows = postures, before, after, shown.conditions.rows(kept)
    compared = Compared(diagnosis.arm, *rows, Model(diagnosis.extended_arm()), named)
    how = f"{READ} Nothing is named: before and after are nearly one model."
    how = caption("the model without what is named", "the model with what is named", named) if named else how
    return [how, *signed_figures(compared)]


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
    postures = postures_of(diagnosis)[kept]
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


def postures_of(diagnosis: Diagnosis) -> Array:
    """(m, n) [rad]."""
    return np.column_stack([q for name, q in diagnosis.residuals.against.items() if name.startswith("joint ")])


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
