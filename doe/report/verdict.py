"""What was found, in words for a person, and what to do next: from the JSON objects of the commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from doe.bounds.bound import postures_in_words
from doe.design import optimality_in_words
from doe.report.gap_tables import is_described
from doe.report.identification_tables import tip_in_words
from doe.report.page import Action
from doe.report.terminal import in_a_sentence, judged_by_mm
from identification.effects import library
from identification.gap.words import of_joints
from identification.validate import DRAWN

Data = Mapping[str, Any]
MOST = 4  # kinds of effects that a verdict spells out


def next_steps(actions: Sequence[Action]) -> list[str]:
    """The same for a terminal: a line each, the command on a line of its own."""
    return [f"next: {action.text}" + (f"\n      {action.command}" if action.command else "") for action in actions]


def effects_in_words(labels: Sequence[str]) -> str:
    """`encoder disc off centre, once per turn (encoder_eccentricity:1)`; the first few, one kind is said once."""
    kinds: dict[str, list[str]] = {}
    for label in labels:
        kinds.setdefault(label.partition("[")[0].partition(":")[0], []).append(label)
    said = [
        f"{library()[kind].summary} ({joints_listed(kind, these)})" if kind in library() else joints_listed(kind, these)
        for kind, these in kinds.items()
    ]
    return "; ".join(said[:MOST]) + (f"; and {len(said) - MOST} more" if len(said) > MOST else "")


def joints_listed(kind: str, labels: Sequence[str]) -> str:
    """`backlash:1, backlash:4`; of many joints `backlash of joints 1 to 5`."""
    joints = [label.removeprefix(f"{kind}:") for label in labels]
    if len(labels) > 2 and all(joint.isdigit() for joint in joints):
        return f"{kind} of {of_joints(sorted(map(int, joints)))}"
    return ", ".join(labels)


# -- armcal diagnose ---------------------------------------------------------------------------------------------------
def diagnosis_verdict(data: Data) -> list[str]:
    """What is missing in one short sentence, then with its details, and what it does to the error."""
    partly = "Not confirmed as predicted: rows that no fit has seen gain less."
    refuted = [partly if helps(data) else "Not confirmed on rows that no fit has seen."]
    compared = [] if (offered := data.get("offered")) is None or offered["better"] else [hardly_better(offered)]
    first = [*(refuted if data["confirmed"] is False else []), *compared]
    return [*first, missing(data), *details(data), gap_in_words(data)]


def hardly_better(offered: Data) -> str:
    """That a model predicts what it has not seen no better than the geometry alone, or only within chance."""
    sure = "no better" if offered["rms_mm"] >= offered["rms_geometry_mm"] else "no better beyond chance"
    own, geometry = (
        f"{in_a_sentence(offered[f'rms{of}_mm'])} mm RMS (largest {in_a_sentence(offered[f'max{of}_mm'])})"
        for of in ("", "_geometry")
    )
    return f"This model predicts {sure} than the geometry alone: {own} against {geometry} in rows that no fit has seen."


def missing(data: Data) -> str:
    """The verdict of `armcal diagnose`."""
    effects, sets = data["effects"], data["candidates"]
    which = effects_in_words(effects) if one_kind(effects) else f"{len(effects)} effects"
    return {
        "none": "Nothing is missing from the model that these data can show.",
        "named": f"Missing from the model: {which}.",
        "ambiguous": f"{len(sets)} explanations fit about equally well.",
        "unknown": f"Something that the library does not have is missing, at {place_in_words(data)}.",
    }[data["verdict"]]


def details(data: Data) -> list[str]:
    """What the verdict speaks of, by name."""
    effects = data["effects"]
    if data["verdict"] == "ambiguous":
        sets = [effects_in_words(c["effects"]) or "nothing" for c in data["candidates"]]
        return [f"{sentence_of('; or '.join(sets[:MOST]))}."]
    if data["verdict"] == "named" and not one_kind(effects):
        return [f"{sentence_of(effects_in_words(effects))}."]
    if data["verdict"] != "unknown":
        return []
    curves = sorted(curve["joint"] for curve in data["curves"])
    words = "An error curve of {} describes" if len(curves) == 1 else "Error curves of {} describe"
    described = [f"{words.format(of_joints(curves))} it; its cause is open."] if is_described(data) else []
    return [*described, *([f"Beside it: {effects_in_words(effects)}."] if effects else [])]


def one_kind(labels: Sequence[str]) -> bool:
    """Whether effects are of one kind, so that a sentence has room for them."""
    return len({label.partition("[")[0].partition(":")[0] for label in labels}) == 1


def sentence_of(text: str) -> str:
    """With a capital."""
    return f"{text[:1].upper()}{text[1:]}"


def helps(data: Data) -> bool:
    """Whether the error shrinks in rows that were held out, be it by less than predicted."""
    return bool((data["confirmation"] or {}).get("shrinks"))


def place_in_words(data: Data) -> str:
    """`joint 3`, `time`."""
    return str(data["where"] or "a place that is not known").replace(":", " ")


def gap_in_words(data: Data) -> str:
    """The error before and after, where it was held out if it was."""
    gap, test = data["gap"], data["confirmation"]
    if data["verdict"] == "none" and test is None:
        return f"The model leaves {in_a_sentence(gap['rms_after_mm'])} mm RMS of the data; no rows were held out."
    if test is None:
        figures = f"from {in_a_sentence(gap['rms_before_mm'])} to {in_a_sentence(gap['rms_after_mm'])} mm"
        return f"On the data, the geometry fitted, the RMS error goes {figures}; no rows were held out to confirm it."
    figures = f"from {in_a_sentence(test['before_mm'])} to {in_a_sentence(test['after_mm'])} mm"
    expected = f"{in_a_sentence(test['predicted_mm'])} mm were predicted"
    return f"On {test['rows']} rows that no fit has seen the RMS error goes {figures}; {expected}."


def diagnosis_actions(
    data: Data, arm: str = "arm.toml", rows: Sequence[str] = ("data.csv",), written: Path | None = None
) -> list[Action]:
    """What follows from a diagnosis of these files;  written : the extended model, where it has been."""
    called = " ".join(["armcal diagnose", arm, *rows])
    confirm = Action(
        "Measure some twenty other postures, best on another day, and let them confirm what was found:",
        f"{called} --holdout other.csv",
    )
    if data["confirmed"] is False:
        partly = "Do not put this into the controller yet: rows that no fit has seen gain less than predicted."
        wrong = "Do not put this into the controller: rows that no fit has seen speak against it."
        return [Action(partly if helps(data) else wrong), confirm]
    if data["verdict"] == "none":
        fit = f"armcal identify {arm} {rows[0]}" if len(rows) == 1 else called  # identify takes one file
        use = Action("Use the calibration of the geometry:", f"{fit} --out calibrated.toml")
        return [use, correct("calibrated.toml")]
    if data["verdict"] == "ambiguous":
        apart = " ".join(["armcal discriminate", arm, *rows, "--runs 6 --out next.csv"])
        again = Action("Add the new rows to the data, and diagnose again:", called)
        return [Action("Measure the postures that tell the explanations apart:", apart), again]
    if (offered := data.get("offered")) is not None and not offered["better"]:
        fit = f"armcal identify {arm} {rows[0]}" if len(rows) == 1 else called
        use = Action("Use the calibration of the geometry, which predicts as well:", f"{fit} --out calibrated.toml")
        return [use, correct("calibrated.toml"), confirm]
    keep = [] if written else [Action("Keep the extended model:", f"{called} --out extended.toml")]
    part = "the error curves, within the angles measured," if is_described(data) else "the named part"
    meanwhile = f"; {part} may be used meanwhile" if data["effects"] or is_described(data) else ""
    look = Action(f"Look for a cause at {place_in_words(data)}{meanwhile}.")
    unknown = [look] if data["verdict"] == "unknown" else []
    return [*unknown, *([] if data["confirmed"] else [confirm]), *keep, correct(str(written or "extended.toml"))]


def correct(arm: str) -> Action:
    """Commands from a calibrated arm."""
    return Action("Correct the robot's commands with it:", f"armcal compensate {arm} targets.csv --out commands.csv")


# -- the other commands ------------------------------------------------------------------------------------------------
def design_verdict(data: Data) -> str:
    """How good a plan is, by `armcal design` or `score`."""
    sure = optimality_in_words(data.get("optimality"), data.get("bound")) if data["certified_optimal"] else ""
    optimal = f", {sure}" if sure else ""
    if error := data.get("expected_error_mm"):
        runs = f"{data['runs']} runs (criterion {data['criterion']}{optimal})"
        return f"The plan of {runs} lets expect {expected_by_plan(data, error)}"
    known = "" if data["efficiency"] is None else f" has the efficiency {data['efficiency']:.4f}"
    return f"The plan of {data['runs']} runs{known or ' has no known bound'} ({data['criterion']}{optimal})."


def none_below(error: float, bound: Data | None) -> str:
    """`no plan from all postures is below 0.08 mm (a numerical bound)`;  bound : as in JSON, None: not in the file"""
    known = bound or {"source": "continuous"}
    kind = " (a numerical bound)" if not known.get("rigorous", False) else ""
    return f"no plan from {postures_in_words(known)} is below {in_a_sentence(error)} mm{kind}"


def expected_by_plan(data: Data, error: Data) -> str:
    """What a plan by criterion I promises in mm, and what its bound is worth."""
    promised = f"an error of {in_a_sentence(error['plan'])} mm at the tip, RMS over the workspace"
    if fit := data.get("fit"):
        promised += f", if fitted by armcal identify --{fit}"
    if error["bound"] is None or data["efficiency"] is None:
        return f"{promised}."
    least = f"; {none_below(error['bound'], data.get('bound'))}"
    return f"{promised}{least}. Efficiency {data['efficiency']:.4f}. {judged_by_mm(data['efficiency'])}"


def identification_verdict(data: Data) -> str:
    """Residuals of a calibration on the data that it was fitted to."""
    drawn = None if "only" in data else data.get("rms_drawing_mm")
    before = f"{in_a_sentence(data['rms_before_mm'])}" if drawn is None else drawing_in_words(drawn)
    figures = f"{before} to {in_a_sentence(data['rms_after_mm'])} mm"
    return f"On its own data the calibration takes the RMS error from {figures}.{expected_elsewhere(data)}"


def drawing_in_words(rms: float, refit: str = "base") -> str:
    """What the drawing leaves [mm], and what was fitted of it;  refit : as for `validate`"""
    return f"{in_a_sentence(rms)} mm (drawing, {DRAWN[refit]})"


def expected_elsewhere(data: Data) -> str:
    """What a fit promises where nothing was measured; files of earlier versions do not say."""
    if data.get("expected_tip_mm") is None or data.get("expected_tip_measured_mm") is None:
        return ""
    return f" Expected error if the model is right: {tip_in_words(data)}."


def validation_verdict(
    data: Data, model: str = "the model", rows: str = "other measurements", seen: bool = False
) -> str:
    """Residuals of a calibrated model on other measurements, compared with the drawing's."""
    which = ", which it was fitted to" if seen else ""
    figures = f"from {drawing_in_words(data['rms_nominal_mm'], data['refit'])} to {in_a_sentence(data['rms_mm'])} mm"
    most = f"95 % of the errors are below {in_a_sentence(data['p95_mm'])} mm"
    return f"On {data['rows']} rows of {rows}{which}, {model} takes the RMS error {figures}; {most}."


def validation_actions(better: bool, refit: str, model: str, rows: str, *, beyond: bool = False) -> list[Action]:
    """What to do with a model that predicts other measurements, or does not.

    beyond : most rows are at other angles than those of the identification
    """
    held = "armcal identify arm.toml data.csv --library-prior --out calibrated.toml"
    why = "Most rows are at angles that the calibration has not seen. What mostly reaches farther from its data:"
    far = [Action(why, held)] if beyond else []
    if better:
        return [*far, correct(model)]
    anew = Action("Find the zeros of the joints anew:", f"armcal identify {model} {rows} --only joint_offsets,base")
    if refit == "offsets":
        return [*far, anew]
    asked = f"armcal validate {model} {rows} --refit offsets"
    zeros = Action("Have the zeros of the joints moved? See what refitting them gains:", asked)
    return [*far, zeros, anew]


def identify_command(arm: str, rows: str, fit: str = "", out: str = "calibrated.toml") -> str:
    """The command that fits measurements;  fit : of `Plan`, without which it does not keep what the plan promises"""
    return f"armcal identify {arm} {rows}{f' --{fit}' if fit else ''} --out {out}"


def plan_actions(arm: str = "arm.toml", plan: str = "plan.csv", fit: str = "") -> list[Action]:
    """From a plan to a calibration;  fit : of the plan"""
    why = ", as the plan is meant: what it promises is of this fit" if fit else ""
    return [
        Action(f"Measure the postures of {plan}, and write the positions beside the angles (armcal help formats)."),
        Action("See whether the data are what they should be:", f"armcal check {arm} data.csv"),
        Action(f"Identify the arm{why}:", identify_command(arm, "data.csv", fit)),
    ]


def data_actions(arm: str = "arm.toml", rows: str = "data.csv", fit: str = "") -> list[Action]:
    """From measurements to a calibration;  fit : of the plan that they are of"""
    return [
        Action("Identify the arm:", identify_command(arm, rows, fit)),
        Action("Look for what the model lacks:", f"armcal diagnose {arm} {rows} --report gap.html"),
    ]


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
    if mounted_anew:
        why = "Give these reflectors another name in those sessions, in the column marker, and fit again:"
        return [Action(why, f"armcal identify {arm} {rows} --out {written or 'calibrated.toml'}")]
    names = {"arm": arm, "rows": rows, "calibrated": str(written or "calibrated.toml")}
    keep = [] if written else [Action("Keep the calibration: add --out calibrated.toml to this command.")]
    look, *use = calibrated_actions(**names)
    if allowed_for:
        if not better:
            why = "Leave --library-prior away, since the geometry alone predicts as well:"
            alone = Action(why, f"armcal identify {arm} {rows} --out calibrated.toml")
            keep, use = [alone], [correct("calibrated.toml")]
        why = "Effects that may be missing are allowed for, and none is named. To know which there are:"
        return [*keep, *use, Action(why, f"armcal diagnose {arm} {rows} --report gap.html")]
    return [*keep, *([] if diagnosed else [look]), *use]


def calibrated_actions(
    arm: str = "arm.toml", rows: str = "data.csv", calibrated: str = "calibrated.toml"
) -> list[Action]:
    """What a calibration is for, and what it needs before."""
    return [
        Action("Look for what the model lacks:", f"armcal diagnose {arm} {rows} --report gap.html"),
        Action("See whether it holds on another day:", f"armcal validate {calibrated} other.csv"),
        correct(calibrated),
    ]
