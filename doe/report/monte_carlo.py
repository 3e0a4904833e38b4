"""Monte Carlo studies as tables for a terminal."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from doe.report.terminal import table
from doe.studies.monte_carlo.specification import CELL
from doe.studies.monte_carlo.study import StudyResult

MOST = 12  # cells shown; the files have all


def study_tables(result: StudyResult) -> list[Any]:
    """One table per cell, and the cells that could not be simulated."""
    shown: list[Any] = [str(result)]
    parts = result.cells.partition_by(*CELL, maintain_order=True)
    for part in parts[:MOST]:
        first = part.row(0, named=True)
        plan = f"{first['arm']}, plan {first['plan']}, {first['runs']} runs, sigma {first['sigma_mm']:g} mm"
        title = f"{plan}, truth {first['truth']}, model {first['model']}"
        if first["error"] is not None:
            shown.append(f"{title}: {first['status']}: {first['error']}")
        else:
            shown.append(_cell_table(title, part.to_dicts()))
    if len(parts) > MOST:
        shown.append(f"first {MOST} of {len(parts)} cells")
    return shown


def _cell_table(title: str, rows: list[dict[str, Any]]) -> Table:
    failed = f", {rows[0]['failed']} failed" if rows[0]["failed"] else ""
    title = f"{title}: {rows[0]['fits']} fits{failed}, RMS {_figure(rows[0]['rms_mm'])} mm"
    headings = ("parameter", "mean error", "std", "expected std", "95 % intervals hold", "unit")
    return table(headings, map(_row, rows), title, left=("parameter", "unit"), no_wrap=("parameter",))


def _row(row: dict[str, Any]) -> list[str]:
    figures = (_figure(row[name]) for name in ("mean_error", "std", "expected_std"))
    coverage = "-" if row["coverage"] is None else f"{row['coverage']:.2%}"
    return [row["parameter"], *figures, coverage, row["unit"]]


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
