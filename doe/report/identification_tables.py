"""An identification as tables for a terminal (rich)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from doe.report.page import Sheet
from doe.report.terminal import estimate_text, facts, in_a_sentence, number, table, unit_or_dash
from identification.arrays import Array
from identification.errors import InputError
from identification.estimation import Identification
from identification.estimation.corrected_values import CorrectedValue
from identification.estimation.dh_values import Calibrated, dh_places, dh_values
from identification.estimation.shown import p_value_in_words
from identification.files.arm_chain import dh_rows
from identification.kinematics.frames import point_table, pose_table
from identification.kinematics.instrument import RADIUS
from identification.measurements import distances, rms_distance
from identification.servo import FollowingError
from identification.sessions import placing
from identification.validate import DRAWN

ALL_OF_THEM = (
    "All values belong together: do not enter a part of them. --full prints the complete table, --json and --out have "
    "it; --urdf writes it as a URDF file.",
    "--parameters minimal gives a complete set of as few values as will do, with all others as drawn: the one to type "
    "in by hand.",
)
DH_TABLE = "Corrected Denavit-Hartenberg table"
TOGETHER = (
    "Other numbers of the table stay as drawn. All values belong together, base and tool included: enter all of them."
)
BETA = (
    "beta: turn about the new y axis after alpha, where the next axis is nearly parallel (Hayati). A controller that "
    "has no beta cannot take that row; --full prints frames of six numbers, --urdf writes them."
)
MOVED = 1e-3  # of the RMS: where a file lacks the place it has been fitted before


def identification_tables(
    found: Identification,
    hidden: frozenset[str] = frozenset(),
    nominal: float | None = None,
    left_out: float | None = None,
    *,
    drawing: Array | None = None,
    full: bool = True,
    dh: tuple[Sequence[CorrectedValue], Sequence[str]] = ((), ()),
) -> list[Any]:
    """Everything about a fit: warnings, verdict, summary, the corrected values but for those `hidden`.

    nominal : RMS distance [mm] that the drawing leaves, where only the place of the arm was estimated
    drawing : (m, d) residuals [mm] of `drawing_residuals`, where the fit is to be compared with these
    left_out : [mm] of `left_out_rms`;  full : False: of a spatial arm the values that the measurements determine
    dh : the corrected Denavit-Hartenberg table, where the drawing is one, and lines about base and tool beside it
    """
    rows = [row for row in found.corrected_values if row.parameter not in hidden]
    warned = [Text(warning, style="bold") for warning in found.warnings]
    shown: list[Any] = [
        *warned,
        Text(fit_verdict(found, nominal, drawing), style="bold"),
        facts(fit_figures(found, nominal, left_out)),
    ]
    shown += (
        [corrected_table(rows), *conventions(rows, found.geometry is not None)]
        if full
        else dh_tables(*dh)
        if dh[0]
        else in_short(rows, minimal=not hidden)
    )
    if found.geometry is not None and full:
        shown += [Text(sentence) for sentence in found.geometry.strict_table]
    if found.not_identifiable:
        shown.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        shown.extend(Text(f"  {combination}") for combination in found.not_identifiable)
    return shown


def fit_verdict(found: Identification, nominal: float | None = None, drawing: Array | None = None) -> str:
    """Error before and after, in a sentence."""
    was, _, _ = compared_with(found, nominal is not None).partition(" -> ")
    was, before = (was, found.residuals_before) if drawing is None else (f"drawing, {DRAWN['base']}", drawing)
    rms, after = in_a_sentence(rms_distance(before)), in_a_sentence(found.rms_after)
    largest = f"the largest from {in_a_sentence(float(distances(before).max()))} to {in_a_sentence(found.max_after)} mm"
    return f"The fit takes the RMS error from {rms} mm ({was}) to {after} mm, {largest}."


def fit_figures(found: Identification, nominal: float | None, left_out: float | None) -> list[tuple[str, str]]:
    """Figures of a fit by name."""
    data = found.to_json()
    given = "given" if found.sigma_known else "from the residuals"
    rows = [
        ("method", f"{data['method']}: {found.outcome}"),
    ]
    if nominal is not None:
        rows.append(("drawing", f"{number(nominal)} mm RMS, {DRAWN['base']}"))
    if found.expected_tip is not None:
        wrong = "; but chi2 says that it is not" if found.misfit else ""
        rows.append(("expected error", f"{tip_in_words(data)}, if the model is right{wrong}"))
    if left_out is not None:
        said = "mm RMS: each posture predicted by a fit to the others, noise included"
        rows.append(("cross-validated", f"{number(left_out)} {said}"))
    rows.append(("sigma", f"{number(found.sigma, 5)} mm per axis ({given}), {found.dof} degrees of freedom"))
    if data["p_value"] is not None:
        scatter = f"the residuals scatter {number(found.scatter, 5)} mm"
        rows.append(("chi2", f"{data['chi2']:.2f}, {p_value_in_words(data['p_value'])}: {scatter}"))
    return [*rows, ("95 % intervals", found.uncertainty.sentence)]


def dh_table(
    found: Calibrated, values: Sequence[CorrectedValue], arm: Path
) -> tuple[tuple[CorrectedValue, ...], list[str]]:
    """The corrected Denavit-Hartenberg table of an arm file that has one, and lines of base, measured points and the
    radius of a sphere beside it; else empty.

    values : corrected ones, the radius among them
    """
    if (table := dh_rows(arm)) is None:
        return (), []
    try:
        rows, places = dh_values(found, *table), dh_places(found, *table)
    except InputError:  # prismatic joints, or axes that are one
        return (), []
    tables = ((name, pose_table(at) if at.ndim == 2 else point_table(at)) for name, at in places)
    figures = ((name, (f"{key.replace('_', ' [')}] {v:z.3f}" for key, v in one.items())) for name, one in tables)
    radius = [f"{one.name} [mm]: {one.corrected:z.3f} +- {one.std:.3f}" for one in values if one.parameter == RADIUS]
    return rows, [*(f"{name}: {', '.join(said)}" for name, said in figures), *radius]


def dh_tables(rows: Sequence[CorrectedValue], lines: Sequence[str]) -> list[Any]:
    """The corrected Denavit-Hartenberg table, and what belongs to it."""
    return [corrected_table(rows, DH_TABLE), *map(Text, (*lines, *dh_notes(rows)))]


def dh_notes(rows: Sequence[CorrectedValue]) -> list[str]:
    """How such a table is to be used."""
    return [TOGETHER, *([BETA] if any(row.name.endswith(" beta") for row in rows) else [])]


def in_short(rows: Sequence[CorrectedValue], minimal: bool) -> list[Any]:
    """Of a spatial arm the values that the measurements determine, the others counted, and where all of them are.

    minimal : whether a minimal set can be fitted instead, which has no prior
    """
    frames = [row for row in rows if row.nominal is not None]
    sure = [row for row in frames if not row.weak and not negligible(row)]
    weak = [row.name for row in frames if row.weak]
    title = f"Well determined: {len(sure)} of {len(frames)} corrected values"
    shown: list[Any] = [corrected_table(sure, title)]
    if weak:
        shown.append(Text(f"Weakly determined, mostly the prior of [machining]: {named_by_place(weak)}."))
    if same := len(frames) - len(sure) - len(weak):
        shown.append(Text(f"As drawn to three decimals: {same} more."))
    shown += [Text(line) for line in places_in_words(rows)]
    return [*shown, *map(Text, ALL_OF_THEM if minimal else ALL_OF_THEM[:1])]


def negligible(row: CorrectedValue) -> bool:
    """Whether a length or an angle and its interval are the drawing's to three decimals."""
    figures = (row.nominal, row.corrected, row.low_95, row.high_95)
    return row.unit in ("mm", "deg") and None not in figures and len({f"{figure:z.3f}" for figure in figures}) == 1


def named_by_place(names: Sequence[str]) -> str:
    """`joint 2 x, y, yaw; joint 3 z`; zeros of joints as `zero of joint 5`."""
    found: dict[str, list[str]] = {}
    for name in names:
        place, _, axis = name.rpartition(" ")
        found.setdefault("zero of joint" if place == "zero of joint" else place, []).append(axis)
    return "; ".join(f"{place} {', '.join(axes)}" for place, axes in found.items())


def places_in_words(rows: Sequence[CorrectedValue]) -> list[str]:
    """Where base and measured points are, a line each, with standard deviations: of parallel axes only the sum of
    both heights may be known."""
    found: dict[str, list[str]] = {}
    for row in rows:
        if row.nominal is None and row.corrected is not None:
            place, _, axis = row.name.rpartition(" ")
            known = "" if row.std is None else f" +- {number(row.std, 3)}"
            unit = "" if row.unit == "mm" else f" {row.unit}"
            found.setdefault(place, []).append(f"{axis} {row.corrected:z.3f}{known}{unit}")
    return [f"{place} [mm]: {', '.join(figures)}" for place, figures in found.items()]


def tip_in_words(data: Mapping[str, Any]) -> str:
    """How far the tip may be off where nothing was measured, by the JSON object of `identify`."""
    inside, anywhere = (number(data[key]) for key in ("expected_tip_measured_mm", "expected_tip_mm"))
    return f"{inside} mm at the tip at postures like those measured, {anywhere} mm over the joint limits (RMS)"


def compared_with(found: Identification, place: bool = False) -> str:
    """What the errors before and after the fit are those of;  place : nothing but where a calibrated arm stands."""
    if place and found.rms_before > (1.0 + MOVED) * found.rms_after:
        return "where the arm file has it -> found anew"
    arm, places = getattr(found.model, "arm", None), placing(found.model.parameters)
    known, fitted = arm is None or arm.calibration is not None, bool(places) and len(places) < len(found.names)
    return f"{'arm file' if known else 'drawing'}, {DRAWN['base' if fitted else 'none']} -> identified"


def corrected_sheet(rows: Sequence[CorrectedValue]) -> Sheet:
    """The values to enter in the controller: nominal and corrected, with intervals."""
    keys, rows = ("nominal", "corrected", "std", "low_95", "high_95"), [row for row in rows if not equals_drawing(row)]
    names = [f"{row.name} *" if row.weak else row.name for row in rows]
    figures = ([estimate_text(getattr(row, key), row.std, row.unit) for key in keys] for row in rows)
    cells = [[name, *values, unit_or_dash(row.unit)] for name, values, row in zip(names, figures, rows, strict=True)]
    return Sheet(("", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"), cells)


def equals_drawing(row: CorrectedValue) -> bool:
    """Whether a value and its interval are the drawing's to the last digit shown."""
    figures = (row.nominal, row.corrected, row.low_95, row.high_95)
    return row.unit in ("mm", "deg") and None not in figures and len({f"{figure:z.5f}" for figure in figures}) == 1


def corrected_table(rows: Sequence[CorrectedValue], title: str = "Corrected values") -> Table:
    """The same for a terminal, at most 80 columns wide."""
    sheet = corrected_sheet(rows)
    left, figures = ("", "unit"), sheet.headings[1:]
    return table(sheet.headings, sheet.rows, title, left=left, no_wrap=figures, padding=0)


def conventions(rows: Sequence[CorrectedValue], spatial: bool) -> list[str]:
    """What the rows mean to a controller, and which of them the measurements do not determine, in lines."""
    said = ["Zeros: add to the zero of the joint (real = reading + this), or take off every command."]
    said = said if any(row.name.startswith("zero of") for row in rows) else []
    if any(row.parameter == "base_offset.x0" for row in rows):
        typed = "type them into the controller only if the measurements are in the controller's own frame"
        said.append(f"Zero of joint 1 and base_offset: where the arm stands; {typed}.")
    if spatial:
        said += [
            "Frames: origin of the joint in the frame of the joint before, as in a URDF file; --urdf writes it.",
            "These values belong together: enter all of them.",
        ]
    if weak := sum(row.weak for row in rows):
        said.append(
            f"* {weak} of {len(rows)} are weakly determined: the measurements leave more than half of the standard "
            "deviation that they had before, and the prior holds them."
        )
    return said


def servo_table(errors: Sequence[FollowingError]) -> Table:
    """Servo error of each joint: reading less command."""
    keys = ("offset", "reversal", "rms", "largest", "rest")
    rows = []
    for data in (error.to_json() for error in errors):
        rows.append([str(data["joint"]), *(f"{data[key]:z.5f}" for key in keys), data["unit"]])
    said = "read less commanded: offset + reversal s + rest, s = +1 or -1 the sign of the last motion"
    return table(("joint", *keys, "unit"), rows, "Servo error", caption=said, left=("unit",))
