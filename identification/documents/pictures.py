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
from identification.documents.identification import reading_unit
from identification.effects import Effect
from identification.error_curve import all_hold
from identification.estimation.uncertainty import quantile_95
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS
from identification.measurements import POINT, distances, rms_distance
from identification.model import Model

if TYPE_CHECKING:
    from identification.gap.detectability import Detectability
    from identification.gap.result import Diagnosis

BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"
TITLED = 4  # lines of the title of a small picture, which names effects
READ = "Each dot is one row: the error of this joint that would best explain what is left (measured less computed)."
Pairs = Sequence[tuple[Array, str]]  # what two models leave, and their names


def dots(axes: Axes, x: Array, pairs: Pairs) -> None:
    """Values (m,) of two models as points; of very many smaller ones, as pixels in vector formats."""
    style: dict[str, Any] = {"ms": 1.5, "alpha": 0.25, "rasterized": True} if len(x) > 500 else {"ms": 4, "alpha": 0.7}
    for (values, name), color in zip(pairs, (BEFORE, AFTER), strict=True):
        axes.plot(x, values, ".", color=color, **style)
        axes.plot([], [], ".", color=color, label=name)
    if axes.get_yscale() == "linear":
        axes.locator_params(axis="y", nbins=6)


# -- signed errors of joints -------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Compared:
    """Residuals (m, d) [mm], measured less computed, of two models at postures (m, n).

    model : the later one;  named : labels of its effects that the earlier one has not
    """

    arm: Arm
    postures: Array
    before: Array
    after: Array
    conditions: Conditions | None = None
    model: Model | None = None
    named: Collection[str] = ()

    @property
    def levers(self) -> Array:
        """(m, d, n) what an error of each joint moves the measured point by [mm/rad, 1]."""
        return Model(self.arm).joint_levers(self.postures, conditions=self.conditions)[:, POINT]

    @property
    def errors(self) -> tuple[Array, Array]:
        """(m, n) errors of each joint [rad, mm] that the residuals of either model mean."""
        levers = self.levers
        before, after = (joint_errors(levers, r[:, : levers.shape[1]]) for r in (self.before, self.after))
        return before, after

    def pictures(self, before: str, after: str) -> Pictures:
        """The pictures and how they are read; before, after : the models in words, a comma may follow"""
        how = f"{READ} Red: {before}. Blue: {after}."
        if at_joints(self.named):
            how = (
                f"{READ} Blue: {after}. Red: {before}; but where effects stand above a picture, the blue model without "
                "these. Line, or the smallest dots: what these effects add, as the model has them. A wave in the red "
                "dots that the line follows and the blue dots lack is explained."
            )
        return Pictures(lambda: [how, *signed_figures(self)])


def at_joints(named: Collection[str]) -> list[str]:
    """Of labels those of effects at a joint: `backlash:2`."""
    return [label for label in named if ":" in label]


def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, 0.3**2 * squares.max(axis=0))  # of shorter levers a row counts less
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def share_of(model: Model, effect: Effect, rows: Compared, lever: Array) -> tuple[Array, Array, Array, bool]:
    """What an effect adds at its joint: (721,) angles over the range of the rows and the errors there, in the mean of
    eight postures; (m, d) what it does to the rows [mm]; whether it is a function of the angle alone, as far as the
    rows show: a backlash is none. A curve acts where all curves hold."""
    assert effect.joint is not None
    joint = effect.joint - 1
    q = rows.postures[:, joint]
    grid = np.linspace(q.min(), q.max(), 721)
    if effect.curve is not None:
        curves = [(e.joint - 1, e.curve) for e in model.effects if e.curve is not None and e.joint is not None]
        moved = lever * (all_hold(curves, rows.postures) * effect.curve.at(q))[:, None]
        return grid, effect.curve.at(grid), moved, True
    names = {p.name for p in effect.parameters}
    without = np.where([name in names for name in model.names], 0.0, model.values)

    def moved_by_it(postures: Array, conditions: Conditions | None, dimension: int) -> Array:
        position = (model.position(postures, values, conditions) for values in (None, without))
        return np.nan_to_num(np.subtract(*position))[:, :dimension]

    chosen = rows.postures[np.linspace(0, len(q) - 1, min(len(q), 8)).astype(int)]
    densely = np.tile(chosen, (len(grid), 1))
    densely[:, joint] = np.repeat(grid, len(chosen))
    levers = model.joint_levers(densely)[:, POINT, joint]
    along = np.sum(levers * moved_by_it(densely, None, levers.shape[1]), axis=1).reshape(len(grid), -1).sum(axis=1)
    square = np.sum(levers**2, axis=1).reshape(len(grid), -1).sum(axis=1)
    line = np.divide(along, square, out=np.zeros(len(grid)), where=square > 0.0)
    moved = moved_by_it(rows.postures, rows.conditions, lever.shape[1])
    left = moved - lever * np.interp(q, grid, line)[:, None]
    # True: its function of the angle is nearly all that the effect does
    return grid, line, moved, bool(np.linalg.norm(left) <= 0.1 * np.linalg.norm(moved))


def signed_figures(rows: Compared) -> list[Figure]:
    """A picture for each joint: its error by the residuals of both models, and what named effects add.

    Shown are the named effects that are functions of the joint's angle, as lines, or else those that are not, at rows.
    """
    levers, errors, figures = rows.levers, rows.errors, []
    effects = [] if rows.model is None else [(rows.model, e) for e in rows.model.effects if e.label in rows.named]
    black: dict[str, Any] = {"color": "k", "lw": 1.3}
    for j, kind in enumerate(Model(rows.arm).joint_types):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes, q, lever = figure.subplots(), factor * rows.postures[:, j], levers[:, :, j]
        shares = {e.label: share_of(model, e, rows, lever) for model, e in effects if e.joint == j + 1}
        smooth = {label: share for label, share in shares.items() if share[3]}
        before, after = (factor * each[:, j] for each in errors)
        for grid, *_ in [*smooth.values()][:1]:
            axes.plot(factor * grid, factor * np.sum([share[1] for share in smooth.values()], axis=0), **black)
        if shares := smooth or shares:
            added = factor * joint_errors(levers, np.sum([share[2] for share in shares.values()], axis=0))[:, j]
            before = after + added
            if not smooth:
                axes.plot(q, added, "k.", ms=3)
        axes.axhline(0.0, color=LIMIT, lw=0.8)
        dots(axes, q, ((before, "before"), (after, "after")))
        # the one in a hundred that is farthest does not set the scale
        scale = 1.25 * max(float(np.percentile(np.abs(values), 99.0)) for values in (before, after)) or 1.0
        # a joint with shorter levers says little
        still = np.linalg.norm(lever, axis=1).max() < 0.02 * rows.arm.reach
        axes.set(xlabel=f"joint {j + 1} [{unit}]", ylabel=f"error [{unit}]", ylim=(-scale, scale))
        title = (
            [*shares] if len(shares) <= TITLED else [*[*shares][: TITLED - 1], f"and {len(shares) - TITLED + 1} more"]
        )
        axes.set_title("hardly moves the measured point" if still else "\n".join(title), fontsize=9, parse_math=False)
        if j == 0:
            if at_joints(rows.named):
                axes.plot([], [], label="effects", **black)
            axes.legend(frameon=False, fontsize=8, ncols=3, handletextpad=0.3, columnspacing=1.0)
        figures.append(figure)
    return figures


# -- residuals ---------------------------------------------------------------------------------------------------------
def residual_figure(arm: Arm, postures: Array, positions: Array, before: Array, after: Array) -> Figure:
    """Residuals (m, d) before and after, over the workspace (arrows, enlarged) and against each joint."""
    views = 1 + (before.shape[1] > 2)
    figure = Figure(figsize=(10.0, 2.6 + 3.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.3 * views, 1.0]))
    pairs = (before, "before"), (after, "after")
    draw_workspace(top, arm, positions, pairs)
    (strips,) = bottom.subplots(1, postures.shape[1], sharey=True, squeeze=False)
    for j, axis in enumerate(strips):
        dots(axis, np.degrees(postures[:, j]), [(distances(residuals), name) for residuals, name in pairs])
        axis.set(xlabel=f"$q_{j + 1}$ [deg]", yscale="log")
    strips[0].set_ylabel(f"residual [{reading_unit(arm)}]")
    return figure


def workspace_arrows(arm: Arm, positions: Array, pairs: Pairs) -> Figure:
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


def draw_workspace(figure: Figure | SubFigure, arm: Arm, positions: Array, pairs: Pairs) -> list[list[Axes]]:
    """Residual arrows of two models in two columns of axes, with one for each projection, on one scale: the largest
    arrow is an eighth of the reach; and where a planar arm stands."""
    dimension, values = pairs[0][0].shape[1], Model(arm).best_known
    stand = [values.get(name, 0.0) for name in arm.chain.base_shift if not arm.chain.frame_kinds]
    views, unit = [(0, 1)] if dimension < 3 else [(0, 1), (0, 2)], reading_unit(arm)  # in space from the side too
    grid = figure.subplots(len(views), 2, sharex=True, sharey="row", squeeze=False)
    scale = 0.12 * arm.reach / (max(float(distances(residuals).max()) for residuals, _ in pairs) or 1.0)
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "width": 0.004}
    for column, (residuals, name), color in zip(grid.T, pairs, (BEFORE, AFTER), strict=True):
        title = f"{name}: RMS {rms_distance(residuals):.4g} {unit}{f', arrows x {scale:.0f}' if dimension > 1 else ''}"
        column[0].set_title(title, fontsize=9, parse_math=False)
        for axis, (across, up) in zip(column, views, strict=True):
            if dimension == 1:  # lengths, as they are, against what was measured
                axis.plot(positions[:, 0], residuals[:, 0], ".", color=color, ms=4, alpha=0.7)
                axis.set(xlabel=f"measured length [{unit}]", ylabel=f"residual [{unit}]")
                continue
            x, y, along, upward = (v[:, k] for v in (positions, residuals * scale) for k in (across, up))
            axis.quiver(x, y, along, upward, color=color, rasterized=len(positions) > 500, **style)
            axis.update_datalim(np.column_stack([x + along, y + upward]))  # whole arrows
            axis.autoscale_view()
            axis.set(aspect="equal", xlabel=f"{'xyz'[across]} [{unit}]", ylabel=f"{'xyz'[up]} [{unit}]")
            axis.plot(*(stand or ([], [])), "ks", ms=5)
    return [list(column) for column in grid.T]


def draw_distances(axis: Axes, x: Array, pairs: Pairs) -> None:
    """Distances (m,) of two models as points, and their RMS in up to twelve groups of rows as lines."""
    dots(axis, x, pairs)
    groups = np.array_split(np.argsort(x, kind="stable"), min(12, max(1, len(x) // 4)))
    middle = [np.mean(x[g]) for g in groups]
    for (values, _), color in zip(pairs, (BEFORE, AFTER), strict=True):
        axis.plot(middle, [np.sqrt(np.mean(values[g] ** 2)) for g in groups], color=color, lw=1.8)
    axis.set(ylim=(0, None))


# -- diagnoses ---------------------------------------------------------------------------------------------------------
def signed_of(diagnosis: Diagnosis) -> Sequence[Figure | str]:
    """Residuals of the data with their sign, against each joint, and how they are read."""
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    named = (*diagnosis.effects, *(curve.key for curve in diagnosis.curves))
    postures, before, after = (values[kept] for values in (postures_of(diagnosis), shown.before, shown.after))
    rows = postures, before, after, shown.conditions.rows(kept)
    compared = Compared(diagnosis.arm, *rows, Model(diagnosis.extended_arm()), named)
    last = "the model with what is named" if named else "the model, of which nothing is named"
    return compared.pictures("the model without what is named", last).draw()


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
        axis.set(xlabel=name.replace("[rad]", "[deg]"), ylabel=f"residual [{reading_unit(diagnosis.arm)}]")

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
