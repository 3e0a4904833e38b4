"""Approximate designs as tables and a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.bounds.approximate_design import ApproximateDesign
from doe.cross_check import CrossCheck
from doe.report.tables import number

MOST = 24


def relax_tables(design: ApproximateDesign) -> list[Any]:
    """Value, bound and efficiency, then the support."""
    head = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    where = "all postures" if design.candidates is None else f"{design.candidates} candidates"
    head.add_row("criterion", f"{design.criterion} over {where}, {len(design.plan)} of them carry weight")
    head.add_row("value", number(design.value, 9))
    head.add_row("upper bound", "-" if design.bound is None else str(design.bound))
    head.add_row("gap (max d - p)", f"{design.gap:.3g}")
    head.add_row("efficiency at least", number(design.efficiency_lower_bound, 9))
    head.add_row("solver", f"{design.solver} ({design.solver_status}), {design.seconds:.2f} s")
    head.add_row("status", design.status.value)
    return [head, support_table(design)]


def support_table(design: ApproximateDesign) -> Table:
    """Postures and weights, heaviest first."""
    table = Table(title="Support", title_justify="left")
    for heading in ("weight", *(f"q{j} [{unit}]" for j, unit in enumerate(design.plan.units, start=1))):
        table.add_column(Text(heading), justify="right")
    order = np.argsort(-design.plan.shares, kind="stable")
    for k in order[:MOST]:
        table.add_row(f"{design.plan.shares[k]:.5f}", *(f"{angle:.2f}" for angle in design.plan.displayed[k]))
    if len(order) > MOST:
        table.caption = f"heaviest {MOST} of {len(order)}; --out writes all"
    return table


def cross_check_table(compared: CrossCheck) -> Table:
    """Independent answers side by side."""
    table = Table(title="Cross-check: independent answers", title_justify="left")
    for heading in ("method", "over", "value", "upper bound", "Table I residual"):
        table.add_column(Text(heading), justify="left" if heading in ("method", "over") else "right")
    for row in compared.rows():
        figures = (number(row["value"], 9), number(row["bound"], 9), number(row["table_1_max_residual"], 6))
        table.add_row(row["method"], row["space"], *figures)
    return table
