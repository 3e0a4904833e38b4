"""Pictures of a diagnosis: residuals before and after, and which effects are hard to distinguish."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from doe.report.pictures import (
    AFTER,
    BEFORE,
    LIMIT,
    MANY,
    TICKS,
    base_of,
    draw_residual_arrows,
    to_scale,
    workspace_axes,
)
from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.intervals import quantile_95
from identification.gap.detectability import Detectability
from identification.gap.result import Diagnosis
from identification.measurements import distances
from identification.model import Model

COLUMNS = 3
BINS = 12
GROUPS = 200  # of rows, along an error curve


def against_figure(diagnosis: Diagnosis) -> Figure:
    """Residual distances before and after, against each joint, time, torque, in one picture."""
    count = len(diagnosis.residuals.against)
    rows = -(-count // COLUMNS)
    figure = Figure(figsize=(10.0, 2.3 * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, COLUMNS, sharey=True)).ravel()
    for axis in axes[count:]:
        axis.set_visible(False)
    draw_against(diagnosis, axes[:count].tolist())
    for axis in axes[::COLUMNS]:
        axis.set_ylabel("residual [mm]")
    return figure


def against_figures(diagnosis: Diagnosis) -> list[Figure]:
    """The same as pictures of their own, on one scale."""
    figures = [Figure(figsize=(3.7, 2.5), layout="constrained") for _ in diagnosis.residuals.against]
    axes = [figure.subplots() for figure in figures]
    draw_against(diagnosis, axes)
    highest = max(axis.get_ylim()[1] for axis in axes)
    for axis in axes:
        axis.set(ylim=(0, highest), ylabel="residual [mm]")
    return figures


def draw_against(diagnosis: Diagnosis, axes: Sequence[Axes]) -> None:
    """Points, and the RMS in twelve bins.

    Outlier rows are left out, as they were in the tests: a single displaced target would set the scale.
    """
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    for axis, (name, values) in zip(axes, shown.against.items(), strict=True):
        x, label = (np.degrees(values), name.replace("[rad]", "[deg]")) if "[rad]" in name else (values, name)
        for residuals, color, when in ((shown.before, BEFORE, "before"), (shown.after, AFTER, "after")):
            distance = distances(residuals[kept])
            few: dict[str, Any] = {"ms": 3, "alpha": 0.5}
            style = few if len(distance) <= MANY else {"ms": 1, "alpha": 0.2, "rasterized": True}
            axis.plot(x[kept], distance, ".", color=color, **style)
            axis.plot(*binned_rms(x[kept], distance), color=color, lw=1.8, label=when)
        axis.set(xlabel=label, ylim=(0, None))
        axis.locator_params(axis="y", nbins=TICKS)
    axes[0].legend(frameon=False, fontsize=8)


def rows_kept(diagnosis: Diagnosis) -> NDArray[np.bool_]:
    """(m,) False for outlier rows."""
    kept = np.ones(len(diagnosis.residuals.before), dtype=bool)
    kept[np.array(diagnosis.outlier_rows, dtype=int) - 1] = False
    return kept


def binned_rms(x: Array, distance: Array) -> tuple[Array, Array]:
    """Mean position and RMS in up to twelve bins of equal numbers of rows."""
    groups = np.array_split(np.argsort(x, kind="stable"), min(BINS, max(1, len(x) // 4)))
    middle = np.array([np.mean(x[g]) for g in groups])
    return middle, np.array([np.sqrt(np.mean(distance[g] ** 2)) for g in groups])


def workspace_figure(diagnosis: Diagnosis) -> Figure:
    """Residual arrows over the workspace, before and after, on one scale; without outlier rows."""
    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    pairs = ((shown.before[kept], "before"), (shown.after[kept], "after"))
    return workspace_arrows(diagnosis.extended_arm(), shown.positions[kept], pairs)


def workspace_arrows(arm: Arm, positions: Array, pairs: Sequence[tuple[Array, str]]) -> Figure:
    """Residual arrows (m, d) of two models, with their names, at positions (m, d), on one scale."""
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = workspace_axes(figure, pairs[0][0].shape[1])
    scale = 0.12 * arm.reach / (float(distances(pairs[0][0]).max()) or 1.0)
    for column, (residuals, name), color in zip(axes, pairs, (BEFORE, AFTER), strict=True):
        draw_residual_arrows(column, positions, residuals, color, name, float(scale), base_of(arm))
    if pairs[0][0].shape[1] >= 3:
        to_scale(figure, axes)
    return figure


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


def curves_figure(diagnosis: Diagnosis) -> Figure:
    """The error curves in one picture."""
    count = len(diagnosis.curves)
    figure = Figure(figsize=(10.0, 2.2 * -(-count // 2)), layout="constrained")
    axes = figure.subplots(-(-count // 2), 2, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.set_visible(False)
    draw_curves(diagnosis, axes[:count].tolist())
    return figure


def curve_figures(diagnosis: Diagnosis) -> list[Figure]:
    """A picture for each error curve, in the order of the joints: a phone shows them below each other."""
    figures = [Figure(figsize=(3.7, 2.5), layout="constrained") for _ in diagnosis.curves]
    draw_curves(diagnosis, [figure.subplots() for figure in figures])
    return figures


def draw_curves(diagnosis: Diagnosis, axes: Sequence[Axes]) -> None:
    """Error curves with 95 % bands, and residuals that the curve explains, as angles: their mean in groups of rows."""
    seen, half = curve_residuals(diagnosis), quantile_95(min(diagnosis.named.freedom, default=np.inf))
    for axis, curve in zip(axes, sorted(diagnosis.curves, key=lambda curve: curve.joint), strict=True):
        angles, error, band = np.degrees([curve.angles, curve.error, half * curve.std])
        axis.plot(*seen[curve.key], ".", color=LIMIT, ms=3, label="rows, in groups")
        axis.fill_between(angles, error - band, error + band, color=AFTER, alpha=0.25, lw=0, label="95 %")
        axis.plot(angles, error, color=AFTER, lw=1.4, label="curve")
        axis.set(xlabel=f"$q_{curve.joint}$ [deg]", ylabel="error [deg]")
        axis.locator_params(axis="y", nbins=TICKS)
    axes[0].legend(frameon=False, fontsize=8)


def curve_residuals(diagnosis: Diagnosis) -> dict[str, tuple[Array, Array]]:
    """Curve -> angles and errors [deg] of groups of rows: what they leave along the lever arm beside the curve."""
    model, kept = Model(diagnosis.arm), rows_kept(diagnosis)
    angles = [diagnosis.residuals.against[f"joint {j + 1} [rad]"] for j in range(model.joints)]
    postures, after = np.column_stack(angles)[kept], diagnosis.residuals.after[kept]
    levers = model.joint_levers(postures)
    found = {}
    for curve in diagnosis.curves:
        q, lever = postures[:, curve.joint - 1], levers[:, :, curve.joint - 1]
        weight = np.sum(lever**2, axis=1)
        along = np.sum(lever * after, axis=1) + weight * curve.table.at(q)
        groups = np.array_split(np.argsort(q, kind="stable"), min(GROUPS, max(1, len(q) // 2)))
        middle = [float(np.mean(q[g])) for g in groups]
        found[curve.key] = np.degrees(middle), np.degrees([float(along[g].sum() / weight[g].sum()) for g in groups])
    return found
