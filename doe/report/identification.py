"""What measurements give, as documents: their inspection, a fit and its values, a validation, commands for targets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from identification.arrays import Array
from identification.compensate.compensation import Compensation
from identification.document import Action, Document, Facts, Section, Sheet
from identification.errors import InputError
from identification.estimation import Identification
from identification.estimation.corrected_values import Calibrated, CorrectedValue, dh_places, dh_values
from identification.estimation.result import facts
from identification.files.arm_chain import dh_rows
from identification.inspection.inspection import Inspection
from identification.kinematics.frames import point_table, pose_table
from identification.kinematics.instrument import RADIUS
from identification.kinematics.parameters import REVOLUTE
from identification.numbers_in_text import estimate_text, in_a_sentence, number, unit_or_dash
from identification.sessions import placing
from identification.validate import DRAWN, drawing_in_words

Data = Mapping[str, Any]  # what a command says with --json

ALL_OF_THEM = (
    "All values belong together: do not enter a part of them. --full prints the complete table, --json and --out have "
    "it; --urdf writes it as a URDF file.",
    "--parameters minimal gives a complete set of as few values as will do, with all others as drawn: the one to type "
    "in by hand.",
)
BETA = (
    "beta: turn about the new y axis after alpha, where the next axis is nearly parallel (Hayati). A controller that "
    "has no beta cannot take that row; --full prints frames of six numbers, --urdf writes them."
)
MOVED = 1e-3  # of the RMS: where a file lacks the place it has been fitted before


# -- armcal check ------------------------------------------------------------------------------------------------------
def inspection_document(result: Inspection, arm: str, rows: str) -> Document:
    """Problems first, then the facts, the range of each joint, what the data cannot say, and the next command."""
    data, few = result.to_json(), result.enough is not None and result.enough.few
    verdict = f"No problems found in these data{', but they are few for a fit' if few else ''}."
    parts: list[Any] = [f"  - {sentence}" for sentence in result.problems]
    counting = result.readings.counting
    if counting is not None and set(result.readings.sentences) & set(result.problems):
        parts.append("If the controller counts that way, the arm file may say so, and data and commands stay its:")
        parts += [f"    {line}" for line in counting.toml.splitlines()]
    figures: list[tuple[str, str | None]] = [
        ("rows", f"{result.rows} rows, {result.postures} postures"),
        ("columns besides", ", ".join(result.given) or "none"),
        ("sessions", ", ".join(result.sessions)),
        ("measured points", ", ".join(result.markers)),
        ("repeats scatter by", None if result.floor.source is None else f"{result.floor.value:.4g} mm"),
    ]
    if result.other_units:
        return Document("Inspection", ["Fix these first:"], [*parts, Facts(figures)])
    figures.append(("drawing", f"{number(result.drawing)} mm RMS, {DRAWN['base']}"))
    figures.append(("a fit leaves", f"{number(data['rms_fitted_mm'])} mm RMS"))
    if (enough := result.enough) is not None:
        figures.append(("such a fit", enough.count))
        if not result.problems:  # else data that are to be put right would be judged
            weak = [f"{name} (std {std:{'.3g' if std < 1000.0 else '.0f'}} {unit})" for name, std, unit in enough.weak]
            figures.append(("determines", "; ".join(enough.identifiable) or "nothing by itself"))
            figures += [("only weakly", "; ".join(weak)), ("does not", "; ".join(enough.open))]
            figures.append(("accuracy", enough.accuracy))
    joints = []
    for joint in result.joints:
        limits = (
            f"{joint.in_file_units(x):.2f}" if joint.limited else "none" for x in (joint.limit_low, joint.limit_high)
        )
        ranges = (f"{joint.in_file_units(x):.2f}" for x in (joint.low, joint.high))
        joints.append([str(joint.joint), *ranges, *limits, joint.unit, str(joint.outside)])
    headings = ("joint", "from", "to", "lower limit", "upper limit", "unit", "rows outside")
    parts += [Facts(figures), Sheet(headings, joints, "Joints"), *(f"note: {note}" for note in result.notes)]
    if result.sag is not None and result.sag.recommended:
        parts.append("\n".join(["", *result.sag.lines, ""]))
    if result.problems:
        return Document("Inspection", ["Fix these first:"], parts)
    then = f"armcal identify {arm} {rows} --out calibrated.toml, then armcal diagnose {arm} {rows}"
    return Document("Inspection", [verdict], [*parts, f"Next: {then}"])


# -- armcal identify ---------------------------------------------------------------------------------------------------
def identification_document(
    result: Identification, data: Data, hidden: frozenset[str] = frozenset(), *, full: bool = True
) -> Document:
    """Everything about a fit: warnings, verdict, figures, the corrected values but for those `hidden`.

    data : what `armcal identify --json` says of it
    full : False: of a spatial arm its Denavit-Hartenberg table, or the values that the measurements determine
    """
    rows = [row for row in result.corrected_values if row.parameter not in hidden]
    dh = [CorrectedValue(**row) for row in data.get("dh_table", ())]
    if full:
        strict = [] if result.geometry is None else result.geometry.strict_table
        sections = [corrected_section("Corrected values", rows, result.geometry is not None, *strict)]
    else:
        sections = dh_sections(dh, data.get("dh_places", ())) or [in_short(rows, minimal=not hidden)]
    left, drawn = data.get("cross_validated_mm"), data.get("rms_nominal_mm")
    others = "mm RMS: each posture predicted by a fit to the others, noise included"
    figures: list[tuple[str, str | None]] = [
        *facts(result),
        ("cross-validated", None if left is None else f"{number(left)} {others}"),
        ("drawing", None if drawn is None else f"{number(drawn)} mm RMS, {DRAWN['base']}"),
    ]
    parts: list[Any] = [Facts(figures), *sections]
    if result.not_identifiable:
        parts.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        parts += [f"  {combination}" for combination in result.not_identifiable]
    parts += servo_parts(data.get("servo_error", ()))
    verdict = [identification_verdict(data, compared_with(result, "rms_nominal_mm" in data))]
    if not data.get("offered", {"better": True})["better"]:
        verdict.insert(0, hardly_better(data["offered"]))
    return Document("Identification", verdict, parts, warnings=result.warnings)


def identification_verdict(data: Data, before: str = "") -> str:
    """What a fit does to the error on its own data.

    before : what the error before is that of, where it is not the drawing's
    """
    drawn = None if "only" in data else data.get("rms_drawing_mm")
    was = f"{in_a_sentence(data['rms_before_mm'])}{before and f' mm ({before})'}"
    figures = f"{was if drawn is None else drawing_in_words(drawn)} to {in_a_sentence(data['rms_after_mm'])} mm"
    return f"On its own data the calibration takes the RMS error from {figures}."


def hardly_better(offered: Data) -> str:
    """That a model predicts what it has not seen no better than the geometry alone, or only within chance."""
    sure = "no better" if offered["rms_mm"] >= offered["rms_geometry_mm"] else "no better beyond chance"
    model, geometry = (
        f"{in_a_sentence(offered[f'rms{of}_mm'])} mm RMS (largest {in_a_sentence(offered[f'max{of}_mm'])})"
        for of in ("", "_geometry")
    )
    return (
        f"This model predicts {sure} than the geometry alone: {model} against {geometry} in rows that no fit has seen."
    )


def expected_elsewhere(data: Data) -> str:
    """What a fit promises where nothing was measured; files of earlier versions do not say."""
    if data.get("expected_tip_mm") is None or data.get("expected_tip_measured_mm") is None:
        return ""
    inside, anywhere = (number(data[key]) for key in ("expected_tip_measured_mm", "expected_tip_mm"))
    tip = f"{inside} mm at the tip at postures like those measured, {anywhere} mm over the joint limits (RMS)"
    return f" Expected error if the model is right: {tip}."


def compared_with(result: Identification, place: bool = False) -> str:
    """What the errors before the fit are those of;  place : nothing but where a calibrated arm stands."""
    if place and result.rms_before > (1.0 + MOVED) * result.rms_after:
        return "where the arm file has it"
    arm, places = getattr(result.model, "arm", None), placing(result.model.parameters)
    calibrated = arm is None or arm.calibration is not None
    fitted = bool(places) and len(places) < len(result.names)
    return f"{'arm file' if calibrated else 'drawing'}, {DRAWN['base' if fitted else 'none']}"


def corrected_section(
    title: str, rows: Sequence[CorrectedValue], spatial: bool, *remarks: str, folded: bool = False
) -> Section:
    """The corrected values to enter in the controller, and what they mean to it."""
    return Section(title, [corrected_table(rows), *conventions(rows, spatial), *remarks], folded)


def corrected_table(rows: Sequence[CorrectedValue], title: str = "") -> Sheet:
    """Nominal and corrected values with intervals, without those that are the drawing's to the last digit shown."""
    keys = ("nominal", "corrected", "std", "low_95", "high_95")
    cells = [
        [
            f"{row.name} *" if row.weak else row.name,
            *(estimate_text(getattr(row, key), row.std, row.unit) for key in keys),
            unit_or_dash(row.unit),
        ]
        for row in rows
        if not equals_drawing(row, 5)
    ]
    return Sheet(("", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"), cells, title)


def equals_drawing(row: CorrectedValue, decimals: int) -> bool:
    """Whether a length or an angle and its interval are the drawing's to this many decimals."""
    figures = (row.nominal, row.corrected, row.low_95, row.high_95)
    same = {None if figure is None else f"{figure:z.{decimals}f}" for figure in figures}
    return row.unit in ("mm", "deg") and None not in same and len(same) == 1


def conventions(rows: Sequence[CorrectedValue], spatial: bool) -> list[str]:
    """What the rows mean to a controller, and which of them the measurements do not determine, in lines."""
    lines = ["Zeros: add to the zero of the joint (real = reading + this), or take off every command."]
    lines = lines if any(row.name.startswith("zero of") for row in rows) else []
    if any(row.parameter == "base_offset.x0" for row in rows):
        typed = "type them into the controller only if the measurements are in the controller's own frame"
        lines.append(f"Zero of joint 1 and base_offset: where the arm stands; {typed}.")
    if spatial:
        lines += [
            "Frames: origin of the joint in the frame of the joint before, as in a URDF file; --urdf writes it.",
            "These values belong together: enter all of them.",
        ]
    if weak := sum(row.weak for row in rows):
        lines.append(
            f"* {weak} of {len(rows)} are weakly determined: the measurements leave more than half of the standard "
            "deviation that they had before, and the prior holds them."
        )
    return lines


def dh_table(
    calibrated: Calibrated, values: Sequence[CorrectedValue], arm: Path
) -> tuple[tuple[CorrectedValue, ...], list[str]]:
    """The corrected Denavit-Hartenberg table of an arm file that has one, and lines of base, measured points and the
    radius of a sphere beside it; else empty.

    values : corrected ones, the radius among them
    """
    if (table := dh_rows(arm)) is None:
        return (), []
    try:
        rows, places = dh_values(calibrated, *table), dh_places(calibrated, *table)
    except InputError:  # prismatic joints, or axes that are one
        return (), []
    lines = []
    for name, at in places:
        figures = (pose_table(at) if at.ndim == 2 else point_table(at)).items()
        lines.append(f"{name}: " + ", ".join(f"{key.replace('_', ' [')}] {value:z.3f}" for key, value in figures))
    radius = [f"{one.name} [mm]: {one.corrected:z.3f} +- {one.std:.3f}" for one in values if one.parameter == RADIUS]
    return rows, [*lines, *radius]


def dh_sections(rows: Sequence[CorrectedValue], lines: Sequence[str], name: str = "") -> list[Section]:
    """The corrected Denavit-Hartenberg table, what belongs to it and how it is to be used; none without rows."""
    together = (
        "Other numbers of the table stay as drawn. All values belong together, base and tool included: enter all."
    )
    beta = [BETA] if any(row.name.endswith(" beta") for row in rows) else []
    title = f"Corrected Denavit-Hartenberg table{name and f': {name}'}"
    return [Section(title, [corrected_table(rows), *lines, together, *beta])] if rows else []


def in_short(rows: Sequence[CorrectedValue], minimal: bool) -> Section:
    """Of a spatial arm the values that the measurements determine, the others counted, and where all of them are.

    minimal : whether a minimal set can be fitted instead, which has no prior
    """
    frames = [row for row in rows if row.nominal is not None]
    sure = [row for row in frames if not row.weak and not equals_drawing(row, 3)]
    weak: dict[str, list[str]] = {}  # `joint 2 x, y, yaw; zero of joint 5`
    for place, _, axis in (row.name.rpartition(" ") for row in frames if row.weak):
        weak.setdefault(place, []).append(axis)
    parts: list[Any] = [corrected_table(sure)]
    if weak:
        named = "; ".join(f"{place} {', '.join(axes)}" for place, axes in weak.items())
        parts.append(f"Weakly determined, mostly the prior of [machining]: {named}.")
    if same := len(frames) - len(sure) - sum(map(len, weak.values())):
        parts.append(f"As drawn to three decimals: {same} more.")
    places: dict[str, list[str]] = {}  # base and points, with deviations: of parallel axes only a sum may be known
    for row in rows:
        if row.nominal is None and row.corrected is not None:
            place, _, axis = row.name.rpartition(" ")
            std = "" if row.std is None else f" +- {number(row.std, 3)}"
            unit = "" if row.unit == "mm" else f" {row.unit}"
            places.setdefault(place, []).append(f"{axis} {row.corrected:z.3f}{std}{unit}")
    parts += [f"{place} [mm]: {', '.join(figures)}" for place, figures in places.items()]
    title = f"Well determined: {len(sure)} of {len(frames)} corrected values"
    return Section(title, [*parts, *(ALL_OF_THEM if minimal else ALL_OF_THEM[:1])])


def servo_parts(errors: Sequence[Data]) -> list[Any]:
    """Servo error of each joint, reading less command, and how it is read;  errors : key `servo_error`"""
    keys = ("offset", "reversal", "rms", "largest", "rest")
    rows = [[str(row["joint"]), *(f"{row[key]:z.5f}" for key in keys), row["unit"]] for row in errors]
    meaning = "read less commanded: offset + reversal s + rest, s = +1 or -1 the sign of the last motion"
    return [Sheet(("joint", *keys, "unit"), rows, "Servo error"), meaning] if rows else []


def correct(arm: str) -> Action:
    """Commands from a calibrated arm."""
    return Action("Correct the robot's commands with it:", f"armcal compensate {arm} targets.csv --out commands.csv")


def identify_command(arm: str, rows: str, fit: str = "", out: str = "calibrated.toml") -> str:
    """The command that fits measurements;  fit : of `Plan`, without which it does not keep what the plan promises"""
    return f"armcal identify {arm} {rows}{f' --{fit}' if fit else ''} --out {out}"


def identification_actions(
    arm: str,
    rows: str,
    written: Path | None,
    *,
    diagnosed: bool,
    allowed_for: bool = False,
    better: bool = True,
    mounted_anew: bool = False,
) -> list[Action]:
    """What follows from an identification.

    written : the calibrated arm, where it has been;  diagnosed : its effects have been looked for;  allowed_for : the
    library's effects are in the model, held by a prior;  better : than the geometry alone
    mounted_anew : reflectors are elsewhere in some session, which the fit takes for the same
    """
    alone = identify_command(arm, rows)
    if mounted_anew:
        why = "Give these reflectors another name in those sessions, in the column marker, and fit again:"
        return [Action(why, identify_command(arm, rows, out=str(written or "calibrated.toml")))]
    keep = [] if written else [Action("Keep the calibration: add --out calibrated.toml to this command.")]
    look, *use = calibrated_actions(arm, rows, str(written or "calibrated.toml"))
    if not allowed_for:
        return [*keep, *([] if diagnosed else [look]), *use]
    if not better:
        keep = [Action("Leave --library-prior away, since the geometry alone predicts as well:", alone)]
        use = [correct("calibrated.toml")]
    why = "Effects that may be missing are allowed for, and none is named. To know which there are:"
    return [*keep, *use, Action(why, look.command)]


def calibrated_actions(
    arm: str = "arm.toml", rows: str = "data.csv", calibrated: str = "calibrated.toml"
) -> list[Action]:
    """What a calibration is for, and what it needs before."""
    return [
        Action("Look for what the model lacks:", f"armcal diagnose {arm} {rows} --report gap.html"),
        Action("See whether it holds on another day:", f"armcal validate {calibrated} other.csv"),
        correct(calibrated),
    ]


# -- armcal validate ---------------------------------------------------------------------------------------------------
def validation_actions(better: bool, refit: str, model: str, rows: str, *, beyond: bool = False) -> list[Action]:
    """What to do with a model that predicts other measurements, or does not;  beyond : as for the document"""
    why = "Most rows are at angles that the calibration has not seen. A fit that reaches farther from its data:"
    far = [Action(why, identify_command("arm.toml", "data.csv", "library-prior"))] if beyond else []
    if better:
        return [*far, correct(model)]
    zeros = Action("Find the zeros of the joints again:", f"armcal identify {model} {rows} --only joint_offsets,base")
    if refit == "offsets":
        return [*far, zeros]
    asked = f"armcal validate {model} {rows} --refit offsets"
    return [
        *far,
        Action("See whether the zeros of the joints have moved, and what refitting them gains:", asked),
        zeros,
    ]


# -- armcal compensate -------------------------------------------------------------------------------------------------
def compensation_document(result: Compensation) -> Document:
    """How many targets are reached and which are not, then joint commands for the first ones."""
    reached = f"{np.count_nonzero(result.reached)} of {len(result.targets)} targets reached by the calibrated model"
    if result.model_rms is not None:
        reached += f" (RMS {result.model_rms:.4g} mm on its own measurements)"
    if result.angles is not None and result.reached.any():
        reached += (
            f"; orientations are those wanted to {miss_text(result.to_json()['max_error_deg'])} deg, by the same model"
        )
    reasons = [f"target {k} ! {message}" for k, message in enumerate(result.messages, start=1) if message]
    rest = [f"... and {len(reasons) - 24} more without a command; --out writes all"] if len(reasons) > 24 else []
    types = result.joint_types or (REVOLUTE,) * result.commands.shape[1]
    digits = 3 if len(types) + result.targets.shape[1] <= 6 else 2  # of more joints and axes than 80 columns have room
    joints = [f"q{j}" if kind == REVOLUTE else f"q{j} [mm]" for j, kind in enumerate(types, start=1)]
    commands = np.where(np.isnan(result.safe_commands), np.nan, result.commands_in_file_units)
    rows = command_rows(result.targets, commands, result.left, digits)
    headings = ["row", *"xyz"[: result.targets.shape[1]], *joints, "miss"]
    table = Sheet(headings, rows, "Targets and miss [mm], commands [deg]", 24)
    rounded = [] if digits == 3 else ["Rounded to 0.01 deg here; --out and --json give every digit."]
    verdict = " ".join([f"{reached}.", *without_command(result)])
    return Document("Commands", [verdict], [table, *rounded, *reasons[:24], *rest], warnings=result.warnings)


def without_command(result: Compensation) -> list[str]:
    """How many targets have no command, and why; in one sentence, none where every target is reached."""
    rows = (np.flatnonzero(~result.reached) + 1).tolist()
    counts = {"out of reach": ~result.near, "barred by a constraint": result.near & ~result.reached}
    why = {reason: int(np.count_nonzero(which)) for reason, which in counts.items() if which.any()}
    counted = ", ".join(f"{count} {reason}" if len(why) > 1 else reason for reason, count in why.items())
    have = "have" if len(rows) > 1 else "has"
    return [f"{len(rows)} {have} no command (angles left empty): {counted} ({rows_listed(rows)})."] if rows else []


def rows_listed(rows: Sequence[int]) -> str:
    """`row 3`, `rows 1, 5`; of many the first eight."""
    return f"row{'s' * (len(rows) > 1)} {', '.join(map(str, rows[:8]))}{', ...' if len(rows) > 8 else ''}"


def command_rows(targets: Array, commands: Array, miss: Array, digits: int = 3) -> list[list[str]]:
    """A row of text for each target: its number, (k, d) targets [mm], (k, n) commands [file units], (k,) miss [mm].

    digits : decimals of commands, two more than of targets
    """
    return [
        [
            str(row),
            *(f"{value:.{digits - 2}f}" for value in target),
            *("-" if np.isnan(value) else f"{value:.{digits}f}" for value in command),
            miss_text(error),
        ]
        for row, (target, command, error) in enumerate(zip(targets, commands, miss, strict=True), start=1)
    ]


def miss_text(error: float) -> str:
    """Distance of the calibrated model's tip from its target [mm], not to be read as the robot's accuracy; a dash for
    NaN."""
    if np.isnan(error):
        return "-"
    return "< 1e-6" if error < 1e-6 else number(error) if error < 100.0 else f"{error:.0f}"
