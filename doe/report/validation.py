"""Residuals of a calibrated model on other measurements: tables for a terminal, and a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from doe.report.terminal import in_a_sentence, number, table
from identification.measurements import distances
from identification.validate import DRAWN, HARDLY, Figures, Validation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

REFITTED = {
    "base": "position and rotation of the base",
    "offsets": "joint offsets, position of the base",
}


def validation_tables(found: Validation) -> list[Any]:
    """Verdict, drawing and model over all rows, then block by block."""
    figures_of = ("RMS", "mean", "95 %\nbelow", "largest")
    rows = ((name, *_cells(figures)) for name, figures in (("drawing", found.nominal), ("model", found.model)))
    shown: list[Any] = [Text(predicted_in_words(found), style="bold")]
    shown += [Text(note, style="bold") for note in found.notes if HARDLY not in note]
    shown += [refitted_in_words(found), table(("", *figures_of), rows, "Distances in mm", left=("",))]
    if blocks := found.blocks:
        lines = (
            [block.kind, block.name, str(block.rows), number(block.nominal.rms), *_cells(block.model)]
            for block in blocks
        )
        headings = ("block", "which", "rows", "RMS\ndrawing", *figures_of)
        shown.append(table(headings, lines, "Block by block, in mm", left=("block", "which"), padding=0))
    return shown


def refitted_in_words(found: Validation) -> str:
    """How many rows there are, and what was fitted to them."""
    if found.refit == "none":
        return f"{len(found.residuals)} rows, nothing refitted"
    sessions = f" in each of {len(found.refitted)} sessions" if len(found.refitted) > 1 else ""
    what = f"{REFITTED[found.refit]}{'' if found.arm.chain is None else ', measured points'}"
    return f"{len(found.residuals)} rows, refitted{sessions}: {what}; everything else as in the file"


def predicted_in_words(found: Validation) -> str:
    """How well the model predicts, and what the calibration is worth, in a sentence or two."""
    model, drawing = in_a_sentence(found.model.rms), in_a_sentence(found.nominal.rms)
    kind = "positions" if found.measurements.dimension > 1 else "readings"
    rows = f"The model predicts these {len(found.residuals)} {kind}"
    if not better(found):
        worse = HARDLY if found.model.rms < found.nominal.rms else "no better"
        return f"{rows} {worse} than the drawing: {model} mm RMS against {drawing} mm RMS, {DRAWN[found.refit]}."
    removed = 1.0 - found.model.rms / found.nominal.rms
    gain = f"The calibration removes {100.0 * removed:.0f} % of the error."
    return f"{rows} to {model} mm RMS; drawing: {drawing} mm RMS, {DRAWN[found.refit]}. {gain}"


def better(found: Validation) -> bool:
    """Whether the model is better than the drawing, by more than the rows scatter."""
    return found.model.rms < found.nominal.rms and not any(HARDLY in note for note in found.notes)


def _cells(figures: Figures) -> list[str]:
    return [number(value) for value in vars(figures).values()]


def validation_figure(found: Validation) -> Figure:
    """Distances of drawing and model in the order of measurement, and their residuals over the workspace."""
    from matplotlib.figure import Figure  # deferred: tables need no pictures

    from doe.report.gap_figures import binned_rms
    from doe.report.pictures import AFTER, BEFORE, MANY, base_of, draw_residual_arrows, projections, workspace_axes

    views = len(projections(found.residuals.shape[1]))
    figure = Figure(figsize=(10.0, 2.8 + 4.6 * views), layout="constrained")
    top, bottom = np.asarray(figure.subfigures(2, 1, height_ratios=[1.0, 1.7 * views]))
    pairs = ((found.nominal_residuals, BEFORE, "drawing"), (found.residuals, AFTER, "model"))
    axis, row = top.subplots(), np.arange(1.0, len(found.residuals) + 1.0)
    few: dict[str, Any] = {"ms": 3, "alpha": 0.5}
    style = few if len(row) <= MANY else {"ms": 1, "alpha": 0.2, "rasterized": True}
    for residuals, color, name in pairs:
        errors = distances(residuals[found.measurements.sequence])
        axis.plot(row, errors, ".", color=color, **style)
        axis.plot(*binned_rms(row, errors), color=color, lw=1.8, label=name)
    axis.set(xlabel="measurement, in order", ylabel="distance [mm]", ylim=(0, None))
    axis.legend(frameon=False, fontsize=8)
    largest = max(float(distances(residuals).max()) for residuals, _, _ in pairs) or 1.0
    scale = 0.12 * found.arm.reach / largest
    for column, (residuals, color, name) in zip(workspace_axes(bottom, found.residuals.shape[1]), pairs, strict=True):
        draw_residual_arrows(column, found.measurements.positions, residuals, color, name, scale, base_of(found.arm))
    return figure
