"""Residuals as pictures: over the workspace, against each joint with their sign, time and torque; error curves.

A joint that turns by e too far moves the tip by e times its lever d tip / d q_j. The error that explains most of a
row's residual r is e = r . lever / |lever|^2; where the lever is short a row says little, and e is held small.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from identification.arm import Arm
from identification.arrays import Array
from identification.documents.identification import reading_unit
from identification.estimation.uncertainty import quantile_95
from identification.kinematics.parameters import FILE_UNITS, JOINT_UNITS, REVOLUTE
from identification.measurements import POINT, Conditions, distances, rms_distance
from identification.model import Model

if TYPE_CHECKING:
    from identification.gap.result import Diagnosis

BEFORE, AFTER, LIMIT = "#c44e52", "#2a6f97", "#888888"
READ = "Each dot is one row: the error of this joint that would best explain the residual (measured minus computed)."
Pairs = Sequence[tuple[Array, str]]  # what two models leave, and their names


def dots(axes: Axes, x: Array, pairs: Pairs) -> None:
    """Values (m,) of two models as points; of very many smaller ones, as pixels in vector formats."""
    style: dict[str, Any] = {"ms": 1.5, "alpha": 0.25, "rasterized": True} if len(x) > 500 else {"ms": 4, "alpha": 0.7}
    for (values, name), color in zip(pairs, (BEFORE, AFTER), strict=True):
        axes.plot(x, values, ".", color=color, **style)
        axes.plot([], [], ".", color=color, label=name)
    axes.locator_params(axis="y", nbins=6)


# -- against joints ----------------------------------------------------------------------------------------------------
def joint_errors(levers: Array, residuals: Array) -> Array:
    """(m, n) errors of each joint [rad, mm] that residuals (m, d) [mm] mean, by levers (m, d, n)."""
    squares = np.sum(levers**2, axis=1)
    clear = np.maximum(squares, 0.3**2 * squares.max(axis=0))  # of shorter levers a row counts less
    along = np.einsum("mdn,md->mn", levers, residuals)
    return np.divide(along, clear, out=np.zeros_like(along), where=clear > 0.0)


def signed_figures(arm: Arm, postures: Array, pairs: Pairs, conditions: Conditions | None) -> list[Figure | str]:
    """How they are read, and the errors of each joint that residuals (m, d) [mm] of two models mean at postures."""
    levers = Model(arm).joint_levers(postures, conditions=conditions)[:, POINT]
    errors = [joint_errors(levers, residuals[:, : levers.shape[1]]) for residuals, _ in pairs]
    shown: list[Figure | str] = [f"{READ} Red: {pairs[0][1]}. Blue: {pairs[1][1]}."]
    for j, kind in enumerate(Model(arm).joint_types):
        unit, factor, _ = FILE_UNITS[JOINT_UNITS[kind]]
        figure = Figure(figsize=(3.7, 2.5), layout="constrained")
        axes, values = figure.subplots(), [factor * each[:, j] for each in errors]
        axes.axhline(0.0, color=LIMIT, lw=0.8)
        dots(axes, factor * postures[:, j], [*zip(values, ("before", "after"), strict=True)])
        # the one in a hundred that is farthest does not set the scale
        scale = 1.25 * max(float(np.percentile(np.abs(each), 99.0)) for each in values) or 1.0
        axes.set(xlabel=f"joint {j + 1} [{unit}]", ylabel=f"error [{unit}]", ylim=(-scale, scale))
        usual = arm.reach if kind == REVOLUTE else 1.0  # [mm/rad, 1]
        if np.linalg.norm(levers[:, :, j], axis=1).max() < 0.02 * usual:  # its dots say little
            axes.set_title("hardly moves the measured point", fontsize=9)
        if j == 0:
            axes.legend(frameon=False, fontsize=8, ncols=2, handletextpad=0.3, columnspacing=1.0)
        shown.append(figure)
    return shown


# -- residuals ---------------------------------------------------------------------------------------------------------
def workspace_arrows(arm: Arm, positions: Array, pairs: Pairs) -> Figure:
    """Residual arrows (m, d) of two models, with their names, at positions (m, d), in two columns with a row for each
    projection, on one scale: the largest arrow is an eighth of the reach, or as it is where all are at one position."""
    dimension, names = pairs[0][0].shape[1], [each.name for each in arm.chain.instrument.coordinates] or arm.chain.axes
    views, unit = [(0, 1)] if dimension < 3 else [(0, 1), (0, 2)], reading_unit(arm)  # in space from the side too
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    grid = figure.subplots(len(views), 2, sharex=True, sharey="row", squeeze=False)
    largest = max(float(distances(residuals).max()) for residuals, _ in pairs) or 1.0
    scale = 0.12 * arm.reach / largest if np.ptp(positions, axis=0).any() else 1.0  # of contacts all read zero
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
            axis.set(aspect="equal", xlabel=f"{names[across]} [{unit}]", ylabel=f"{names[up]} [{unit}]")
    if dimension > 1:  # rows of one scale as high as what they show, and the figure as high as all of them
        boxes = [axis.dataLim for axis in grid[:, 0]]
        shares = [float(np.clip(box.height / box.width, 0.25, 1.5)) if box.width else 1.0 for box in boxes]
        grid[0, 0].get_gridspec().set_height_ratios(shares)
        figure.set_figheight(0.2 + sum(0.6 + 0.44 * figure.get_figwidth() * share for share in shares))
    return figure


# -- diagnoses, without outlier rows, which would set the scale --------------------------------------------------------
def kept_rows(diagnosis: Diagnosis) -> tuple[NDArray[np.int64], Array, Pairs]:
    """Numbers of the rows that are no outliers, their postures (m, n) [rad], and what is left of them (m, d) [mm]."""
    kept = np.flatnonzero(diagnosis.kept)
    pairs = [(diagnosis.residuals_before[kept], "before"), (diagnosis.residuals_after[kept], "after")]
    return kept, diagnosis.measurements.postures[kept], pairs


def signed_of(diagnosis: Diagnosis) -> Sequence[Figure | str]:
    """Residuals of the data with their sign, against each joint, and how they are read."""
    kept, postures, ((before, _), (after, _)) = kept_rows(diagnosis)
    last = f"the model{' with what is' if diagnosis.effects or diagnosis.curves else ', with nothing'} named"
    pairs = [(before, "the model without what is named"), (after, last)]
    return signed_figures(diagnosis.arm, postures, pairs, diagnosis.measurements.conditions.rows(kept))


def gap_figure(diagnosis: Diagnosis) -> Figure:
    """Residual arrows over the workspace, before and after."""
    kept, _, pairs = kept_rows(diagnosis)
    return workspace_arrows(diagnosis.extended_arm(), diagnosis.measurements.positions[kept], pairs)


def against_figure(diagnosis: Diagnosis) -> Figure:
    """Residual distances before and after, against each joint, time, and torque and temperature where known."""
    kept, postures, pairs = kept_rows(diagnosis)
    apart = [(distances(residuals), name) for residuals, name in pairs]
    arm, measurements, conditions = diagnosis.arm, diagnosis.measurements, diagnosis.measurements.conditions.rows(kept)
    units = [FILE_UNITS[JOINT_UNITS[kind]] for kind in Model(arm).joint_types]
    joints = enumerate(zip(units, postures.T, strict=True), start=1)
    against: dict[str, Array] = {f"joint {j} [{unit}]": factor * q for j, ((unit, factor, _), q) in joints}
    against["time"] = np.zeros(len(kept)) if conditions.time is None else conditions.time
    if arm.gravity is not None:
        torques = Model(arm).torques(postures, conditions)
        against |= {f"torque {j} [N m]": torque for j, torque in enumerate(torques.T, start=1)}
    if measurements.temperature is not None:
        against["temperature [C]"] = measurements.temperature[kept]

    def draw(axis: Axes, name: str) -> None:
        dots(axis, x := against[name], apart)
        # and the RMS in up to twelve groups of rows
        groups = np.array_split(np.argsort(x, kind="stable"), min(12, max(1, len(x) // 4)))
        for (distance, _), color in zip(apart, (BEFORE, AFTER), strict=True):
            root = [np.sqrt(np.mean(distance[g] ** 2)) for g in groups]
            axis.plot([np.mean(x[g]) for g in groups], root, color=color, lw=1.8)
        axis.set(xlabel=name, ylabel=f"residual [{reading_unit(arm)}]", ylim=(0, None))

    return panels([*against], 3, 2.3, draw, sharey=True)


def curves_figure(diagnosis: Diagnosis) -> Figure:
    """Error curves with 95 % bands, and what up to 200 groups of rows say along the lever arm, as angles."""
    half = quantile_95(np.min(diagnosis.named.uncertainty.freedom, initial=np.inf))
    _, postures, (_, (after, _)) = kept_rows(diagnosis)
    levers = Model(diagnosis.arm).joint_levers(postures)

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


def panels(items: Sequence[Any], columns: int, height: float, draw: Callable[[Axes, Any], Any], **style: Any) -> Figure:
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
