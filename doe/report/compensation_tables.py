"""Joint commands for targets as tables for a terminal (rich)."""

from __future__ import annotations

from typing import Any

import numpy as np
from rich.text import Text

from doe.report.page import Section, Sheet
from doe.report.terminal import number, table
from identification.arm import Arm
from identification.compensate.compensation import Compensation
from identification.files.csv import Table
from identification.kinematics.parameters import REVOLUTE

MOST_ROWS = 8  # row numbers in a sentence


def residual_text(error: float) -> str:
    """Distance of the calibrated model's tip from its target [mm], not to be read as the robot's accuracy; a dash for
    NaN."""
    if np.isnan(error):
        return "-"
    return "< 1e-6" if error < 1e-6 else number(error) if error < 100.0 else f"{error:.0f}"


def compensation_tables(found: Compensation, most: int = 24) -> list[Any]:
    """How many targets are reached and which are not, then joint commands for the first ones."""
    said = [f"target {k} ! {message}" for k, message in enumerate(found.messages, start=1) if message]
    more = [f"... and {len(said) - most} more without a command; --out writes all"] if len(said) > most else []
    return [
        Text(" ".join([reached_in_words(found), *without_command(found)]), style="bold"),
        *(Text(warning, style="bold") for warning in found.warnings),
        *command_table(found, most),
        *map(Text, said[:most]),
        *more,
    ]


def reached_in_words(found: Compensation) -> str:
    """How many targets are reached, and how good the model is that says so."""
    reached = f"{np.count_nonzero(found.reached)} of {len(found.targets)} targets reached by the calibrated model"
    if found.model_rms is not None:
        reached += f" (RMS {found.model_rms:.4g} mm on its own measurements)"
    if found.angles is not None and found.reached.any():
        largest = found.to_json()["max_error_deg"]
        reached += f"; orientations are those wanted to {residual_text(largest)} deg, by the same model"
    return f"{reached}."


def without_command(found: Compensation) -> list[str]:
    """How many targets have no command, and why; in one sentence, none where every target is reached."""
    rows = (np.flatnonzero(~found.reached) + 1).tolist()
    if not rows:
        return []
    out, barred = int(np.count_nonzero(~found.near)), int(np.count_nonzero(found.near & ~found.reached))
    why = {"out of reach": out, "barred by a constraint": barred}
    counted = [f"{count} {reason}" if out and barred else reason for reason, count in why.items() if count]
    listed = f"{', '.join(counted)} ({rows_listed(rows)})"
    return [f"{len(rows)} {'have' if len(rows) > 1 else 'has'} no command (angles left empty): {listed}."]


def rows_listed(rows: list[int]) -> str:
    """`row 3`, `rows 1, 5`; of many the first."""
    which = ", ".join(map(str, rows[:MOST_ROWS])) + (", ..." if len(rows) > MOST_ROWS else "")
    return f"row{'s' * (len(rows) > 1)} {which}"


def command_table(found: Compensation, most: int) -> list[Any]:
    """The first commands; of more joints and axes than fit 80 columns with fewer decimals, which is said."""
    types, axes = found.joint_types or (REVOLUTE,) * found.commands.shape[1], "xyz"[: found.targets.shape[1]]
    fine = len(types) + len(axes) <= 6
    commands = np.where(np.isnan(found.safe_commands), np.nan, found.commands_in_file_units)
    found_rows = zip(found.targets, commands, found.left, found.reached, strict=True)
    rows = (
        [
            f"{row}{'' if reached else ' !'}",
            *(f"{v:.{1 if fine else 0}f}" for v in target),
            *("-" if np.isnan(v) else f"{v:.{3 if fine else 2}f}" for v in command),
            residual_text(error),
        ]
        for row, (target, command, error, reached) in enumerate(found_rows, start=1)
    )
    joints = (f"q{j}" if kind == REVOLUTE else f"q{j} [mm]" for j, kind in enumerate(types, start=1))
    headings = ("row", *(f"{axis} [mm]" if fine else axis for axis in axes), *joints, "miss")
    caption = f"first {most} of {len(found.targets)} targets; --out writes all"
    shown = table(
        headings,
        rows,
        "Targets and miss [mm], commands [deg]",
        most=most,
        caption=caption,
        padding=(0, 0, 0, int(fine)),
    )
    return [shown, *([] if fine else [Text("Rounded to 0.01 deg here; --out and --json give every digit.")])]


def commanded_in_words(name: str, commands: Table) -> str:
    """How many targets a file of commands reaches;  name : of the file"""
    reached = commands.floats("reachable") > 0.0
    missing = (np.flatnonzero(~reached) + 1).tolist()
    none = f"; {rows_listed(missing)} {'have' if len(missing) > 1 else 'has'} none" if missing else ""
    return f"{name} has commands for {np.count_nonzero(reached)} of {len(commands)} targets{none}."


def commands_section(name: str, commands: Table, arm: Arm, most: int = 200) -> Section:
    """The part of a page about a file that `armcal compensate` wrote, of which the first rows are shown."""
    joints = [f"q{j}_{'deg' if kind == REVOLUTE else 'mm'}" for j, kind in enumerate(arm.joint_types, start=1)]
    axes = [f"{axis}_mm" for axis in "xyz"[: arm.dimension]]
    numbers = {key: commands.floats(key, empty=np.nan) for key in (*joints, "error_mm")}
    numbers |= {key: commands.floats(key) for key in axes}
    messages = commands.frame["message"].fill_null("").to_list() if "message" in commands else [""] * len(commands)
    rows = [
        [
            str(row + 1),
            *(f"{numbers[key][row]:.1f}" for key in axes),
            *("-" if np.isnan(numbers[key][row]) else f"{numbers[key][row]:.3f}" for key in joints),
            residual_text(float(numbers["error_mm"][row])),
            str(messages[row]),
        ]
        for row in range(min(len(commands), most))
    ]
    more = f" The first {most} rows; the file has all." if len(commands) > most else ""
    lead = f"{commanded_in_words(name, commands)} The miss is the calibrated model's, not the robot's accuracy.{more}"
    headings = ["row", *axes, *joints, "miss [mm]", "why there is none"]
    return Section(f"Joint commands: {name}", lead, [Sheet(headings, rows)])
