"""An identification as tables for a terminal (rich)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from doe.report.page import Sheet
from doe.report.terminal import estimate_text, facts, number, table, unit_or_dash
from identification.estimation import Identification
from identification.estimation.corrected_values import CorrectedValue
from identification.estimation.shown import p_value_in_words
from identification.servo import FollowingError
from identification.sessions import placing

MOVED = 1e-3  # of the RMS: where a file lacks the place it has been fitted before


def identification_tables(
    found: Identification, hidden: frozenset[str] = frozenset(), nominal: float | None = None
) -> list[Any]:
    """Everything about a fit: what must be read first, the summary, the corrected values but for those `hidden`.

    nominal : RMS distance [mm] that the drawing leaves, where only the place of the arm was estimated
    """
    data = found.to_json()
    of_what = compared_with(found, nominal is not None)
    given = "given" if found.sigma_known else "from the residuals"
    summary = [
        ("method", f"{data['method']}: {found.outcome}"),
        ("RMS error", f"{number(data['rms_before_mm'])} -> {number(data['rms_after_mm'])} mm ({of_what})"),
        *([("drawing", f"{number(nominal)} mm RMS, placed anew as well")] if nominal is not None else []),
        ("largest error", f"{number(data['max_before_mm'])} -> {number(data['max_after_mm'])} mm"),
        *(
            [("expected error", f"{tip_in_words(data)}, if the model is right")]
            if found.expected_tip is not None
            else []
        ),
        ("sigma", f"{number(data['sigma_mm'], 5)} mm per axis ({given}), {data['dof']} degrees of freedom"),
    ]
    if data["p_value"] is not None:
        scatter = f"the residuals scatter {number(data['scatter_mm'], 5)} mm"
        summary.append(("chi2", f"{data['chi2']:.2f}, {p_value_in_words(data['p_value'])}: {scatter}"))
    summary.append(("95 % intervals", found.uncertainty.sentence))
    warned = [Text(warning, style="bold") for warning in found.warnings]
    rows = [row for row in found.corrected_values if row.parameter not in hidden]
    shown: list[Any] = [*warned, facts(summary), corrected_table(rows), *conventions(rows, found.geometry is not None)]
    if found.geometry is not None:
        shown += [Text(sentence) for sentence in found.geometry.strict_table]
    if data["not_identifiable"]:
        shown.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        shown.extend(Text(f"  {combination}") for combination in data["not_identifiable"])
    return shown


def tip_in_words(data: Mapping[str, Any]) -> str:
    """How far the tip may be off where nothing was measured, by the JSON object of `identify`."""
    inside, anywhere = (number(data[key]) for key in ("expected_tip_measured_mm", "expected_tip_mm"))
    return f"{inside} mm at the tip within the angles measured, {anywhere} mm over the joint limits (RMS)"


def compared_with(found: Identification, place: bool = False) -> str:
    """What the errors before and after the fit are those of;  place : nothing but where a calibrated arm stands."""
    if place and found.rms_before > (1.0 + MOVED) * found.rms_after:
        return "where the arm file has it -> found anew"
    known, places = found.geometry is None or found.model.arm.calibration is not None, placing(found.model.parameters)
    fitted = bool(places) and len(places) < len(found.names)
    return f"{'arm file' if known else 'drawing'}{', its place fitted' if fitted else ''} -> identified"


def corrected_sheet(rows: Sequence[CorrectedValue]) -> Sheet:
    """The values to enter in the controller: nominal and corrected, with intervals."""
    keys, rows = ("nominal", "corrected", "std", "low_95", "high_95"), [row for row in rows if not equals_drawing(row)]
    names = [f"{row.name} *" if row.held_by_prior else row.name for row in rows]
    figures = ([estimate_text(getattr(row, key), row.std, row.unit) for key in keys] for row in rows)
    cells = [[name, *values, unit_or_dash(row.unit)] for name, values, row in zip(names, figures, rows, strict=True)]
    return Sheet(("", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"), cells)


def equals_drawing(row: CorrectedValue) -> bool:
    """Whether a value and its interval are the drawing's to the last digit shown."""
    figures = (row.nominal, row.corrected, row.low_95, row.high_95)
    return row.unit in ("mm", "deg") and None not in figures and len({f"{figure:z.5f}" for figure in figures}) == 1


def corrected_table(rows: Sequence[CorrectedValue]) -> Table:
    """The same for a terminal, at most 80 columns wide."""
    sheet = corrected_sheet(rows)
    left, figures = ("", "unit"), sheet.headings[1:]
    return table(sheet.headings, sheet.rows, "Corrected values", left=left, no_wrap=figures, padding=0)


def conventions(rows: Sequence[CorrectedValue], spatial: bool) -> list[str]:
    """What the rows mean to a controller, and which of them the measurements do not determine, in lines."""
    said = ["Zeros: add to the zero of the joint (real = reading + this), or take off every command."]
    said = said if any(row.name.startswith("zero of") for row in rows) else []
    if any(row.parameter == "base_offset.x0" for row in rows):
        frame = "where the arm stands in the frame of the measurements"
        said.append(f"Zero of joint 1 and base_offset: {frame}, for the controller only if it is its own.")
    if spatial:
        said += [
            "Frames: origin of the joint in the frame of the joint before, as in a URDF file; --urdf writes it.",
            "These values belong together: enter all of them.",
        ]
    if held := sum(row.held_by_prior for row in rows):
        said.append(f"* {held} of {len(rows)} are held by the prior: the measurements say next to nothing of them.")
    return said


def servo_table(errors: Sequence[FollowingError]) -> Table:
    """Servo error of each joint: reading less command."""
    keys = ("offset", "reversal", "rms", "largest", "rest")
    rows = []
    for data in (error.to_json() for error in errors):
        rows.append([str(data["joint"]), *(f"{data[key]:z.5f}" for key in keys), data["unit"]])
    said = "read less commanded: offset + reversal s + rest, s = +1 or -1 the sign of the last motion"
    return table(("joint", *keys, "unit"), rows, "Servo error", caption=said, left=("unit",))
