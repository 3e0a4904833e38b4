"""What measurements say, as tables for a terminal (rich)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.report.tables import number, significant
from identification.compensate import Compensation
from identification.estimation import Identification


def identification_tables(found: Identification) -> list[Any]:
    """Everything about a fit, verdict first."""
    data = found.to_json()
    verdict = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    verdict.add_row("method", f"{data['method']}: {found.status.value}")
    verdict.add_row("RMS", f"{number(data['rms_before_mm'])} -> {number(data['rms_after_mm'])} mm")
    verdict.add_row("largest", f"{number(data['max_before_mm'])} -> {number(data['max_after_mm'])} mm")
    verdict.add_row("sigma", f"{number(data['sigma_mm'], 5)} mm per axis, {data['dof']} degrees of freedom")
    if data["p_value"] is not None:
        verdict.add_row("chi2", f"{data['chi2']:.2f}, p = {data['p_value']:.3g}")
    shown: list[Any] = [verdict, parameter_table(data)]
    if data["not_identifiable"]:
        shown.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        shown.extend(Text(f"  {combination}") for combination in data["not_identifiable"])
    return shown


def parameter_table(data: dict[str, Any]) -> Table:
    """Parameters with 95 % intervals, in file units."""
    table = Table(title="Parameters", title_justify="left")
    table.add_column("name")
    for heading in ("value", "std", "low 95 %", "high 95 %"):
        table.add_column(Text(heading), justify="right")
    table.add_column("unit")
    for row in data["parameters"]:
        figures = [significant(row[key], row["std"]) for key in ("value", "std", "low_95", "high_95")]
        table.add_row(Text(row["name"]), *figures, row["unit"])  # a name with [k=20] is no markup
    return table


def compensation_tables(found: Compensation, most: int = 24) -> list[Any]:
    """Joint commands for the first targets, and how many are reached."""
    table = Table(title="Commands", title_justify="left")
    n = found.commands.shape[1]
    for heading in ("target", "x [mm]", "y [mm]", *(f"q{j + 1} [deg]" for j in range(n)), "error [mm]"):
        table.add_column(Text(heading), justify="right")
    rows = zip(found.targets, np.degrees(found.commands), found.errors, strict=True)
    for row, (target, command, error) in enumerate(rows, start=1):
        if row > most:
            table.caption = f"first {most} of {len(found.targets)} targets; --out writes all"
            break
        table.add_row(str(row), *(f"{v:.3f}" for v in target), *(f"{v:.5f}" for v in command), f"{error:.2g}")
    data = found.to_json()
    unreachable = f"; rows out of reach: {', '.join(map(str, data['unreachable'][:20]))}" if data["unreachable"] else ""
    return [f"{data['reached']} of {data['targets']} targets reached{unreachable}", table]
