"""Studies as documents and pictures: solvers compared, Monte Carlo, blind diagnoses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from doe.studies.blind.cells import TABLE
from doe.studies.blind.study import ALL, OUTCOMES, OUTSIDE, of_share
from doe.studies.comparison import PROBLEM, SETTING, summary, with_hits
from doe.studies.monte_carlo import CELL
from identification.document import Sheet

Columns = Mapping[str, tuple[str, str]]  # heading -> name in a row, and format of its numbers
COMPARED: Columns = {
    "solver": ("label", ""),
    **{name: (name, "z.6g") for name in ("best", "median")},
    "effi-\nciency": ("efficiency", ".5f"),
    "hits": ("hits", ""),
    "time\n[s]": ("seconds", ".2g"),
    "to hit\n[s]": ("seconds_to_hit", ".2g"),
    "failed": ("not_correct", ""),
}
ESTIMATED: Columns = {
    "parameter": ("parameter", ""),
    **{name.replace("_", " "): (name, ".4g") for name in ("mean_error", "std", "expected_std")},
    "95 % intervals hold": ("coverage", ".2%"),
    "unit": ("unit", ""),
}
RELIABLE: Columns = {"stated": ("bin", ""), "mean": ("said", ".3f"), "right": ("right", ".3f"), "sets": ("count", "")}
BARS: Columns = {name: (name, "") for name in ("cell", "measure", "asked", "measured", "outcome")}


def sheet(rows: Iterable[dict[str, Any]], columns: Columns, title: str) -> Sheet:
    """Rows as a table, a dash for none."""
    return Sheet([*columns], [[cell_text(row[name], kind) for name, kind in columns.values()] for row in rows], title)


def cell_text(value: Any, kind: str = ".4g") -> str:
    """A cell: a number in this format, a dash for none, text as it is."""
    return "-" if value is None else format(value, kind) if isinstance(value, float) else str(value)


# -- armcal compare ----------------------------------------------------------------------------------------------------
def comparison_parts(rows: pl.DataFrame) -> list[Any]:
    """One table per problem, the best setting first, and what went wrong, equal sentences once."""
    starts = pl.when(pl.col("starts") > 0).then(pl.format(", starts: {}", "starts")).otherwise(pl.lit(""))
    label = pl.concat_str("solver", starts)  # without its number of starts where it is the solver's own
    hits = pl.format("{}/{}", (pl.col("hit_rate") * pl.col("repeats")).round().cast(int), "repeats")
    parts: list[Any] = []
    for part in summary(rows).with_columns(label=label, hits=hits).partition_by(*PROBLEM, maintain_order=True):
        arm, digest, criterion, m = part.select(PROBLEM).row(0)
        bounded = with_hits(rows).filter(arm_hash=digest, criterion=criterion, runs=m).drop_nulls("bound")
        title = f"{arm}, {criterion}, {m} runs"
        for bound, cut in bounded.select("bound", "bound_cut").sort("bound", "bound_cut").head(1).iter_rows():
            title += f", bound {bound:z.7f}" + ", its search cut by the time limit" * bool(cut)
        parts.append(sheet(part.iter_rows(named=True), COMPARED, title))
    failed = rows.filter(pl.col("status") != "done").with_columns(label=label)
    kinds = failed.group_by("arm", "criterion", "runs", *SETTING, "label", "status", "error", maintain_order=True).len()
    sentence = pl.format(
        "{}, {}, {} runs, {}: {} x {}: {}", "arm", "criterion", "runs", "label", "len", "status", "error"
    )
    lines = kinds.select(sentence).to_series().to_list()
    return [*parts, *lines[:10], *([f"and {len(lines) - 10} more; the rows have them all"] if len(lines) > 10 else [])]


# -- armcal study STUDY.toml -------------------------------------------------------------------------------------------
def monte_carlo_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """What kept cells from being simulated, equal sentences once; one table per cell that was, up to twelve, of errors,
    deviations and coverage of each parameter (dashes where no fit succeeded)."""
    cells, done = tables["cells"], tables["blocks"].filter(status="done")
    fits = done.group_by("key").first()["fits"].sum() if "fits" in done.columns else 0
    count = cells.select(CELL).n_unique()
    failed = cells.filter(pl.col("error").is_not_null()).group_by("arm", "error", maintain_order=True)
    kinds = failed.agg(pl.struct(CELL).n_unique().alias("cells")).iter_rows(named=True)
    parts: list[Any] = [f"{count} cells, {fits} fits"]
    parts += [f"{kind['arm']}: {kind['cells']} of {count} cells failed: {kind['error']}" for kind in kinds]
    each = cells.filter(pl.col("error").is_null()).partition_by(*CELL, maintain_order=True)
    for cell in each[:12]:
        first = cell.row(0, named=True)
        title = "{arm}, plan {plan}, {runs} runs, sigma {sigma_mm:g} mm, truth {truth}, model {model}".format(**first)
        lost = f", {first['failed']} failed" if first["failed"] else ""
        title += f": {first['fits']} fits{lost}, RMS {cell_text(first['rms_mm'])} mm"
        parts.append(sheet(cell.iter_rows(named=True), ESTIMATED, title))
    return [*parts, *([f"first 12 of {len(each)} cells that were simulated"] if len(each) > 12 else [])]


# -- armcal study blind ------------------------------------------------------------------------------------------------
def blind_parts(tables: Mapping[str, pl.DataFrame]) -> list[Any]:
    """Verdict, figures of the cells, reliability, bars, and the most frequent mistakes."""
    bars = [{**row, "measured": with_error(row)} for row in tables["bars"].iter_rows(named=True)]
    counts = {word: sum(row["outcome"] == word for row in bars) for word in OUTCOMES}
    outcomes = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    done = len(tables["sets"].filter(status="done"))
    failed = f"; {len(tables['sets']) - done} batches failed" if done < len(tables["sets"]) else ""
    parts: list[Any] = [f"{done} blind data sets; bars: {outcomes or 'none'}{failed}"]
    cells: dict[str, dict[str, Any]] = {}
    for row in tables["cells"].iter_rows(named=True):
        cells.setdefault(row["cell"], {})[row["measure"]] = row
    for title, (first, *others) in TABLE["tables"].items():  # where a cell has the first of the measures
        rows = [
            [cell, str(row[first]["count"]), *(with_error(row.get(name)) for name in (first, *others))]
            for cell, row in cells.items()
            if first in row
        ]
        parts.append(Sheet(("hidden", "sets", first, *others), rows, title))
    error = with_error(cells.get(ALL, {}).get("calibration error"))
    title = f"Is what is stated with probability p right in a share p of the sets? Expected calibration error {error}"
    bins = ({**row, "bin": f"{row['from']:g} to {row['to']:g}"} for row in tables["reliability"].iter_rows(named=True))
    wrong = [
        [row["hidden"], row["named"], str(row["count"])]
        for row in tables["confusion"].iter_rows(named=True)
        if row["hidden"] != row["named"] and not (row["hidden"] == OUTSIDE and row["named"].endswith("unknown"))
    ]
    mistakes = Sheet(("hidden", "named", "sets"), wrong, "Most frequent mistakes between classes", 12)
    return [*parts, sheet(bins, RELIABLE, title), sheet(bars, BARS, "Bars"), mistakes]


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
    error = 2.0 * of_share(right, count)
    figure = Figure(figsize=(5.0, 5.6), layout="constrained")
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(4, 1))
    axes.plot([0.0, 1.0], [0.0, 1.0], color="gray", linewidth=1.0, label="as often as stated")
    axes.errorbar(stated, right, error, fmt="o", markersize=5, capsize=3, label="data sets, +- 2 standard errors")
    axes.set(ylabel="share that was right", ylim=(0.0, 1.02), title="Stated with probability p: right in a share p?")
    axes.legend(loc="lower right", frameon=False)
    low, high = rows["from"].to_numpy(), rows["to"].to_numpy()
    below.bar(low, count, high - low, align="edge", edgecolor="white")
    below.set(yscale="log", ylim=(10.0 ** np.floor(np.log10(max(count.min(), 1))), None))
    below.set(ylabel="data sets", xlabel="stated probability", xlim=(0.0, 1.02))
    below.yaxis.set_minor_formatter(NullFormatter())
    return figure
