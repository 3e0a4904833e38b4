"""Results as tables for a terminal (rich)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.design import Design
from doe.plan.expected_accuracy import ExpectedDeviations, over_draws
from doe.plan.observability import Observability
from doe.plan.order import Ordered
from doe.plan.replicate_spacing import distance_to_keep
from identification.arrays import Array


def number(value: float | None, digits: int = 4) -> str:
    """A figure for a table; a dash for what cannot be given."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def plan_table(design: Design, most: int = 24) -> Table:
    """The postures in degrees, one row per run; long plans are cut, the file has them all."""
    table = Table(title="Plan", title_justify="left")
    table.add_column("run", justify="right")
    for joint, unit in enumerate(design.plan.units, start=1):
        table.add_column(Text(f"q{joint} [{unit}]"), justify="right")
    for run, posture in enumerate(design.plan.displayed[:most], start=1):
        table.add_row(str(run), *(f"{angle:.3f}" for angle in posture))
    if len(design.plan) > most:
        table.caption = f"first {most} of {len(design.plan)} runs; --out writes all"
    return table


def accuracy_table(design: Design) -> Table | str:
    """Expected standard deviations per link of a planar arm, else per parameter; or why there are none."""
    sigma, mean = design.problem.model.sigma, design.deviations
    if sigma is None:
        return "No expected standard deviations: the arm file has no sigma_mm."
    if mean is None:
        return "No expected standard deviations: not every parameter is estimable from the plan."
    each = design.deviations_per_draw
    over = "" if each is None else ", mean over the draws of the arm and worst of them"
    table = Table(title=f"Expected standard deviations (sigma = {sigma:g} mm{over})", title_justify="left")
    found = [deviation_columns(one) for one in ([mean] if each is None else [mean, over_draws(each, np.max)])]
    headings = [*found[0], *(f"worst {heading}" for columns in found[1:] for heading in columns)]
    for heading in ("link" if mean.planar else "parameter", *headings):
        table.add_column(Text(heading), justify="right")
    values = zip(*(column for columns in found for column in columns.values()), strict=True)
    rows = range(1, mean.length.size + 1) if mean.planar else [f"{p.name} [{p.file_unit}]" for p in mean.parameters]
    for row, figures in zip(rows, values, strict=True):
        table.add_row(Text(str(row)), *(number(v, 5) for v in figures))
    return table


def deviation_columns(deviations: ExpectedDeviations) -> dict[str, Array]:
    """Heading -> figures in the units of files, (n,) per link of a planar arm, else (p,) per parameter."""
    if not deviations.planar:
        return {"std": deviations.values * [p.to_file for p in deviations.parameters]}
    return {
        "length [mm]": deviations.length,
        "orientation [deg]": np.degrees(deviations.orientation),
        "joint offset [deg]": np.degrees(deviations.joint_offset),
    }


def summary_table(data: dict[str, Any], sentence: str) -> Table:
    """Value, bound, efficiency: what a person reads first."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    bound = data["bound"]
    table.add_row("criterion", f"{data['criterion']}, {data['runs']} runs, {data['links']} links")
    if data["criterion"] != "D":
        table.add_row(f"value of {data['criterion']}", number(data["value"], 7))
    table.add_row("log det M'", number(data["log_det"], 7))
    table.add_row("upper bound", f"{number(bound['value'], 7)} ({bound['source']})" if bound else "-")
    table.add_row("efficiency", number(data["efficiency"], 6))
    table.add_row("certified optimal", certified(data))
    table.add_row("Table I residual", number(data["table_1_max_residual"], 6))
    if data["solver"]:
        table.add_row("solver", f"{data['solver']}, {data['starts']} starts, {data['seconds']:.2f} s")
    table.add_row("status", sentence)
    return table


def repeats_line(design: Design) -> list[Text]:
    """What the rule against repeats may cost, where it binds and the bound is not reached."""
    if design.certified_optimal or distance_to_keep(design.problem, len(design.plan)) == 0.0:
        return []
    apart = design.problem.spacing
    return [Text(f"postures are kept {apart} apart; with --repeats they may be equal, which can be better")]


def not_estimable_line(design: Design, most: int = 4) -> list[Text]:
    """Why there is no log det: what is not estimable from the plan."""
    if design.identifies_all:
        return []
    still, combinations = design.problem.without_effect, design.not_identifiable
    if still:
        why = "under one payload, temperature, time and approach nothing depends on"
        return [Text(f"no log det: {why} {', '.join(still)}")]
    more = ", ..." if len(combinations) > most else ""
    return [Text(f"no log det: not estimable from the plan: {', '.join(combinations[:most])}{more}")]


def observability_line(indices: Observability) -> Text:
    """The indices O1 to O5, to compare with published plans."""
    figures = ", ".join(f"{name.upper()} {value:.4g}" for name, value in indices.to_json().items())
    return Text(f"observability indices: {figures}")


def certified(data: dict[str, Any], most: int = 10) -> str:
    """`yes`, `not proven`, or which runs no bound speaks of."""
    outside = data["outside_limits"]
    if outside:
        more = ", ..." if len(outside) > most else ""
        return f"no: outside joint limits or constraints are runs {', '.join(map(str, outside[:most]))}{more}"
    return "yes" if data["certified_optimal"] else "not proven"


def design_tables(design: Design) -> list[Any]:
    """Everything about a plan, the summary first."""
    data = design.to_json()
    return [
        summary_table(data, design.status.value),
        *not_estimable_line(design),
        *repeats_line(design),
        plan_table(design),
        accuracy_table(design),
    ]


def significant(value: float | None, std: float | None) -> str:
    """As many digits as the standard deviation deserves (three of its own)."""
    if value is None:
        return "-"
    if not std:
        return f"{value:.5g}"
    digits = int(np.clip(2 - np.floor(np.log10(abs(std))), 0, 12))
    return f"{value:.{digits}f}" if abs(value) < 1e6 else f"{value:.5g}"


def order_line(found: Ordered) -> Text:
    """What the order of measurement costs."""
    before, after = np.degrees([found.before, found.after])
    return Text(f"order {found.order}: joint travel {before:.0f} -> {after:.0f} deg ({found.saved:.0%} saved)")
