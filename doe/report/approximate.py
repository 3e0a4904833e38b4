"""Approximate designs as tables and a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table

from doe.bounds.approximate_design import ApproximateDesign
from doe.cross_check import CrossCheck
from doe.report.terminal import facts, number, table

MOST = 24


def relax_tables(design: ApproximateDesign) -> list[Any]:
    """Value, bound and efficiency, then the support."""
    where = "all postures" if design.candidates is None else f"{design.candidates} candidates"
    rows = [
        ("criterion", f"{design.criterion} over {where}, {len(design.plan)} with positive weight"),
        ("value", number(design.value, 9)),
        ("upper bound", "-" if design.bound is None else str(design.bound)),
        (f"gap ({'max d - p' if design.criterion == 'D' else 'max tr(G F) - tr(G M)'})", number(design.gap, 3)),
        ("efficiency at least", number(design.efficiency_lower_bound, 9)),
        ("solver", f"{design.solver} ({design.solver_status}), {design.seconds:.2f} s"),
        ("status", design.status.value),
    ]
    return [facts(rows), support_table(design)]


def support_table(design: ApproximateDesign) -> Table:
    """Postures and weights, heaviest first."""
    order = np.argsort(-design.plan.shares, kind="stable")
    weights, postures = design.plan.shares[order], design.plan.displayed[order]
    rows = ([f"{w:.5f}", *(f"{angle:.2f}" for angle in q)] for w, q in zip(weights, postures, strict=True))
    headings = ["weight", *(f"q{j} [{unit}]" for j, unit in enumerate(design.plan.units, start=1))]
    return table(headings, rows, "Support", most=MOST, caption=f"heaviest {MOST} of {len(order)}; --out writes all")


def cross_check_table(compared: CrossCheck) -> Table:
    """Independent answers side by side."""
    digits = {"value": 7, "bound": 7, "table_1_max_residual": 4}
    rows = ([row["method"], row["space"], *(number(row[k], n) for k, n in digits.items())] for row in compared.rows())
    headings = ("method", "over", "value", "upper bound", "Table I")
    title = "Cross-check: independent answers (Table I: deviation from orthogonality)"
    return table(headings, rows, title, left=headings[:2], no_wrap=headings[1:], padding=0)
