"""Fits and what is made with them as documents: figures, values for the controller, errors on other measurements,
commands; what to do next; and the library of effects."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from identification.document import (
    Action,
    Document,
    Part,
    Section,
    Sheet,
    count_of,
    estimate_text,
    in_a_sentence,
    number,
    unit_or_dash,
)
from identification.effects import example
from identification.kinematics.parameters import PRISMATIC
from identification.model.placed import placing
from identification.running import Status

if TYPE_CHECKING:
    from identification.estimation.result import CorrectedValue, Identification

Data = Mapping[str, Any]  # what a command says with --json

MISFIT = "misfit: the residuals scatter"  # the beginning of that sentence
MOST_HELD = 24  # parameters of effects that are listed without intervals; --library-prior has hundreds of them
ALONE = "no-library-prior"  # option of `identify`: the geometry without what else may be missing
COLUMNS = ("value", "std", "low_95", "high_95")  # figures of a parameter
UNFINISHED = (
    "the fit reached the iteration limit before it converged: values that the measurements hardly determine may still "
    "change together, and their intervals are valid only near the point where it stopped"
)
# of the drawing, by `refit` of validate: said wherever its error is, so that figures of commands can be compared
DRAWN = {
    "base": "placed as well as it can be",
    "offsets": "joint offsets fitted, and placed as well as it can be",
    "none": "as it stands",
}
BETA = (
    "beta: rotation about the new y axis after alpha, where the next axis is nearly parallel (Hayati). A controller "
    "without beta cannot take that row; --urdf writes frames of six numbers."
)
AMONG = "among those that the model was identified from"  # some rows
FITTED = "the model was identified from these measurements: this says nothing about others"
MOVED = "measured points moved between sessions"
BY_CHANCE = "may be chance"  # said of a gain within what the rows scatter by
BEYOND = "more than the file promises"  # of what is left
ZEROS = "with the joint offsets refitted, too"  # less is left
KINDS_OF_EFFECTS = {
    "looked for": "Effects that diagnose looks for",
    "table": "Found by diagnose where no name fits",
    "scatter": "Effects on the scatter: simulated, screened for, not estimated",
    "alias": "Cannot be distinguished from the geometry: listed, never named",
    "on request": "Estimated where the arm file asks for it",
    "commands": "Found from commands that are recorded beside the readings",
    "sessions": "Added by armcal where there are several sessions",
}


# -- a fit -------------------------------------------------------------------------------------------------------------
def p_value_in_words(p: float) -> str:
    """`p = 0.012`; a p-value that underflows is not shown as zero."""
    return f"p = {p:.3g}" if p > 0.0 else "p < 1e-300"


def reading_unit(arm: Any) -> str:
    """Unit of the errors of an arm, None: of no arm: that of what its instrument reads."""
    return "px" if arm is not None and any(c.quantity == "pixel" for c in arm.chain.instrument.coordinates) else "mm"


def unit_key(arm: Any) -> dict[str, str]:
    """`reading_unit` of JSON, where it is not mm."""
    return {} if (unit := reading_unit(arm)) == "mm" else {"reading_unit": unit}


def fit_facts(fit: Identification) -> dict[str, str | None]:
    """What, and what is said of it: how the fit ended, the largest error left, what it promises, sigma, intervals."""
    closed, unit = fit.method == "linear" and fit.status is Status.converged, reading_unit(fit.arm)
    tip, chi2, angles, sigma = None, None, None, "unknown"
    if fit.expected_tip is not None:
        by_repeats = any(each.startswith(MISFIT) for each in fit.doubts)  # more than they scatter by
        witness = "chi2 says" if fit.misfit else "repeats say" if by_repeats else ""
        doubt = f"; but {witness} that it is not" if witness else ""
        measured = f"{fit.expected_tip_measured:.4g} mm at the tip at postures like those measured"
        tip = f"{measured}, {fit.expected_tip:.4g} mm over the joint limits (RMS), if the model is right{doubt}"
    if fit.sigma is not None:
        sigma = f"{fit.sigma:.4g} {unit} per coordinate ({'given' if fit.sigma_known else 'estimated'})"
    if fit.p_value is not None and (times := fit.times_sigma) is not None:
        chi2 = f"{fit.chi2:.4g}, {p_value_in_words(fit.p_value)}: the residuals scatter {times:.3g} times sigma_mm"
    if fit.rms_angles is not None:
        angles = "from {:.4g} to {:.4g} deg".format(*np.degrees(fit.rms_angles))
    return {
        "method": f"{fit.method}: {'Closed form, the exact global minimum.' if closed else fit.status.value}",
        "largest residual": f"{fit.largest[1]:.4g} {unit}",
        "orientations, RMS": angles,
        "expected error": tip,
        "sigma": f"{sigma}, {fit.dof} degrees of freedom",
        "chi2": chi2,
        "95 % intervals": fit.uncertainty.sentence,
    }


def identification_document(fit: Identification, data: Data | None = None, hidden: Collection[str] = ()) -> Document:
    """Everything about a fit: warnings, verdict, figures, the Denavit-Hartenberg table where the arm file has one, else
    the corrected values but for those `hidden`; the parameters of a model that is no arm's;  data : what `armcal
    identify --json` says of it, None: what it says itself"""
    data = fit.to_json() if data is None else data
    values = [row for row in fit.corrected_values if row.parameter not in hidden]
    tables: list[Part] = [*dh_sections(*fit.dh[:2])]
    of_effects = {p.name for p in fit.model.parameters if p.of_effect}
    if tables and (beside := [row for row in values if row.parameter in of_effects]):
        tables.append(corrected_section("Effects, which only armcal compensate corrects", beside))
    if values and not tables:
        tables = [corrected_section("Corrected values", values)]
        slides = fit.arm is not None and fit.arm.chain.rows and PRISMATIC in fit.arm.joint_types
        tables += ["There is no corrected [[dh]] table for an arm with prismatic joints."] if slides else []
    if fit.arm is None:
        rows = (
            [row["name"], *(estimate_text(row[key], row["std"], row["unit"]) for key in COLUMNS), row["unit"]]
            for row in fit.rows()
        )
        tables = [Sheet(("parameter", "value", "std", "95 % low", "95 % high", "unit"), [*rows])]
    facts = fit_facts(fit)
    if "only" in data and (drawn := data.get("rms_drawing_mm")) is not None:
        facts["drawing"] = f"{number(drawn)} {reading_unit(fit.arm)} RMS, {DRAWN['base']}"
    parts: list[Part] = [Sheet.facts(facts), *tables]
    if fit.not_identifiable:
        parts.append("These are not estimable separately from this plan; measure other postures or fix one of each:")
        parts += [f"  {combination}" for combination in fit.not_identifiable]
    if servo := data.get("servo_error", ()):
        keys = ("offset", "reversal", "rms", "largest", "rest")
        cells = [[str(row["joint"]), *(f"{row[key]:z.5f}" for key in keys), row["unit"]] for row in servo]
        meaning = "read minus commanded, as the drawing counts: offset + reversal s + rest, s: sign of the last motion"
        parts += [Sheet(("joint", *keys, "unit"), cells, "Servo error"), meaning]
    # whose the errors before the fit are; without a place in the file, one has been fitted before
    places = placing(fit.model.parameters)
    placed = 0 < len(places) < len(fit.names) or fit.rms_before <= (1.0 + 1e-3) * fit.rms_after
    file = "arm file" if fit.arm is None or fit.arm.calibration is not None else "drawing"
    before = f"{file}, {DRAWN['base' if places and placed else 'none']}"
    verdict = [*hardly_better(data), identification_verdict({**data, **unit_key(fit.arm)}, before)]
    return Document("Identification", verdict, parts, warnings=fit.warnings)


def identification_verdict(data: Data, before: str = "") -> str:
    """What a fit does to the error on its own data, and what it leaves of postures left out of it;  before : whose the
    error before is, where not the drawing's"""
    drawn, unit = None if "only" in data else data.get("rms_drawing_mm"), data.get("reading_unit", "mm")
    was = f"{in_a_sentence(data['rms_before_mm'])}{before and f' {unit} ({before})'}"
    was = was if drawn is None else drawing_in_words(drawn, unit=unit)
    # many parameters, held by a prior or not, come as near to the rows they are fitted to as one likes
    left = data.get("cross_validated_mm")
    others = f"; for postures left out of the fit it is {in_a_sentence(left)} {unit} (noise included)"
    now = f"{in_a_sentence(data['rms_after_mm'])} {unit}{'' if left is None else others}"
    return f"On its own data the calibration takes the RMS error from {was} to {now}."


def hardly_better(data: Data) -> list[str]:
    """That the model predicts what it has not seen no better than the geometry alone, or only within chance; nothing
    where it is better, or nobody has tried."""
    if (offered := data.get("offered")) is None or offered["better"]:
        return []
    worse = offered["rms_mm"] >= offered["rms_geometry_mm"]
    predicts = "predicts no better" if worse else "does not predict significantly better"
    model, geometry = (
        f"{in_a_sentence(offered[f'rms{of}_mm'])} mm RMS (largest {in_a_sentence(offered[f'max{of}_mm'])})"
        for of in ("", "_geometry")
    )
    seen = f"on rows left out of the fit{', each with the base refitted' * offered['refitted']}"
    return [f"This model {predicts} than the geometry alone: {model} against {geometry} {seen}."]


def drawing_in_words(rms: float, refit: str = "base", unit: str = "mm") -> str:
    """What the drawing leaves, and what was fitted of it;  refit : as for `validate`"""
    return f"{in_a_sentence(rms)} {unit} (drawing, {DRAWN[refit]})"


def extrapolated(out: NDArray[np.bool_] | None, what: str) -> str | None:
    """How many rows are outside the angles of the identification, in a clause; None: none, or not known;  out : (m, n)
    of `Arm.outside`;  what : the rows are"""
    if out is None or not out.any():
        return None
    joints = ", ".join(f"joint {j + 1} in {int(out[:, j].sum())}" for j in np.flatnonzero(out.any(axis=0)))
    count = f"{int(out.any(axis=1).sum())} of {len(out)} {what} are outside the angles that the model was identified on"
    return f"{count} ({joints}): there it extrapolates"


# -- corrected values --------------------------------------------------------------------------------------------------
def corrected_section(title: str, rows: Sequence[CorrectedValue], folded: bool = False) -> Section:
    """The corrected values to enter in the controller, and what they mean to it: which are added to zeros, which belong
    together, and which the measurements do not determine."""
    listed = [row for row in rows if row.std is not None or row.parameter is None or "." not in row.name]
    held = len(rows) - len(listed)
    rows = listed if held > MOST_HELD else rows
    weak, zeros = sum(row.weak for row in rows), any(row.name.startswith("zero of") for row in rows)
    frames = [row for row in rows if row.name.startswith("joint ")]
    framed, turned = bool(frames), any(row.name.endswith((" rx", " ry", " rz")) for row in frames)
    upright = any(row.name == "base ry" and abs(row.corrected or 0.0) > 85.0 for row in rows)
    notes = {
        f"{held} more parameters of effects, without intervals, are in the file.": held > MOST_HELD,
        "Zeros: add to the zero of the joint (real = reading + this), or subtract it from every command.": zeros,
        "Zero of joint 1 and base_offset: the base pose; enter them in the controller only if the measurements are "
        "in the controller's own frame.": any(row.parameter == "base_offset.x0" for row in rows),
        "Frames: origin of the joint in the frame of the joint before, as in a URDF file; --urdf writes it.": framed,
        "rx, ry, rz of a joint whose pitch is near 90 deg: rotation of its frame from the drawing about its own "
        "axes.": turned,
        "ry of the base is near 90 deg: its rx and rz are only known together, whatever the interval of each.": upright,
        "These values belong together: enter all of them.": framed,
        # not all that can be off is estimated
        "Numbers not listed stay as drawn; the intervals are for a fit that holds them there.": framed
        and all(row.prior_std is None for row in rows),
        f"* {weak} of {len(rows)} are weakly determined: the measurements leave more than half of their prior "
        "standard deviation, and the prior holds them.": weak > 0,
    }
    return Section(title, [corrected_table(rows), *(note for note, holds in notes.items() if holds)], folded)


def corrected_table(rows: Sequence[CorrectedValue]) -> Sheet:
    """Nominal and corrected values with intervals, without those that are the drawing's to 0.0001 mm or deg. Frames are
    better known together than each number is: they have five decimals, whatever the deviation of each."""
    keys, cells = ("nominal", "corrected", "std", "low_95", "high_95"), []
    together = any(row.name.startswith(("joint ", "row ")) for row in rows)
    for row in rows:
        name, std, unit = f"{row.name} *" if row.weak else row.name, row.std, row.unit
        limits = () if row.corrected is not None and std is None else (row.low_95, row.high_95)  # of a held value none
        same = {number(value, 4) for value in (row.nominal, row.corrected, *limits)}
        if unit not in ("mm", "deg") or len(same) > 1 or row.nominal is None:
            texts = [estimate_text(getattr(row, key), std, unit) for key in keys]
            texts[1] = number(row.corrected, 5) if together and unit in ("mm", "deg") else texts[1]
            cells.append([name, *texts, unit_or_dash(unit)])
    return Sheet(("", "nominal", "corrected", "std", "low 95 %", "high 95 %", "unit"), cells)


def dh_sections(rows: Sequence[CorrectedValue], lines: Sequence[str], name: str = "") -> list[Section]:
    """The corrected Denavit-Hartenberg table, what belongs to it and how it is to be used; none without rows."""
    together = "All values belong together, base and tool included: enter all."
    notes = [f"Other numbers of the table stay as drawn. {together}"]
    notes += [BETA] if any(row.name.endswith(" beta") for row in rows) else []
    title = f"Corrected Denavit-Hartenberg table{name and f': {name}'}"
    return [Section(title, [corrected_table(rows), *lines, *notes])] if rows else []


# -- what to do next ---------------------------------------------------------------------------------------------------
def correct(arm: str) -> Action:
    """Commands from a calibrated arm."""
    return Action("Correct the robot's commands with it:", f"armcal compensate {arm} targets.csv --out commands.csv")


def identify_command(arm: str, rows: str, fit: str = "") -> str:
    """The command that fits measurements;  fit : of `Plan`, without which it does not keep what the plan promises, or
    `ALONE`, since without an option the fit is the one that the measurements ask for"""
    return f"armcal identify {arm} {rows}{f' --{fit}' if fit else ''} --out calibrated.toml"


def identification_actions(data: Data, arm: str, rows: str, written: Path | None, *, diagnosed: bool) -> list[Action]:
    """What follows from an identification, by its JSON;  written : the calibrated arm, where it has been;
    diagnosed : its effects have been looked for"""
    keep = [] if written else [Action("Keep the calibration: add --out calibrated.toml to this command.")]
    look, *use = calibrated_actions(arm, rows, str(written or "calibrated.toml"))
    if "prior" not in data:
        return [*keep, *([] if diagnosed else [look]), *use]
    offered = data.get("offered", {"better": True})
    if not offered["better"] and offered["rms_mm"] < offered["rms_geometry_mm"]:
        unsure = "These rows are too few to tell whether --library-prior helps. Fit without it, to compare on others:"
        keep.append(Action(unsure, f"armcal identify {arm} {rows} --{ALONE} --out geometry.toml"))
    elif not offered["better"]:
        alone = "Leave out --library-prior, since the geometry alone predicts no worse:"
        keep, use = [Action(alone, identify_command(arm, rows, ALONE))], [correct("calibrated.toml")]
    why = "Missing effects are allowed for, but none is named. To find out which are present:"
    return [*keep, *use, Action(why, look.command)]


def calibrated_actions(arm: str, rows: str, calibrated: str) -> list[Action]:
    """What a calibration is for, and what it needs before."""
    return [
        Action("Look for what the model lacks:", f"armcal diagnose {arm} {rows} --report gap.html"),
        Action("See whether it holds on another day:", f"armcal validate {calibrated} other.csv"),
        correct(calibrated),
    ]


def validation_actions(data: Data, model: str, rows: str) -> list[Action]:
    """What to do with a model that predicts other measurements, or does not, by the JSON of `validate`."""
    which = f"joint_offsets,base{',tool' * ('measured points' in refitted_in_words(data))}"
    zeros = Action("Find the zeros of the joints again:", f"armcal identify {model} {rows} --only {which}")
    if noted(data, ZEROS):  # which no file has
        return [zeros]
    if is_better(data):
        return [*(calibrated_actions(model, rows, model)[:1] if noted(data, BEYOND) else []), correct(model)]
    if data["refit"] == "none":
        return [Action("See whether only the base pose has changed:", f"armcal validate {model} {rows}")]
    asked = f"armcal validate {model} {rows} --refit offsets"
    moved = Action("See whether the zeros of the joints have moved, and what refitting them gains:", asked)
    return [*([] if data["refit"] == "offsets" else [moved]), zeros]


# -- armcal validate ---------------------------------------------------------------------------------------------------
def validation_verdict(data: Data, model: str = "the model", rows: str = "") -> str:
    """What a calibrated model does to the error on other measurements, compared with the drawing, and whether that is
    better;  model, rows : names of files"""
    seen, unit, drawn = FITTED in data["notes"], data.get("reading_unit", "mm"), data["rms_nominal_mm"]
    which = f"{rows}, which it was fitted to," if seen else f"{rows},"
    others = "measurements that are in part the model's own," if noted(data, AMONG) else "other measurements,"
    which = which if rows else "the model's own measurements," if seen else others
    figures = f"from {drawing_in_words(drawn, data['refit_nominal'], unit)} to {in_a_sentence(data['rms_mm'])} {unit}"
    gain = 1.0 - data["rms_mm"] / drawn if drawn else 0.0
    share = f"{100.0 * gain:.{1 if gain >= 0.995 else 0}f}" if gain < 0.9995 else "more than 99.9"
    chance = "" if is_better(data) else f", which {BY_CHANCE}"
    worth = f"{share} % of the error is removed{chance}" if gain > 0.0 else "no better than the drawing"
    worth += f", and what is left is {BEYOND}" * (data["refit"] == "base" and noted(data, BEYOND))
    worth = "this says nothing about others" if seen else worth
    most = f"95 % of the errors are below {in_a_sentence(data['p95_mm'])} {unit}"
    return f"On {count_of(data['rows'], 'row')} of {which} {model} takes the RMS error {figures}: {worth}; {most}."


def is_better(data: Data) -> bool:
    """Whether the model is better than the drawing, by more than the rows scatter."""
    return data["rms_mm"] < data["rms_nominal_mm"] and not noted(data, BY_CHANCE)


def noted(data: Data, words: str) -> bool:
    """Whether a note of `validate` has these words."""
    return any(words in note for note in data["notes"])


def refitted_in_words(data: Data) -> str:
    """`position and rotation of the base, measured points`: what of a model was fitted to the rows; or empty."""
    names = {str(one["name"]) for one in data["refitted"]}
    kinds = {re.split(r"[.:[]", name)[0] for name in names}
    turned = any(name.startswith("base.r") for name in names) or (data["refit"] == "base" and "joint_offset:1" in names)
    words = ["joint offsets"] if data["refit"] == "offsets" else []
    words += [f"position{' and rotation' * turned} of the base"] if kinds & {"base", "base_offset"} else []
    words += ["measured points"] if "tool" in kinds else []
    return ", ".join(words + [f"{kind}s" for kind in sorted(kinds - {"base", "base_offset", "joint_offset", "tool"})])


def validation_sections(data: Data) -> list[Section]:
    """Drawing and model over all rows, and block by block."""
    keys, sessions = ("rms", "mean", "p95", "max"), {one["session"] for one in data["refitted"]}
    unit, summary = data.get("reading_unit", "mm"), f"{count_of(data['rows'], 'row')}, nothing refitted"
    if what := refitted_in_words(data):
        each = f" in each of {len(sessions)} sessions" if len(sessions) > 1 else ""
        summary = f"{count_of(data['rows'], 'row')}, refitted{each}: {what}; everything else as in the file"
    figures = ("RMS", "mean", "95 %\nbelow", "largest")
    rows = [["drawing", *(number(data[f"{key}_nominal_mm"]) for key in keys)]]
    rows.append(["model", *(number(data[f"{key}_mm"]) for key in keys)])
    blocks = [
        [b["kind"], b["name"], str(b["rows"]), number(b["rms_nominal_mm"]), *(number(b[f"{key}_mm"]) for key in keys)]
        for b in data["blocks"]
    ]
    by_block = Sheet(("block", "which", "rows", "RMS\ndrawing", *figures), blocks)
    shown = [Section(f"Validation, distances in {unit}", [Sheet(("", *figures), rows), summary])]
    return [*shown, *([Section(f"Validation, block by block, in {unit}", [by_block])] if blocks else [])]


# -- armcal effects ----------------------------------------------------------------------------------------------------
def library_document(entries: Sequence[dict[str, Any]]) -> Document:
    """Name, cause and needs of every effect, by kind."""
    rows: dict[str, list[list[str]]] = {kind: [] for kind in KINDS_OF_EFFECTS}
    for e in entries:
        name = e["name"] + ":j" * e["place"].startswith("each") + f" ({e['arms'][0]})" * (len(e["arms"]) == 1)
        rows[e["kind"]].append([name, e["summary"], ", ".join(e["needs"])])
    tables = [Sheet(("name", "what is wrong", "needs"), rows[kind], title) for kind, title in KINDS_OF_EFFECTS.items()]
    advice = "A name with :j belongs to joint j. For details of an effect: armcal effects backlash"
    return Document("Effects", [], [*tables, advice])


def entry_document(entry: dict[str, Any]) -> Document:
    """Everything about one effect."""
    about = {
        "cause": entry["summary"],
        "model": entry["formula"],
        "belongs to": entry["place"],
        "arms": " and ".join(entry["arms"]),
        "needs": "; ".join(entry["supply"]) or "only postures and positions",
        "looks like": entry["alias"],
    }
    sizes = ["-" if p["typical"] is None else f"{p['typical']:.2g}" for p in entry["parameters"]]
    rows = [[p["key"], unit_or_dash(p["unit"]), size] for p, size in zip(entry["parameters"], sizes, strict=True)]
    title = "Parameters" + " (of an arm of three joints)" * (entry["place"] == "one joint or all")
    settings = Sheet(("key", "allowed"), [*entry["settings"].items()], "Settings: chosen, not estimated")
    intro = "In an arm file, with its parameters left out so that identify estimates them:"
    how = example(entry) if entry["kind"] == "table" else f"{intro}\n\n{example(entry)}\n"
    values = Sheet(("key", "unit", "typical size"), rows, title)
    return Document(entry["name"], [entry["name"]], [Sheet.facts(about), values, settings, how])
