"""Studies as documents and pictures: solvers compared, Monte Carlo, blind diagnoses."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from doe.studies.blind.study import ALL, KEEPS, OUTCOMES, OUTSIDE
from doe.studies.comparison import PROBLEM, SETTING, summary, with_hits
from doe.studies.monte_carlo import CELL
from identification.document import Sheet


def cell_text(value: Any, kind: str = ".4g") -> str:
    """A cell: a number in this format, a dash for none, text as it is."""
    return "-" if value is None else format(value, kind) if isinstance(value, float) else str(value)


# -- armcal compare ----------------------------------------------------------------------------------------------------
def comparison_parts(rows: pl.DataFrame) -> list[Any]:
    """One table per problem, the best setting first, and what went wrong, equal sentences once."""
    parts: list[Any] = []
    runs = with_hits(rows)
    headings = ("solver", "best", "median", "effi-\nciency", "hits", "time\n[s]", "to hit\n[s]", "wrong")
    for part in summary(rows).partition_by(*PROBLEM, maintain_order=True):
        arm, arm_hash, criterion, m = (part[name][0] for name in PROBLEM)
        bounds = (
            runs.filter(arm_hash=arm_hash, criterion=criterion, runs=m).drop_nulls("bound").sort("bound", "bound_cut")
        )
        cells = []
        for row in part.iter_rows(named=True):
            best, median = (
                cell_text(row[k], "z.5f" if abs(row[k] or 0.0) < 10.0 else ".3f") for k in ("best", "median")
            )
            hits = f"{round(row['hit_rate'] * row['repeats'])}/{row['repeats']}"
            times = [cell_text(row[name], ".2g") for name in ("seconds", "seconds_to_hit")]
            name, wrong = label(row["solver"], row["starts"]), str(row["not_correct"] or "-")
            cells.append([name, best, median, cell_text(row["efficiency"], ".5f"), hits, *times, wrong])
        bound = f", bound {bounds['bound'][0]:z.7f}" if len(bounds) else ""
        bound += ", its search cut by the time limit" if len(bounds) and bounds["bound_cut"][0] else ""
        parts.append(Sheet(headings, cells, f"{arm}, {criterion}, {m} runs{bound}"))
    failed = runs.filter(pl.col("status") != "done")
    kinds = failed.group_by("arm", "criterion", "runs", *SETTING, "status", "error", maintain_order=True).len()
    lines = [
        f"{row['arm']}, {row['criterion']}, {row['runs']} runs, {label(row['solver'], row['starts'])}: "
        f"{row['len']} x {row['status']}: {row['error']}"
        for row in kinds.iter_rows(named=True)
    ]
    rest = [f"and {len(lines) - 10} more; the rows have all"] if len(lines) > 10 else []
    return [*parts, *lines[:10], *rest]


def label(solver: str, starts: int) -> str:
    """`ipopt, 10 starts`; only `ipopt` with its own number of starts."""
    return f"{solver}, {starts} start{'s' * (starts > 1)}" if starts else solver


# -- armcal study STUDY.toml -------------------------------------------------------------------------------------------
def monte_carlo_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """What kept cells from being simulated, equal sentences once; one table per cell that was, up to twelve, of errors,
    deviations and coverage of each parameter (dashes where no fit succeeded)."""
    cells, done = tables["cells"], tables["blocks"].filter(status="done")
    fits = done.group_by("key").first()["fits"].sum() if "fits" in done.columns else 0
    count = cells.select(CELL).n_unique()
    parts: list[Any] = [f"{count} cells, {fits} fits"]
    failed = cells.filter(pl.col("error").is_not_null()).group_by("arm", "error", maintain_order=True)
    kinds = failed.agg(pl.struct(CELL).n_unique().alias("cells")).iter_rows(named=True)
    parts += [f"{kind['arm']}: {kind['cells']} of {count} cells failed: {kind['error']}" for kind in kinds]
    formats = {"parameter": "", "mean_error": ".4g", "std": ".4g", "expected_std": ".4g", "coverage": ".2%", "unit": ""}
    headings = ("parameter", "mean error", "std", "expected std", "95 % intervals hold", "unit")
    each = cells.filter(pl.col("error").is_null()).partition_by(*CELL, maintain_order=True)
    for cell in each[:12]:
        rows = cell.to_dicts()
        first = rows[0]
        plan = f"{first['arm']}, plan {first['plan']}, {first['runs']} runs, sigma {first['sigma_mm']:g} mm"
        title = f"{plan}, truth {first['truth']}, model {first['model']}"
        lost = f", {first['failed']} failed" if first["failed"] else ""
        figures = [[cell_text(row[name], kind) for name, kind in formats.items()] for row in rows]
        rms = f"RMS {cell_text(first['rms_mm'])} mm"
        parts.append(Sheet(headings, figures, f"{title}: {first['fits']} fits{lost}, {rms}"))
    return [*parts, *([f"first 12 of {len(each)} cells that were simulated"] if len(each) > 12 else [])]


# -- armcal study blind ------------------------------------------------------------------------------------------------
# title -> measures side by side, where a cell has the first of them
MEASURES = {
    "Blind study": ("alarm", "exact", "class", "in the set", "located", "gap / true"),
    "Many effects at once": ("error / true", "effects named", "false names", "intervals, all", "false unknown"),
    "Outside the library": ("no effect", "located", "wrong place"),
    "The model that is written": (
        *("inside tip intervals", "error / geometry", "promised / reached"),
        *(KEEPS, "contradiction"),
    ),
    "Ambiguous sets after further postures of armcal discriminate": ("next_2 right", "next_8 right"),
}


def blind_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """Verdict, figures of the cells, reliability, bars, and the most frequent mistakes."""
    bars = tables["bars"].to_dicts()
    counts = Counter(row["outcome"] for row in bars)
    outcomes = ", ".join(f"{counts[word]} {word}" for word in OUTCOMES if counts[word])
    done = len(tables["sets"].filter(status="done"))
    failed = f"; {len(tables['sets']) - done} batches failed" if done < len(tables["sets"]) else ""
    parts: list[Any] = [f"{done} blind data sets; bars: {outcomes or 'none'}{failed}"]
    cells: dict[str, dict[str, Any]] = {}
    for row in tables["cells"].iter_rows(named=True):
        cells.setdefault(row["cell"], {})[row["measure"]] = row
    for title, measures in MEASURES.items():
        rows = [
            [cell, str(figures[measures[0]]["count"]), *(with_error(figures.get(name)) for name in measures)]
            for cell, figures in cells.items()
            if measures[0] in figures
        ]
        parts.append(Sheet(("hidden", "sets", *measures), rows, title))
    rows = [
        [f"{row['from']:g} to {row['to']:g}", f"{row['said']:.3f}", f"{row['right']:.3f}", str(row["count"])]
        for row in tables["reliability"].iter_rows(named=True)
    ]
    error = with_error(cells.get(ALL, {}).get("calibration error"))
    title = f"Said with probability p: right in p? Expected calibration error {error}"
    parts.append(Sheet(("said", "mean", "right", "sets"), rows, title))
    rows = [[row["cell"], row["measure"], row["asked"], with_error(row), row["outcome"]] for row in bars]
    parts.append(Sheet(("cell", "measure", "asked", "measured", "outcome"), rows, "Bars"))
    wrong = [
        [row["hidden"], row["named"], str(row["count"])]
        for row in tables["confusion"].iter_rows(named=True)
        if row["hidden"] != row["named"] and not (row["hidden"] == OUTSIDE and row["named"].endswith("unknown"))
    ]
    return [*parts, Sheet(("hidden", "named", "sets"), wrong, "Most frequent mistakes between classes", 12)]


def with_error(row: dict[str, Any] | None) -> str:
    """`.931(13)`: the value and its standard error in units of its last digit; empty without a row."""
    if row is None:
        return ""
    value = f"{row['value']:.3f}".removeprefix("0" if row["value"] < 1.0 else "")
    error = 1000.0 * row["standard_error"]
    return f"{value}({error:.0f})" if np.isfinite(error) else value


def reliability_figure(rows: pl.DataFrame) -> Figure:
    """Reliability diagram: share right against stated probability, bars of two standard errors, and number of sets."""
    stated, right, count = (rows[name].to_numpy() for name in ("said", "right", "count"))
    error = 2.0 * np.sqrt(np.maximum(right * (1.0 - right), 0.25 / count) / count)
    figure = Figure(figsize=(5.0, 5.6), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    axes.plot([0.0, 1.0], [0.0, 1.0], color="gray", linewidth=1.0, label="as often as said")
    axes.errorbar(stated, right, error, fmt="o", markersize=5, capsize=3, label="data sets, +- 2 standard errors")
    axes.set(ylabel="share that was right", ylim=(0.0, 1.02), title="Said with probability p: right in p?")
    axes.legend(loc="lower right", frameon=False)
    low, high = rows["from"].to_numpy(), rows["to"].to_numpy()
    below.bar(low, count, high - low, align="edge", edgecolor="white")
    below.set(yscale="log", ylim=(10.0 ** np.floor(np.log10(max(count.min(), 1))), None))
    below.set(ylabel="data sets", xlabel="probability that was said", xlim=(0.0, 1.02))
    below.yaxis.set_minor_formatter(NullFormatter())
    return figure
