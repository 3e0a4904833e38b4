"""The paper reproduced: tables for a terminal and the two figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from rich.table import Table

from doe.report.page import svg
from doe.report.terminal import number, table
from doe.studies.paper.study import PaperStudy
from identification.files.io import write_whole


def paper_tables(found: PaperStudy) -> list[Any]:
    """Verdict, what agrees and what does not, and the errata with their evidence."""
    tables = found.tables
    every = [verdict for name in ("table_1", "table_2", "table_3", "text") for verdict in tables[name]["verdict"]]
    counts = ", ".join(f"{every.count(word)} {text}" for word, text in WORDS.items())
    agree = "theory and simulation agree everywhere"
    sentence = agree if found.passed else "theory and simulation DISAGREE somewhere"
    return [
        f"The paper reproduced: {sentence}. Printed statements: {counts}.",
        _figures_table("Table III and joint limits", tables["table_3"]),
        _figures_table("Numbers in the text (Section VI)", tables["text"]),
        errata_table(tables["errata"]),
    ]


WORDS = {"agrees": "agree", "erratum": "are errata", "not identifiable": "cannot be identified", "added": "added here"}


def _figures_table(title: str, rows: pl.DataFrame) -> Table:
    """Printed, theory and simulation side by side."""
    texts = ("place", "links", "runs", "item", "unit", "verdict")
    figures = {"printed": 3, "theory": 5, "simulated": 5}
    headings = [*texts[:4], *figures, *texts[4:]]
    shown = (
        [number(row.get(name), figures[name]) if name in figures else str(row[name]) for name in headings]
        for row in rows.iter_rows(named=True)
    )
    return table(headings, shown, title, left=texts, no_wrap=("item",))


def errata_table(rows: pl.DataFrame) -> Table:
    """What is printed, what is correct, and how wrong each is."""
    texts = ("place", "printed", "correct")
    shown = []
    for row in rows.iter_rows(named=True):
        errors = f"{row['printed_error']:.2g}", f"{row['correct_error']:.1g}"
        shown.append([*(row[name] for name in texts), *errors, "yes" if row["confirmed"] else "NO"])
    headings = (*texts, "error of printed", "error of correct", "shown")
    return table(headings, shown, "Errata, each checked by numbers", left=(*texts, "shown"), show_lines=True)


TICKS = [digit * 10.0**power for power in range(-4, 1) for digit in (1, 2, 5)]


def figure_1_picture(data: pl.DataFrame) -> Figure:
    """Figure 1: determinants of random plans, the optimal plan marked."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.hist(data["det_d"].to_numpy(), bins=60, color="#2a6f97")
    left.axvline(1.0, color="#c44e52", lw=2)
    left.set(xlabel="det D' of random plans; red: optimal plans", ylabel="plans", xlim=(0.0, 1.03))
    right.plot(data["det_c"].to_numpy(), data["det_s"].to_numpy(), ".", ms=2, alpha=0.4, color="#2a6f97")
    right.plot(1.0, 0.0, "*", ms=14, color="#c44e52")
    right.set(xlabel="det C'", ylabel="det S'", xlim=(0.0, 1.03))
    right.set_title("D*: det C' to 1 and det S' to 0 (star: optimal plans)", fontsize=9)
    return figure


def figure_2_picture(data: pl.DataFrame) -> Figure:
    """Figure 2: deviations against the number of measurements, lengths left, orientations of all links right."""
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, kind, unit in zip(panels, ("length_error", "orientation_offset"), ("mm", "deg"), strict=True):
        for link, color in enumerate(("#2a6f97", "#c44e52", "#55a868", "#8172b2"), start=1):
            rows = data.filter(item=f"{kind}:{link}")
            m = rows["runs"].to_numpy()
            axes.plot(m, rows["optimal"].to_numpy(), "-", color=color, label=f"link {link}")
            axes.plot(m, rows["optimal_simulated"].to_numpy(), "x", color=color, ms=5)
            axes.plot(m, rows["ordinary"].to_numpy(), "o", color=color, ms=4, mfc="none")
            axes.plot(m, rows["random_mean"].to_numpy(), "--", color=color, lw=1)
        axes.set(xlabel="measurements m", ylabel=f"standard deviation of the {kind.replace('_', ' ')} [{unit}]")
        axes.set(yscale="log", xticks=np.arange(4, 21, 4))
        axes.set_yticks([tick for tick in TICKS if axes.get_ylim()[0] < tick < axes.get_ylim()[1]])
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("")
    panels[1].legend(fontsize=8)
    figure.suptitle(
        "line: eq. 25;  x: optimal plan, simulated;  o: one random plan, simulated;  dashed: mean over random plans",
        fontsize=9,
    )
    return figure


def write_pictures(folder: Path, found: PaperStudy) -> None:
    """figure_1.svg and figure_2.svg in the folder."""
    write_whole(folder / "figure_1.svg", svg(figure_1_picture(found.tables["figure_1"])), force=True)
    write_whole(folder / "figure_2.svg", svg(figure_2_picture(found.tables["figure_2"])), force=True)
