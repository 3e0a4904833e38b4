"""What measurements say, as tables for a terminal (rich)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from doe.report.terminal import NARROW, facts, number, significant, table
from identification.compensate import Compensation
from identification.estimation import Identification
from identification.estimation.result import in_words
from identification.kinematics.corrected_geometry import CorrectedGeometry
from identification.servo import ServoError


def identification_tables(found: Identification, hidden: frozenset[str] = frozenset()) -> list[Any]:
    """Everything about a fit: what must be read first, the summary, the parameters but for those `hidden`."""
    data = found.to_json()
    given = "given" if found.sigma_known else "from the residuals"
    summary = [
        ("method", f"{data['method']}: {found.outcome}"),
        ("RMS error", f"{number(data['rms_before_mm'])} -> {number(data['rms_after_mm'])} mm (arm file -> identified)"),
        ("largest error", f"{number(data['max_before_mm'])} -> {number(data['max_after_mm'])} mm"),
        ("sigma", f"{number(data['sigma_mm'], 5)} mm per axis ({given}), {data['dof']} degrees of freedom"),
    ]
    if data["p_value"] is not None:
        scatter = f"the residuals scatter {number(data['scatter_mm'], 5)} mm"
        summary.append(("chi2", f"{data['chi2']:.2f}, {in_words(data['p_value'])}: {scatter}"))
    summary.append(("95 % intervals", found.uncertainty.sentence))
    warned = [Text(warning, style="bold") for warning in found.warnings]
    shown: list[Any] = [*warned, facts(summary), parameter_table(found, hidden)]
    if found.geometry is not None:
        shown += geometry_tables(found.geometry)
    if data["not_identifiable"]:
        shown.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        shown.extend(Text(f"  {combination}") for combination in data["not_identifiable"])
    return shown


def parameter_table(found: Identification, hidden: frozenset[str] = frozenset()) -> Table:
    """Parameters with 95 % intervals, in file units, but for those `hidden`."""
    keys = ("value", "std", "low_95", "high_95")
    named = zip(found.shown_names, found.to_json()["parameters"], strict=True)
    seen = ((name, p) for name, p in named if p["name"] not in hidden)
    rows = ([name, *(significant(p[key], p["std"]) for key in keys), p["unit"]] for name, p in seen)
    return table(("name", "value", "std", "low 95 %", "high 95 %", "unit"), rows, "Parameters", left=("name", "unit"))


def geometry_tables(found: CorrectedGeometry) -> list[Any]:
    """Where base, measured points and joints of a spatial arm are, and what a controller needs."""
    data = found.to_json()
    poses = [("base", data["base"])] if data["base"] else []
    poses += [(f"tool {name}", place) for name, place in data["tools"].items()]
    keys, angles = ("x_mm", "y_mm", "z_mm", "rx_deg", "ry_deg", "rz_deg"), ("roll_deg", "pitch_deg", "yaw_deg")
    placed = [[name, *(f"{place[key]:z.4f}" if key in place else "" for key in keys)] for name, place in poses]
    rows = [
        [row["name"], *(f"{row[key]:z.4f}" for key in (*keys[:3], *angles)), f"{offset['value']:z.5f} {offset['unit']}"]
        for row, offset in zip(data["geometry"], data["joint_offsets"], strict=True)
    ]
    headings = [[f"{key.replace('_', ' [')}]" for key in some] for some in (keys, (*keys[:3], *angles))]
    return [
        *([table(("", *headings[0]), placed, "Identified poses")] if placed else []),
        table(("joint", *headings[1], "offset"), rows, "Frame of each joint in that of the joint before"),
        "A controller that takes offsets adds minus the offset to each command; the corrected URDF has them in it.",
        *(Text(sentence) for sentence in data["strict_table"]),
    ]


def servo_table(errors: Sequence[ServoError]) -> Table:
    """What is read beyond a command, of each joint."""
    keys = ("offset", "reversal", "rms", "largest", "rest")
    rows = []
    for data in (error.to_json() for error in errors):
        rows.append([str(data["joint"]), *(f"{data[key]:z.5f}" for key in keys), data["unit"]])
    said = "read less commanded: offset + reversal s + rest, s = +1 or -1 the sign of the last motion"
    return table(("joint", *keys, "unit"), rows, "Servo error", caption=said, left=("unit",))


def residual_text(error: float) -> str:
    """Distance of the calibrated model's tip from its target [mm], not to be read as the robot's accuracy."""
    return "< 1e-6" if error < 1e-6 else number(error) if error < 100.0 else f"{error:.0f}"


def compensation_tables(found: Compensation, most: int = 24) -> list[Any]:
    """Joint commands for the first targets, and how many are reached."""
    types = found.joint_types or ("revolute",) * found.commands.shape[1]
    joints = (f"q{j} [{'deg' if kind == 'revolute' else 'mm'}]" for j, kind in enumerate(types, start=1))
    found_rows = zip(found.targets, found.commands_in_file_units, found.errors, found.reached, strict=True)
    rows = (
        [
            f"{row}{'' if reached else ' !'}",
            *(f"{v:.1f}" for v in target),
            *(f"{v:.3f}" for v in command),
            residual_text(error),
        ]
        for row, (target, command, error, reached) in enumerate(found_rows, start=1)
    )
    caption = f"first {most} of {len(found.targets)} targets; --out writes all"
    axes = (f"{axis} [mm]" for axis in "xyz"[: found.targets.shape[1]])
    headings = ("target", *axes, *joints, "left [mm]")
    data = found.to_json()
    unreachable = (
        f"; rows out of reach (!): {', '.join(map(str, data['unreachable'][:20]))}" if data["unreachable"] else ""
    )
    reached = f"{data['reached']} of {data['targets']} targets reached by the calibrated model{unreachable}"
    if found.angles is not None:
        reached += f"; orientations are those wanted to {residual_text(data['max_error_deg'] or 0.0)} deg there"
    return [reached, table(headings, rows, "Commands", most=most, caption=caption, **NARROW)]
