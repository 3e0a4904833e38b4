"""What measurements say, as tables for a terminal (rich)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.report.terminal import facts, number, significant, table
from identification.compensate import Compensation
from identification.estimation import Identification

MISFIT = 0.01  # p-value of chi2 below which the reader is warned


def identification_tables(found: Identification) -> list[Any]:
    """Everything about a fit, the summary first."""
    data = found.to_json()
    summary = [
        ("method", f"{data['method']}: {found.outcome}"),
        ("RMS", f"{number(data['rms_before_mm'])} -> {number(data['rms_after_mm'])} mm"),
        ("largest", f"{number(data['max_before_mm'])} -> {number(data['max_after_mm'])} mm"),
        ("sigma", f"{number(data['sigma_mm'], 5)} mm per axis, {data['dof']} degrees of freedom"),
    ]
    if data["p_value"] is not None:
        summary.append(("chi2", f"{data['chi2']:.2f}, p = {data['p_value']:.3g}"))
        if data["p_value"] < MISFIT:
            summary.append(("misfit", misfit(data)))
    shown: list[Any] = [facts(summary), parameter_table(data)]
    if data["not_identifiable"]:
        shown.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        shown.extend(Text(f"  {combination}") for combination in data["not_identifiable"])
    return shown


def misfit(data: dict[str, Any]) -> str:
    """What a small p-value means for the intervals."""
    found = f"residuals are too large for sigma = {number(data['sigma_mm'], 3)} mm (p = {data['p_value']:.1g})"
    return f"{found}: the model is incomplete or sigma too small, and the intervals are too narrow; see armcal diagnose"


def parameter_table(data: dict[str, Any]) -> Table:
    """Parameters with 95 % intervals, in file units."""
    keys = ("value", "std", "low_95", "high_95")
    rows = ([p["name"], *(significant(p[key], p["std"]) for key in keys), p["unit"]] for p in data["parameters"])
    return table(("name", "value", "std", "low 95 %", "high 95 %", "unit"), rows, "Parameters", left=("name", "unit"))


def residual_text(error: float) -> str:
    """Distance of the calibrated model's tip from its target [mm], not to be read as the robot's accuracy."""
    return "< 1e-6" if error < 1e-6 else number(error)


def compensation_tables(found: Compensation, most: int = 24) -> list[Any]:
    """Joint commands for the first targets, and how many are reached."""
    joints = (f"q{j + 1} [deg]" for j in range(found.commands.shape[1]))
    found_rows = zip(found.targets, np.degrees(found.commands), found.errors, strict=True)
    rows = (
        [str(row), *(f"{v:.3f}" for v in target), *(f"{v:.5f}" for v in command), residual_text(error)]
        for row, (target, command, error) in enumerate(found_rows, start=1)
    )
    caption = f"first {most} of {len(found.targets)} targets; --out writes all"
    headings = ("target", "x [mm]", "y [mm]", *joints, "residual [mm]")
    data = found.to_json()
    unreachable = f"; rows out of reach: {', '.join(map(str, data['unreachable'][:20]))}" if data["unreachable"] else ""
    reached = f"{data['reached']} of {data['targets']} targets reached{unreachable}"
    return [reached, table(headings, rows, "Commands", most=most, caption=caption)]
