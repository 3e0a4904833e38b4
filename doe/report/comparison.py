"""Solvers compared, as tables for a terminal and as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from rich.table import Table

from doe.report.terminal import table
from doe.studies.comparison import PROBLEM, SETTING, summary, with_hits
from identification.arrays import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR = 1e-9  # losses below this are shown there
MOST = 10  # failures shown
TEN = 10.0  # values from which three decimals are enough
ACROSS = 3  # panels side by side
Setting = tuple[str, int]  # solver and starts
Curve = tuple[Array, Array]  # x and y of a step function


def comparison_tables(rows: pl.DataFrame) -> list[Any]:
    """One table per problem, the best setting first, and what went wrong."""
    shown: list[Any] = []
    found = summary(rows)
    for part in found.partition_by(*PROBLEM, maintain_order=True):
        arm, criterion, runs = (part[name][0] for name in ("arm", "criterion", "runs"))
        same = with_hits(rows).filter(arm_hash=part["arm_hash"][0], criterion=criterion, runs=runs)
        bounds = same["bound"].drop_nulls().to_list()
        title = f"{arm}, {criterion}, {runs} runs" + (f", bound {min(bounds):z.7f}" if bounds else "")
        shown.append(_table(title, part))
    return [*shown, *_failures(rows)]


def _failures(rows: pl.DataFrame) -> list[str]:
    """What went wrong, equal sentences once."""
    failed = with_hits(rows).filter(pl.col("status") != "done")
    kinds = failed.group_by("arm", "criterion", "runs", *SETTING, "status", "error", maintain_order=True).len()
    lines = [
        f"{row['arm']}, {row['criterion']}, {row['runs']} runs, {label((row['solver'], row['starts']))}: "
        f"{row['len']} x {row['status']}: {row['error']}"
        for row in kinds.iter_rows(named=True)
    ]
    return [*lines[:MOST], *([f"and {len(lines) - MOST} more; the rows have all"] if len(lines) > MOST else [])]


def _table(title: str, found: pl.DataFrame) -> Table:
    headings = ("solver", "best", "median", "effi-\nciency", "hits", "time\n[s]", "to hit\n[s]", "MB", "wrong")
    rows = map(_row, found.iter_rows(named=True))
    return table(headings, rows, title, left=("solver",), no_wrap=("solver",), padding=0)


def _row(row: dict[str, Any]) -> list[str]:
    return [
        label((row["solver"], row["starts"])),
        *(_figure(row[name], "z.5f" if abs(row[name] or 0.0) < TEN else ".3f") for name in ("best", "median")),
        _figure(row["efficiency"], ".5f"),
        f"{round(row['hit_rate'] * row['repeats'])}/{row['repeats']}",
        *(_figure(row[name], ".2g") for name in ("seconds", "seconds_to_hit")),
        _figure(row["peak_memory_mb"], ".0f"),
        str(row["not_correct"] or "-"),
    ]


def _figure(value: float | None, kind: str) -> str:
    return "-" if value is None else format(value, kind)


def label(setting: Setting) -> str:
    """`ipopt, 10 starts`; only `ipopt` with its own number of starts."""
    solver, starts = setting
    if not starts:
        return solver
    return f"{solver}, {starts} start{'s' if starts > 1 else ''}"


def _with_time_ratios(rows: pl.DataFrame) -> pl.DataFrame:
    """The rows with `ratio`: time over that of the fastest hit of the instance; infinite if the run is no hit."""
    time = pl.when("hit").then("seconds").otherwise(float("inf"))
    rows = with_hits(rows).with_columns(time.alias("time"))
    ratio = pl.col("time") / pl.col("time").min().over(*PROBLEM, "repeat")
    return rows.with_columns(pl.when(pl.col("time").is_finite()).then(ratio).otherwise(float("inf")).alias("ratio"))


def performance_profile(rows: pl.DataFrame) -> dict[Setting, Curve]:
    """Setting -> (tau, fraction): fraction of the instances that it solved within tau times the fastest setting's time.

    An instance is a problem and a repeat, solved where the run is a hit; an instance nobody solved counts against all.
    E. D. Dolan, J. J. More, Benchmarking optimization software with performance profiles, Math. Program. 91 (2002),
    equations 1 and 2.
    """
    curves = {}
    for part in _with_time_ratios(rows).partition_by(*SETTING, maintain_order=True):
        ratios = np.sort(part["ratio"].to_numpy())
        tau = np.unique(ratios[np.isfinite(ratios)])
        setting = part["solver"][0], part["starts"][0]
        curves[setting] = tau, np.searchsorted(ratios, tau, side="right") / len(ratios)
    return curves


def profile_figure(rows: pl.DataFrame) -> Figure:
    """The performance profile: on the left who is fastest, on the right who gets there at all."""
    from matplotlib.figure import Figure  # deferred: tables need no pictures

    curves = performance_profile(rows)
    styles = _styles(list(curves))
    end = 1.3 * max((float(tau[-1]) for tau, _ in curves.values() if tau.size), default=1.0)
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.subplots()
    for above, (setting, (tau, fraction)) in enumerate(curves.items()):
        color, dashes, _ = styles[setting]
        width = 1.5 + 1.2 * (len(curves) - 1 - above)  # the narrow ones on top: equal curves hide none
        x, y = np.r_[0.9, tau, end], np.r_[0.0, fraction, fraction[-1] if fraction.size else 0.0]
        name = f"{label(setting)}: {100.0 * y[-1]:.0f} %"
        axes.step(x, y, where="post", color=color, ls=dashes, lw=width, label=name)
    axes.set(xscale="log", xlim=(1.0, max(end, 1.1)), ylim=(-0.04, 1.04))
    _plain_numbers(axes)
    axes.set(xlabel="time / time of the fastest", ylabel="fraction of instances at the best known value")
    figure.legend(fontsize=8, loc="outside right center", title="solved in the end", title_fontsize=8)
    return figure


def time_figure(rows: pl.DataFrame) -> Figure:
    """Value against time, one panel per problem: loss of efficiency of every run, those without loss at the bottom."""
    from matplotlib.figure import Figure

    rows = with_hits(rows)
    problems = rows.select(PROBLEM).unique(maintain_order=True).rows()
    styles = _styles(rows.select(SETTING).unique(maintain_order=True).rows())
    across = min(len(problems), ACROSS)
    down = -(-len(problems) // across)
    figure = Figure(figsize=(4.2 * across + 2.0, 0.5 + 3.5 * down), layout="constrained")
    grid = figure.subplots(down, across, sharey=True, squeeze=False)
    panels = grid.ravel()
    for unused in panels[len(problems) :]:
        unused.set_axis_off()
    for axes, problem in zip(panels, problems, strict=False):
        part = rows.filter("good", **dict(zip(PROBLEM, problem, strict=True)))
        for setting, (color, _, marker) in styles.items():
            runs = part.filter(**dict(zip(SETTING, setting, strict=True)))
            loss = np.maximum(runs["loss"].to_numpy(), FLOOR)
            axes.plot(runs["seconds"].to_numpy(), loss, marker, color=color, ms=5, alpha=0.7, label=label(setting))
        axes.set(xscale="log", yscale="log", ylim=(FLOOR / 2.0, 1.5), xlabel="time of a run [s]")
        _plain_numbers(axes)
        axes.set_title(f"{problem[0]}, {problem[2]}, {problem[3]} runs", fontsize=9)
    for first in grid[:, 0]:
        first.set_ylabel(f"efficiency below the best (floor {FLOOR:g})")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, loc="outside right center")
    return figure


def _plain_numbers(axes: Axes) -> None:
    """1, 2, 5, 10 along a logarithmic x axis: powers of ten crowd each other where there is less than a decade."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _styles(settings: list[Any]) -> dict[Setting, tuple[Any, str, str]]:
    """Setting -> colour (of the solver), dashes and marker (of the number of starts)."""
    from matplotlib import colormaps

    solvers = list(dict.fromkeys(solver for solver, _ in settings))
    starts = sorted({number for _, number in settings})
    return {
        (solver, number): (
            colormaps["tab10"](solvers.index(solver) % 10),
            ("-", "--", ":", "-.")[starts.index(number) % 4],
            "os^D"[starts.index(number) % 4],
        )
        for solver, number in settings
    }
