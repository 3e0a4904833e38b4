"""How many runs: the curve and the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.text import Text

from doe.advise import Advice
from doe.design import Design
from doe.report.pictures import AFTER, BEFORE
from doe.report.terminal import number, table

NONE = "None of these plans is within 0.1 % of the bound."


def advice_figure(advice: Advice) -> Figure:
    """Efficiency and expected accuracy against the number of runs."""
    accuracies = [advice.accuracy(design) for design in advice.designs]
    known = all(accuracy is not None for accuracy in accuracies)
    figure = Figure(figsize=(10.0, 3.6) if known else (6.0, 3.6), layout="constrained")
    axes = figure.subplots(1, 2 if known else 1, squeeze=False)[0]
    _draw_efficiencies(axes[0], advice)
    if known:
        axes[1].plot(advice.runs, accuracies, "o-", color=AFTER, ms=4, lw=1)
        if advice.target is not None:
            axes[1].axhline(advice.target, color=BEFORE, ls="--", lw=1)
        what = "expected error of the tip, model right [mm]" if advice.of_tip else "largest std of a length [mm]"
        axes[1].set(xlabel="runs m", ylabel=what, ylim=(0, None))
    return figure


def _draw_efficiencies(axes: Axes, advice: Advice) -> None:
    good = set(advice.efficient_runs())
    efficiencies = [design.efficiency or float("nan") for design in advice.designs]
    axes.plot(advice.runs, efficiencies, color=AFTER, lw=1)
    colors = [AFTER if m in good else "white" for m in advice.runs]
    axes.scatter(advice.runs, efficiencies, c=colors, edgecolors=AFTER, s=30, zorder=3)
    axes.set(xlabel="runs m", ylabel="D-efficiency", title="filled: within 0.1 % of the bound")


def advice_tables(advice: Advice) -> list[Any]:
    """The answer in one sentence, then a row per number of runs."""
    good = set(advice.efficient_runs())

    def row(design: Design) -> list[str]:
        known = design.deviations
        largest = (None, None) if known is None else (known.largest_length, float(np.degrees(known.largest_angle)))
        m, figures = len(design.plan), () if advice.of_tip else largest
        return [str(m), number(design.efficiency, 5), "yes" if m in good else "", *(number(v, 5) for v in figures)]

    figures = () if advice.of_tip else ("largest std of a length [mm]", "of an angle [deg]")
    headings = ("runs", "efficiency", "within 0.1 % of the bound", *figures)
    shown = [Text(sentence(advice), style="bold"), table(headings, map(row, advice.designs))]
    return [*shown, *tip_error_table(advice)]


def tip_error_table(advice: Advice) -> list[Any]:
    """Expected error of the tip where nothing was measured, and what to do about effects that may be missing."""
    if not advice.tip_errors:
        return []
    headings = ("runs", "model right [mm]", "worst pose [mm]", "effects missing [mm]", "missing, identify --prior [mm]")
    pairs = zip(advice.runs, advice.tip_errors, strict=True)
    rows = ([str(m), *(number(v, 4) for v in (e.right, e.worst, e.missing, e.with_prior))] for m, e in pairs)
    title = "Expected error of the tip (RMS over the workspace; effects of typical size missing in the model)"
    advised = (
        "The last two figures may rise with the runs, since these plans do not look for missing effects. Where effects "
        "may be missing, choose the postures with armcal design --robust."
    )
    return [table(headings, rows, title), Text(advised)]


def sentence(advice: Advice) -> str:
    """What to do, in one line."""
    good = ", ".join(spans(advice.efficient_runs()))
    efficient = f"Plans within 0.1 % of the bound exist for m = {good}." if good else NONE
    if advice.target is None:
        return efficient
    smallest = advice.smallest
    if smallest is None:
        return f"No number of runs up to {max(advice.runs)} reaches {advice.target:g} mm. {efficient}"
    of = "at the tip" if advice.of_tip else "in each length"
    errors = (e for design, e in zip(advice.designs, advice.tip_errors, strict=False) if design is smallest)
    missing = "".join(f"; at the tip {number(e.missing, 4)} mm if effects of typical size are missing" for e in errors)
    suffice = f"{len(smallest.plan)} runs suffice for {advice.target:g} mm {of}, if the model is right{missing}."
    return f"{suffice} {efficient}"


def spans(runs: Sequence[int]) -> list[str]:
    """`4`, `6 to 40`: stretches of rising whole numbers, each said once."""
    found: list[list[int]] = []
    for m in sorted(runs):
        if found and m - found[-1][-1] == 1:
            found[-1].append(m)
        else:
            found.append([m])
    return [str(part[0]) if len(part) == 1 else f"{part[0]} to {part[-1]}" for part in found]
