"""The blind study: tables for a terminal and the confusion matrix as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from rich.table import Table
from rich.text import Text

from doe.report.pictures import save
from doe.report.terminal import table
from doe.studies.blind.score import ALL, KEEPS, BlindStudy
from identification.arrays import Array

COLUMNS = {
    "alarm": "alarm",
    "exact": "exact",
    "class": "class",
    "in the set": "in set",
    "size of the set": "size",
    "located": "located",
    "gap / true": "gap/true",
}
RATES = ("alarm", "exact", "class", "in the set", "located")
COLORS = {"met": "green", "within its error": "yellow", "missed": "red"}


def blind_tables(found: BlindStudy) -> list[Any]:
    """Verdict, cells, further postures, targets, and the most frequent mistakes."""
    return [
        str(found),
        cell_table(found.cells),
        *many_tables(found.cells),
        *further_tables(found.cells),
        *reliability_tables(found),
        bar_table(found.bars),
        *mistakes(found),
    ]


def cell_table(cells: pl.DataFrame) -> Table:
    """One row per cell, with the largest standard error of its rates; each figure's own is in the file."""
    headings = ["hidden", "sets", *COLUMNS.values(), "+-"]
    of_cells = cells.filter(pl.col("cell") != ALL).partition_by("cell", maintain_order=True)
    rows = map(_cell_row, of_cells)
    return table(headings, rows, "Blind study", left=("hidden",), no_wrap=headings)


def _cell_row(part: pl.DataFrame) -> list[str]:
    figures = {row["measure"]: row for row in part.iter_rows(named=True)}
    shown = ("" if name not in figures else f"{figures[name]['value']:.3f}" for name in COLUMNS)
    error = max(row["standard_error"] for name, row in figures.items() if name in RATES)
    return [part["cell"][0], str(figures["alarm"]["count"]), *shown, f"{error:.3f}"]


def with_error(row: dict[str, Any]) -> str:
    """`.931(13)`: the value and its standard error in units of its last digit."""
    value = f"{row['value']:.3f}".removeprefix("0" if row["value"] < 1.0 else "")
    error = 1000.0 * row["standard_error"]
    return f"{value}({error:.0f})" if np.isfinite(error) else value


def many_tables(cells: pl.DataFrame) -> list[Table]:
    """Robots with many effects at once, and with one outside the library: means over their data sets (of the ratio to
    the error of the geometry alone the median), with standard errors."""
    tables = []
    for title, measures in MANY.items():
        shown = []
        for part in cells.partition_by("cell", maintain_order=True):
            rows = {row["measure"]: row for row in part.iter_rows(named=True)}
            if measures[0] in rows:
                figures = (with_error(rows[name]) if name in rows else "" for name in measures)
                shown.append([part["cell"][0], str(rows[measures[0]]["count"]), *figures])
        if shown:
            tables.append(table(("hidden", "sets", *measures), shown, title, left=("hidden",)))
    return tables


MANY = {
    "Many effects at once": ("error / true", "effects named", "false names", "intervals, all", "false unknown"),
    "Outside the library": ("no effect", "named at 0.9", "located", "wrong place"),
    "The model that is written": (
        "inside tip intervals",
        "error / geometry",
        "promised / reached",
        KEEPS,
        "contradiction",
    ),
}


def further_tables(cells: pl.DataFrame) -> list[Table]:
    """What becomes of ambiguous sets after further postures."""
    rows = {row["measure"]: row for row in cells.iter_rows(named=True) if row["measure"].split(" ")[0] in WAYS}
    if not rows:
        return []
    count = next(iter(rows.values()))["count"]
    shown = [["none", with_error(rows["next_0 right"]), "", "", "", "", ""]] if "next_0 right" in rows else []
    for way, label in WAYS.items():
        names = [f"{way} {measure}" for measure in FURTHER_MEASURES]
        if names[0] in rows:
            shown.append([label, *(with_error(rows[name]) if name in rows else "" for name in names)])
    headings = ("postures", "right", "gravity", "others", "right and alone", "right class", "predicted")
    return [table(headings, shown, f"{count} ambiguous sets after further postures", left=("postures",))]


FURTHER_MEASURES = ("right", "right, gravity", "right, others", "right, alone", "class", "predicted")
WAYS = {
    "next_2": "2 of armcal discriminate",
    "loaded_2": "2, two payloads",
    "random_2": "2 at random",
    "next_8": "8 of armcal discriminate",
    "loaded_8": "8, two payloads",
    "random_8": "8 at random",
    "next_16": "16 of armcal discriminate",
    "loaded_16": "16, two payloads",
    "random_16": "16 at random",
}


def reliability_tables(found: BlindStudy) -> list[Table]:
    """Stated probabilities, and the share of verdicts that were right at each."""
    if not len(found.reliability):
        return []
    rows = (
        [f"{row['from']:g} to {row['to']:g}", f"{row['said']:.3f}", f"{row['right']:.3f}", str(row["count"])]
        for row in found.reliability.iter_rows(named=True)
    )
    error = found.value(ALL, "calibration error")
    title = f"Said with probability p: right in p? Expected calibration error {error:.3f}"
    return [table(("said", "mean", "right", "sets"), rows, title, left=("said",))]


def bar_table(bars: pl.DataFrame) -> Table:
    """Targets and results."""
    rows = (
        [row["cell"], row["measure"], row["asked"], with_error(row), Text(row["outcome"], COLORS[row["outcome"]])]
        for row in bars.iter_rows(named=True)
    )
    headings = ("cell", "measure", "asked", "measured", "outcome")
    return table(headings, rows, "Bars", left=("cell", "measure", "outcome"))


def mistakes(found: BlindStudy, most: int = 12) -> list[Table]:
    """The most frequent wrong names, joints left out."""
    pairs = found.confusion.iter_rows(named=True)
    wrong = [row for row in pairs if row["hidden"] != row["named"] and not _flagged(row)]
    rows = ([row["hidden"], row["named"], str(row["count"])] for row in wrong)
    title = "Most frequent mistakes between classes"
    shown = table(("hidden", "named", "sets"), rows, title, left=("hidden", "named"), most=most)
    return [shown] if wrong else []


def _flagged(row: dict[str, Any]) -> bool:
    return bool(row["hidden"] == "outside the library" and row["named"].endswith("unknown"))


# -- picture -----------------------------------------------------------------------------------------------------------
def write_pictures(folder: Path, found: BlindStudy) -> None:
    """confusion.png and reliability.png in the folder, replaced if they are there."""
    if len(found.confusion):
        save(confusion_figure(found.confusion), folder / "confusion.png", force=True)
    if len(found.reliability):
        save(reliability_figure(found.reliability), folder / "reliability.png", force=True)


def reliability_figure(rows: pl.DataFrame) -> Figure:
    """Reliability diagram: share right against stated probability, bars of two standard errors, and number of sets."""
    said, right, count = (rows[name].to_numpy() for name in ("said", "right", "count"))
    error = 2.0 * np.sqrt(np.maximum(right * (1.0 - right), 0.25 / count) / count)
    figure = Figure(figsize=(5.0, 5.6), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    axes.plot([0.0, 1.0], [0.0, 1.0], color="gray", linewidth=1.0, label="as often as said")
    axes.errorbar(said, right, error, fmt="o", markersize=5, capsize=3, label="data sets, +- 2 standard errors")
    axes.set(ylabel="share that was right", ylim=(0.0, 1.02), title="Said with probability p: right in p?")
    axes.legend(loc="lower right", frameon=False)
    low, high = rows["from"].to_numpy(), rows["to"].to_numpy()
    below.bar(low, count, high - low, align="edge", edgecolor="white")
    below.set(yscale="log", ylim=(10.0 ** np.floor(np.log10(max(count.min(), 1))), None))
    below.set(ylabel="data sets", xlabel="probability that was said", xlim=(0.0, 1.02))
    below.yaxis.set_minor_formatter(NullFormatter())
    return figure


def confusion_figure(confusion: pl.DataFrame) -> Figure:
    """Fraction of the sets with a class hidden (row) in which a class was named (column); single classes only."""
    rows, columns, fractions, totals = confusion_matrix(confusion)
    figure = Figure(figsize=(1.5 + 0.55 * len(columns), 1.8 + 0.42 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(fractions, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), [f"{name} ({total})" for name, total in zip(rows, totals, strict=True)])
    for (i, j), fraction in np.ndenumerate(fractions):
        if fraction >= 0.0005:
            color = "white" if fraction > 0.5 else "black"
            axes.text(j, i, f"{fraction:.3f}".lstrip("0"), ha="center", va="center", color=color, fontsize=7)
    axes.set_xlabel("named")
    axes.set_ylabel("hidden (data sets)")
    axes.set_title("What was hidden and what was named: fraction of each row")
    return figure


def confusion_matrix(confusion: pl.DataFrame) -> tuple[list[str], list[str], Array, list[int]]:
    """Row names, column names, fractions and row totals; sets with several effects hidden are left out."""
    counts = {(row["hidden"], row["named"]): row["count"] for row in confusion.iter_rows(named=True)}
    hidden = _ordered({a for a, _ in counts if " + " not in a})
    named = _ordered(({*hidden, "unknown"} - {"outside the library"}) | {_column(b) for a, b in counts if a in hidden})
    fractions = np.zeros((len(hidden), len(named)))
    for (a, b), count in counts.items():
        if a in hidden:
            fractions[hidden.index(a), named.index(_column(b))] += count
    totals = fractions.sum(axis=1)
    return hidden, named, fractions / totals[:, None], [int(total) for total in totals]


def _column(named: str) -> str:
    """Several names at once go into one column, unless the rest of the gap stayed unknown."""
    return "unknown" if named.endswith("unknown") else "several" if " + " in named else named


def _ordered(names: set[str]) -> list[str]:
    """Alphabetical, special names last."""
    last: Sequence[str] = ("nothing", "several", "outside the library", "unknown")
    return sorted(names - set(last)) + [name for name in last if name in names]
