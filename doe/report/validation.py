"""Residuals of a calibrated model on other measurements: tables for a terminal, and a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.text import Text

from doe.report.gap_figures import binned_rms
from doe.report.pictures import AFTER, BEFORE, MANY, base_of, draw_residual_arrows, projections, workspace_axes
from doe.report.terminal import number, table
from identification.arrays import Array
from identification.measurements import distances
from identification.validate import HARDLY, Figures, Validation

REFITTED = {
    "base": "position and rotation of the base refitted",
    "offsets": "joint offsets and position of the base refitted",
    "none": "nothing refitted",
}


def validation_tables(found: Validation) -> list[Any]:
    """Drawing and model over all rows, then block by block."""
    sessions = f" in each of {len(found.refitted)} sessions" if len(found.refitted) > 1 else ""
    points = " and the measured points" if found.arm.chain is not None and found.refit != "none" else ""
    summary = f"{len(found.residuals)} rows, {REFITTED[found.refit]}{points}{sessions}; everything else as in the file"
    figures_of = ("RMS", "mean", "95 %\nbelow", "largest")
    rows = ((name, *_cells(figures)) for name, figures in (("drawing", found.nominal), ("model", found.model)))
    shown: list[Any] = [summary, table(("", *figures_of), rows, "Distances in mm", left=("",))]
    if found.model.rms >= found.nominal.rms:
        shown.append("On these rows the model is no better than the drawing.")
    shown += [Text(note, style="bold") for note in found.notes]
    doubtful = found.model.rms >= found.nominal.rms or any(HARDLY in note for note in found.notes)
    if doubtful and found.refit != "offsets":
        shown.append("Have zeros moved? --refit offsets tells; armcal identify MODEL DATA --only joint_offsets,base")
    if blocks := found.blocks:
        lines = (
            [block.kind, block.name, str(block.rows), number(block.nominal.rms), *_cells(block.model)]
            for block in blocks
        )
        headings = ("block", "which", "rows", "RMS\ndrawing", *figures_of)
        shown.append(table(headings, lines, "Block by block, in mm", left=("block", "which")))
    return shown


def _cells(figures: Figures) -> list[str]:
    return [number(value) for value in vars(figures).values()]


def _draw_distances(axis: Axes, distances: Array, color: str, name: str) -> None:
    row = np.arange(1.0, len(distances) + 1.0)
    style: dict[str, Any] = (
        {"ms": 3, "alpha": 0.5} if len(distances) <= MANY else {"ms": 1, "alpha": 0.2, "rasterized": True}
    )
    axis.plot(row, distances, ".", color=color, **style)
    axis.plot(*binned_rms(row, distances), color=color, lw=1.8, label=name)


def validation_figure(found: Validation) -> Figure:
    """Distances of drawing and model in the order of measurement, and their residuals over the workspace."""
    views = len(projections(found.residuals.shape[1]))
    figure = Figure(figsize=(10.0, 2.8 + 4.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.0, 1.7 * views]))
    pairs = ((found.nominal_residuals, BEFORE, "drawing"), (found.residuals, AFTER, "model"))
    axis = top.subplots()
    for residuals, color, name in pairs:
        _draw_distances(axis, distances(residuals[found.measurements.sequence]), color, name)
    axis.set(xlabel="measurement, in order", ylabel="distance [mm]", ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    largest = max(float(distances(residuals).max()) for residuals, _, _ in pairs) or 1.0
    scale = 0.12 * found.arm.reach / largest
    for column, (residuals, color, name) in zip(workspace_axes(bottom, found.residuals.shape[1]), pairs, strict=True):
        draw_residual_arrows(column, found.measurements.positions, residuals, color, name, scale, base_of(found.arm))
    return figure
