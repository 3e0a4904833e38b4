"""A fit as a document: its figures, the corrected values for the controller, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.document import (
    Action,
    Document,
    Facts,
    Section,
    Sheet,
    estimate_text,
    in_a_sentence,
    number,
    to_significant_digits,
    unit_or_dash,
)
from identification.sessions import placing

if TYPE_CHECKING:
    from identification.estimation.result import CorrectedValue, Identification

Data = Mapping[str, Any]  # what a command says with --json

MISFIT = "misfit: the residuals scatter"  # the beginning of that sentence
COLUMNS = ("value", "std", "low_95", "high_95")  # figures of a parameter
HEADINGS = ("parameter", "value", "std", "95 % low", "95 % high", "unit")
UNFINISHED = (
    "the fit stopped at the limit of iterations before it converged: values that the measurements hardly determine may "
    "still move together, and their intervals hold only near where it stopped"
)
# of the drawing, by `refit` of validate: said wherever its error is, so that figures of commands can be compared
DRAWN = {
    "base": "after fitting where the arm stands",
    "offsets": "after fitting joint offsets and where the arm stands",
    "none": "as it stands",
}
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


def p_value_in_words(p: float) -> str:
    """`p = 0.012`; a p-value that underflows is not shown as zero."""
    return f"p = {p:.3g}" if p > 0.0 else "p < 1e-300"


def misfit_sentence(fit: Identification, p_value: float, times: float) -> str:
    """That chi2 rejects the model or the sigma given, and what follows; times : residuals in units of that sigma."""
    figures = f"chi2 {fit.chi2:.4g}, {fit.dof} degrees of freedom, {p_value_in_words(p_value)}"
    prior = "the prior does not hold (above), " if fit.contradictions else ""
    cause = f"{prior}the model is incomplete or sigma_mm too small"
    relied = fit.uncertainty.kind == "given"
    follows = "rely on sigma_mm and are too narrow" if relied else "do not rely on sigma_mm"
    do = "settle the prior first" if fit.contradictions else "armcal diagnose looks for what is missing"
    shown = f"{times:{'.3g' if times < 1000.0 else '.0f'}}"
    scatter = f"{MISFIT} {shown} times sigma_mm = {fit.sigma:.4g} ({figures})"
    return f"{scatter}: {cause}. The intervals {follows}; {do}"


def parameters_document(fit: Identification) -> Document:
    """All of it: the parameters, rounded by their standard deviations, and what else was found."""
    rows = [
        [name, *(to_significant_digits(row[key], row["std"]) for key in COLUMNS), row["unit"]]
        for name, row in zip(fit.shown_names, fit.rows(), strict=True)
    ]
    open_ones = [("not identifiable", combination) for combination in fit.not_identifiable]
    return Document("Identification", [], [Sheet(HEADINGS, rows), Facts([*open_ones, *facts(fit)])], (), fit.warnings)


def facts(fit: Identification) -> list[tuple[str, str | None]]:
    """What, and what is said of it: how the fit ended, errors before and after, what it promises, sigma, intervals."""
    origin = "given" if fit.sigma_known else "estimated"
    sigma = "unknown" if fit.sigma is None else f"{fit.sigma:.4g} mm per axis ({origin})"
    chi2 = None if fit.p_value is None else f"{fit.chi2:.4g}, {p_value_in_words(fit.p_value)}"
    doubt = "; but chi2 says that it is not" if fit.misfit else ""
    tip = None
    if fit.expected_tip is not None:
        measured = f"{fit.expected_tip_measured:.4g} mm at the tip at postures like those measured"
        tip = f"{measured}, {fit.expected_tip:.4g} mm over the joint limits (RMS), if the model is right{doubt}"
    angles = None if fit.rms_angles is None else "{:.4g} -> {:.4g} deg".format(*np.degrees(fit.rms_angles))
    return [
        ("method", f"{fit.method}: {fit.outcome}"),
        ("RMS", f"{fit.rms_before:.4g} -> {fit.rms_after:.4g} mm"),
        ("largest", f"{fit.max_before:.4g} -> {fit.max_after:.4g} mm"),
        ("orientations, RMS", angles),
        ("expected error", tip),
        ("sigma", f"{sigma}, {fit.dof} degrees of freedom"),
        ("chi2", chi2 and f"{chi2}: the residuals scatter {number(fit.scatter, 5)} mm"),
        ("95 % intervals", fit.uncertainty.sentence),
    ]


# -- armcal identify ---------------------------------------------------------------------------------------------------
def identification_document(
    result: Identification, data: Data, hidden: frozenset[str] = frozenset(), *, full: bool = True
) -> Document:
    """Everything about a fit: warnings, verdict, figures, the corrected values but for those `hidden`.

    data : what `armcal identify --json` says of it
    full : False: of a spatial arm its Denavit-Hartenberg table, or the values that the measurements determine
    """
    rows = [row for row in result.corrected_values if row.parameter not in hidden]
    # of the class of the others: estimation, where it is defined, imports this module
    dh = [type(result.corrected_values[0])(**row) for row in data.get("dh_table", ())]
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
    if servo := data.get("servo_error", ()):
        keys = ("offset", "reversal", "rms", "largest", "rest")
        cells = [[str(row["joint"]), *(f"{row[key]:z.5f}" for key in keys), row["unit"]] for row in servo]
        meaning = "read less commanded: offset + reversal s + rest, s = +1 or -1 the sign of the last motion"
        parts += [Sheet(("joint", *keys, "unit"), cells, "Servo error"), meaning]
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
    # without a place in the file, one has been fitted before: the RMS hardly falls
    if place and result.rms_before > (1.0 + 1e-3) * result.rms_after:
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


def drawing_in_words(rms: float, refit: str = "base") -> str:
    """What the drawing leaves [mm], and what was fitted of it;  refit : as for `validate`"""
    return f"{in_a_sentence(rms)} mm (drawing, {DRAWN[refit]})"
