"""A diagnosis in words: its verdict, and a document of it, by the JSON object of `armcal diagnose`; with the diagnosis
itself with pictures and corrected values too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.document import (
    Action,
    Document,
    Part,
    Pictures,
    Section,
    Sheet,
    as_sentence,
    estimate_text,
    in_a_sentence,
    number,
    of_joints,
    unit_or_dash,
)
from identification.documents.identification import DRAWN, correct, corrected_section, hardly_better, identify_command
from identification.effects import library
from identification.estimation.result import corrected_values

if TYPE_CHECKING:
    from identification.gap.detectability import Detectability
    from identification.gap.result import Diagnosis

Data = Mapping[str, Any]  # what `armcal diagnose --json` says
MOST = 4  # kinds of effects that a verdict spells out


# -- the verdict -------------------------------------------------------------------------------------------------------
def diagnosis_verdict(data: Data) -> list[str]:
    """What is missing in one short sentence, then with its details: in doubt that first, and whether the model is no
    better than the geometry alone."""
    effects, sets, verdict, kinds = data["effects"], data["candidates"], data["verdict"], kinds_of(data["effects"])
    lines = []
    if data["confirmed"] is False:
        partly = "Not confirmed as predicted: rows that no fit has seen gain less."
        lines.append(partly if shrinks(data) else "Not confirmed on rows that no fit has seen.")
    if (offered := data.get("offered")) is not None and not offered["better"]:
        lines.append(hardly_better(offered))
    if verdict == "none":
        lines.append("Nothing is missing from the model that these data can show.")
    elif verdict == "named":
        which = effects_in_words(effects) if len(kinds) == 1 else f"{len(effects)} effects"
        lines.append(f"Missing from the model: {which}.")
        lines += [as_sentence(effects_in_words(effects))] if len(kinds) > 1 else []
    elif verdict == "ambiguous" and len(sets) == 1:
        lines.append(f"Likeliest, but less likely than not: {effects_in_words(effects)}.")
    elif verdict == "ambiguous":
        lines.append(f"{len(sets)} explanations fit about equally well.")
        lines.append(as_sentence("; or ".join([effects_in_words(c["effects"]) or "nothing" for c in sets][:MOST])))
    else:
        lines.append(f"Something that the library does not have is missing, at {place_in_words(data)}.")
        if is_described(data):
            curves = sorted(curve["joint"] for curve in data["curves"])
            words = "An error curve of {} describes" if len(curves) == 1 else "Error curves of {} describe"
            lines.append(f"{words.format(of_joints(curves))} it; its cause is open.")
        lines += [f"Beside it: {effects_in_words(effects)}."] if effects else []
    return lines


def findings(data: Data) -> list[str]:
    """What belongs to the verdict, in sentences: a shape, scatter that is not explained, sessions."""
    lines = [f"Its shape: {data['shape']}."] if data["shape"] and not is_described(data) else []
    if (misfit := data["misfit"]) and misfit["significant"]:
        lines.append(f"Scatter {misfit['ratio']:.3g} x sigma_mm, not explained.")
    for answer, says in ((True, "Replicates"), (False, "Does not replicate")):
        if effects := [one["effect"] for one in data["replication"] if one["replicates"] is answer]:
            lines.append(f"{says} across sessions: {' + '.join(effects)}.")
    return lines


def likely(data: Data) -> str:
    """The probabilities in one line, with those of other sets, and whether the rows are too few for a test."""
    tests = tests_of(data)
    few = data["effects"] and tests and all(test["confirmed"] is None for test in tests)
    among = " (too few rows to confirm it on others)" if few else ""
    every = ", ".join(f"{name} {p:.2f}" for name, p in data["probabilities"].items() if p >= 0.005)
    other = ", ".join(f"{' + '.join(one['effects'])} {one['probability']:.2f}" for one in data["other_sets"])
    return f"probability{among}: {every}{f' (of that {other})' if other else ''}"


def gap_in_words(data: Data) -> str:
    """The error before and after, where it was held out if it was."""
    gap, test, unit = data["gap"], data["confirmation"], data.get("reading_unit", "mm")
    if data["verdict"] == "none" and test is None:
        return f"The model leaves {in_a_sentence(gap['rms_after_mm'])} {unit} RMS of the data; no rows were held out."
    if test is None:
        figures = f"from {in_a_sentence(gap['rms_before_mm'])} to {in_a_sentence(gap['rms_after_mm'])} {unit}"
        return f"On the data, the geometry fitted, the RMS error goes {figures}; no rows were held out to confirm it."
    figures = f"from {in_a_sentence(test['before_mm'])} to {in_a_sentence(test['after_mm'])} {unit}"
    expected = f"{in_a_sentence(test['predicted_mm'])} {unit} were predicted"
    return f"On {test['rows']} rows that no fit has seen the RMS error goes {figures}; {expected}."


def kinds_of(labels: Sequence[str]) -> dict[str, list[str]]:
    """Kind of effect -> its labels."""
    kinds: dict[str, list[str]] = {}
    for label in labels:
        kinds.setdefault(label.partition("[")[0].partition(":")[0], []).append(label)
    return kinds


def effects_in_words(labels: Sequence[str]) -> str:
    """`encoder disc off centre, once per turn (encoder_eccentricity:1)`; the first few, one kind is said once; of many
    joints `backlash of joints 1 to 5`."""
    phrases = []
    for kind, these in kinds_of(labels).items():
        joints = [label.removeprefix(f"{kind}:") for label in these]
        many = len(these) > 2 and all(joint.isdigit() for joint in joints)
        listed = f"{kind} of {of_joints(sorted(map(int, joints)))}" if many else ", ".join(these)
        phrases.append(f"{library()[kind].summary} ({listed})" if kind in library() else listed)
    return "; ".join(phrases[:MOST]) + (f"; and {len(phrases) - MOST} more" if len(phrases) > MOST else "")


def shrinks(data: Data) -> bool:
    """Whether the error shrinks in rows that were held out, be it by less than predicted."""
    return bool((data["confirmation"] or {}).get("shrinks"))


def is_described(data: Data) -> bool:
    """Whether error curves stand for what is unknown: the fitted set is no name for it, and has no probability."""
    return (data["where"], data["shape"]) in {(f"joint:{c['joint']}", c["shape"]) for c in data["curves"]}


def place_in_words(data: Data) -> str:
    """`joint 3`, `time`."""
    return str(data["where"] or "a place that is not known").replace(":", " ")


def tests_of(data: Data) -> list[Data]:
    """What rows that were not used for the fits say: the hold-out, and cross-validation."""
    return ([data["confirmation"]] if data["confirmation"] else []) + list(data["cross_validation"])


# -- what to do next ---------------------------------------------------------------------------------------------------
def diagnosis_actions(
    data: Data, arm: str = "arm.toml", rows: Sequence[str] = ("data.csv",), written: Path | None = None
) -> list[Action]:
    """What follows from a diagnosis of these files;  written : the extended model, where it has been."""
    called = " ".join(["armcal diagnose", arm, *rows])
    alone = identify_command(arm, rows[0]) if len(rows) == 1 else f"{called} --out calibrated.toml"  # takes one file
    use = "Use the calibration of the geometry"
    confirm = Action(
        "Measure some twenty other postures, best on another day, and let them confirm what was found:",
        f"{called} --holdout other.csv",
    )
    if data["confirmed"] is False:
        why = " yet: rows that no fit has seen gain less than predicted"
        why = why if shrinks(data) else ": rows that no fit has seen speak against it"
        return [Action(f"Do not put this into the controller{why}."), confirm]
    if data["verdict"] == "none":
        return [Action(f"{use}:", alone), correct("calibrated.toml")]
    if data["verdict"] == "ambiguous":
        apart = " ".join(["armcal discriminate", arm, *rows, "--runs 6 --out next.csv"])
        again = Action("Add the new rows to the data, and diagnose again:", called)
        return [Action("Measure the postures that tell the explanations apart:", apart), again]
    if (offered := data.get("offered")) is not None and not offered["better"]:
        return [Action(f"{use}, which predicts as well:", alone), correct("calibrated.toml"), confirm]
    keep = [] if written else [Action("Keep the extended model:", f"{called} --out extended.toml")]
    part = "the error curves, within the angles measured," if is_described(data) else "the named part"
    meanwhile = f"; {part} may be used meanwhile" if data["effects"] or is_described(data) else ""
    look = Action(f"Look for a cause at {place_in_words(data)}{meanwhile}.")
    unknown = [look] if data["verdict"] == "unknown" else []
    return [*unknown, *([] if data["confirmed"] else [confirm]), *keep, correct(str(written or "extended.toml"))]


# -- the document ------------------------------------------------------------------------------------------------------
def diagnosis_document(
    data: Data,
    diagnosis: Diagnosis | None = None,
    files: Sequence[str] = ("arm.toml", "data.csv"),
    written: Path | None = None,
    nominal: float | None = None,
) -> Document:
    """All of a diagnosis.

    files : arm and measurements, for the commands of the next steps;  written : the extended model, where it has been
    nominal : RMS distance of the drawing [mm]
    """
    # what is named, how likely it is, and its values; what is named beside an unknown effect
    explanations = (list(data["candidates"]) or [data["named"]]) if data["effects"] else []
    several, figures, estimates = len(data["candidates"]) > 1, [], list[Part]()
    for c in explanations:
        chance = "its cause is unknown" if is_described(data) else probability_text(c["probability"])
        figures.append([" +\n".join(c["effects"]), chance, *(f"{c[key]:.1f}" for key in ("delta_bic", "f"))])
        labels = {key: label for label in c["effects"] for key in (label.partition("[")[0], label)}  # with settings
        rows = []
        for row in c["parameters"]:
            owner, _, short = row["name"].rpartition(".")
            limits = (estimate_text(row[key], row["std"], row["unit"]) for key in ("value", "low_95", "high_95"))
            rows.append([f"{labels.get(owner, owner)}.{short}", *limits, unit_or_dash(row["unit"])])
        title = f"Estimates: {' + '.join(c['effects'])}" if several else "Estimates"
        estimates.append(Sheet(("parameter", "value", "low 95 %", "high 95 %", "unit"), rows, title))
    named: list[Part] = [*findings(data), as_sentence(likely(data))]
    named += ["Every explanation with at least a twentieth of the best one's probability:"] if several else []
    named += [Sheet(("effects", "probability", "-2 log odds", "F"), figures), *estimates]
    named += [f"95 % intervals: {diagnosis.named.reliance}."] if diagnosis is not None and explanations else []
    parts: list[Part] = [Section("What is missing", named)]
    if data["replication"]:
        parts.append(replication_section(data["replication"]))
    parts.append(gap_section(data, diagnosis, nominal))
    if diagnosis is not None:
        arm = diagnosis.extended_arm(diagnosis.named)
        values, doubted = corrected_values(arm, diagnosis.named.calibration), data["confirmed"] is False
        title = "Corrected values, not confirmed" if doubted else "Corrected values"
        parts.append(corrected_section(title, values, folded=doubted))
        parts.append(Section("Signed error against each joint", pictures_of(diagnosis, "signed_of")))
    parts += curve_sections(data, diagnosis)
    if diagnosis is not None:
        how = "Distances, without their sign: rows as points, RMS in groups of rows as lines."
        parts.append(Section("Against time and torque", [how, *pictures_of(diagnosis, "against_figure")], folded=True))
    parts += further_sections(data)
    title = f"Gap report: {(diagnosis.arm.name if diagnosis else '') or 'arm'}"
    actions = diagnosis_actions(data, files[0], files[1:], written)
    return Document(title, [*diagnosis_verdict(data), gap_in_words(data)], parts, actions, data["warnings"])


def pictures_of(diagnosis: Diagnosis | None, name: str) -> list[Part]:
    """A picture of documents/pictures.py, or several, of a diagnosis, drawn where they are seen: matplotlib takes
    longer to load than a small diagnosis."""

    def draw() -> Sequence[Any]:
        drawn = getattr(import_module("identification.documents.pictures"), name)(diagnosis)
        return drawn if isinstance(drawn, Sequence) else [drawn]

    return [] if diagnosis is None else [Pictures(draw)]


def probability_text(p: float | None) -> str:
    """`0.93`; a small probability is never rounded to zero."""
    return "< 0.01" if p is not None and 0.0 < p < 0.005 else number(p, 2)


def replication_section(effects: Sequence[Data]) -> Section:
    """Each named effect in each session, where there are several."""
    lead = (
        "Every session has a base of its own, everything else is shared. Fitted there: the effect's values from this "
        "session alone. P(the same): how likely it is that they are those of the other sessions. An effect replicates "
        "where that is 0.9 or more."
    )
    rows = []
    for effect, session in ((one, session) for one in effects for session in one["sessions"]):
        values = [
            f"{p['name'].rpartition('.')[2]} = {p['value']:.3g} +- {p['std']:.1g} {p['unit']}"
            for p in session["parameters"]
        ]
        answer = {True: "yes", False: "no", None: "open"}[session["replicates"]]
        fitted = ",\n".join(values) if len(values) <= 3 else ""
        rows.append([effect["effect"], session["session"], fitted, number(session["probability"], 2), answer])
    headings = ("effect", "session", "fitted there", "P(the same)", "replicates")
    return Section("Across sessions", [lead, Sheet(headings, rows)])


def gap_section(data: Data, diagnosis: Diagnosis | None = None, nominal: float | None = None) -> Section:
    """How far model and measurements are apart, before and after: on the data, less outliers, and on rows that no fit
    has seen, and whether the model holds there."""
    gap, rows, out, unit = data["gap"], data.get("rows"), data["outlier_rows"], data.get("reading_unit", "mm")
    sources = {"repeats": "repeats", "close_repeats": "repeats close in time", "sigma": "sigma_mm"}
    noise = "the noise, which is not known"
    if (floor := gap["noise_floor_mm"]) is not None:
        noise = f"the noise floor {number(floor)} {unit}, from {sources[gap['noise_floor_from']]}"
    figures = (number(gap[key]) for key in ("rms_before_mm", "rms_after_mm", "noise_floor_mm"))
    counted = "" if rows is None else f"{rows - len(out)} of {rows}" if out else str(rows)
    shown, sentences = [["the data", counted, *figures, ""]], []
    for test in tests_of(data):
        answer, sentence = holds_in_words(test, unit)
        figures = (number(test[key]) for key in ("before_mm", "after_mm", "predicted_mm"))
        kind = "held out" if test["by"] == "holdout" else "cross-validated"
        shown.append([f"{kind}: {test['file'] or test['transfer']}", str(test["rows"]), *figures, answer])
        sentences.append(sentence)
    parts: list[Part] = [
        Sheet([f"RMS distance [{unit}]", "rows", "before", "after", "expected", "holds"], shown),
        "RMS distance between model and measurement, before as armcal identify leaves it. Expected on the data: "
        f"{noise}; on rows that no fit has seen: what the model predicts. A smaller gap alone does not prove a name.",
        *sentences,
        *(f"Scatter: {scatter_in_words(finding)}." for finding in data["scatter"]),
        *([f"Rows left out as outliers: {', '.join(map(str, out))}."] if out else []),
        *([] if nominal is None else [f"Drawing: {number(nominal)} {unit} RMS, {DRAWN['base']}."]),
        *pictures_of(diagnosis, "gap_figure"),
    ]
    return Section("The gap, before and after", parts)


def holds_in_words(test: Data, unit: str = "mm") -> tuple[str, str]:
    """Whether the named model holds in rows that were not used for the fits, in a word and in a sentence."""
    confirmed, which = test["confirmed"], test["file"] or test["transfer"]
    groups = f"{test['rows']} rows in {test['groups']} independent groups"
    how = "" if test["by"] == "holdout" else "cross-validated, "
    where = f"{which} ({how}{groups})"
    if confirmed is None:
        answer, sentence = "too few rows", f"The rows are too few to say whether the model holds for {where}."
    elif confirmed and not test["as_predicted"]:  # whether as far as expected stays open
        figures = f"{number(test['after_mm'])} {unit}, where {number(test['predicted_mm'])} {unit} was expected"
        unsure = f"{groups} are too few to say whether the difference is chance"
        answer, sentence = "shrinks", f"The error shrinks on rows not fitted ({how}{which}), to {figures}; {unsure}."
    elif confirmed:
        answer, sentence = "yes", f"The model holds for {where}{': the gap shrinks' if test['shrinks'] else ''}."
    elif test["shrinks"]:
        answer, sentence = "no", f"For {where} the gap shrinks, but by less than predicted."
    else:
        why = ["the gap does not shrink"] if test["shrinks"] is False else []
        why += ["the gap exceeds the prediction"] if test["as_predicted"] is False else []
        answer, sentence = "no", f"The model does not hold for {where}: {' and '.join(why)}."
    refitted = " and ".join(test["refitted"])
    return answer, sentence + (f" Another set-up: {refitted} refitted to these rows." if refitted else "")


def scatter_in_words(finding: Data) -> str:
    """A property of the noise, an entry of `scatter`."""
    kind, _, joint = finding["finding"].partition(":")
    when = "early" if finding["size"] < 0.0 else "late"
    what = {
        "joint_noise": f"larger the farther joint {joint} moves the point, by a relative variance of",
        "reach_noise": "larger far from the base, by a relative variance of",
        "time_noise": f"larger {when} in the session, by a relative variance of",
        "serial_correlation": "rows measured one after the other err alike, lag-1 correlation",
        "repeats": "rows of one posture err alike, by a relative variance of",
    }[kind]
    return f"{finding['finding']} ({what} {abs(finding['size']):.2g}, probability {1.0 - finding['p']:.2f})"


def curve_sections(data: Data, diagnosis: Diagnosis | None = None) -> list[Section]:
    """Error curves of joints, where there are any: over which angles, how large, how sure, and of which shape."""
    text = (
        "Real less commanded angle over the angles measured, with a 95 % band; zero outside. Dots: what groups of rows "
        "say, with everything else in the model. Waves: per turn, strongest first, and their share of the curve."
    )
    rows = []
    for c in data["curves"]:
        kind, waves, _ = str(c["shape"]).partition(": ")
        shape = str(c["shape"]).partition(" over ")[0]  # without the angles
        if waves:  # `waves 11, 14, 2, 5 (93 %)`
            orders = ", ".join(f"{wave['order']:g}" for wave in c["waves"])
            shape = f"{kind} {orders} ({100.0 * sum(wave['share'] for wave in c['waves']):.0f} %)"
        sizes = (f"{np.sqrt(np.mean(np.square(c[key]))):.2g}" for key in ("error_deg", "std_deg"))
        rows.append([str(c["joint"]), f"{c['angle_deg'][0]:.0f} to {c['angle_deg'][-1]:.0f}", *sizes, shape])
    table = Sheet(("joint", "angles [deg]", "RMS [deg]", "std [deg]", "shape"), rows)
    shown = [table, text, *pictures_of(diagnosis, "curves_figure")]
    return [Section("Error curves of joints", shown)] if rows else []


def further_sections(data: Data) -> list[Section]:
    """All explanations, what these postures can show, and notes; folded but where nothing is named."""
    other = {" + ".join(one["effects"]): one["probability"] for one in data["other_sets"]}
    chances = [
        [name, probability_text(p), "yes" if name in data["credible_set"] else ""]
        for name, p in (data["probabilities"] | other).items()
    ]
    tried: list[Part] = [Sheet(("explanation", "probability", "in the 90 % set"), chances)]
    alike = [[pair["effect"], pair["like"], f"{pair['likeness']:.3f}"] for pair in data["aliases"]]
    shown: list[Part] = [
        Sheet(("effect", "joints", "found from (90 % power)", "tip [mm]"), excluded_by_kind(data)),
        "Effects smaller than these may still be present. Tip: what the largest of them would move it by, RMS over the "
        "rows.",
        Sheet(("effect", "looks like", "likeness"), alike, "Hard to distinguish"),
    ]
    sections = [
        Section("How likely each explanation is", tried, folded=True),
        Section("What these postures can and cannot show", shown, folded=bool(data["effects"])),
    ]
    notes = [as_sentence(note) for note in data["notes"]]
    return [*sections, *([Section("Notes", notes)] if notes else [])]


def size_in_words(size: Data) -> str:
    """The smallest size that can be detected, an entry of `excluded`."""
    if size["value"] is None:
        return "invisible"
    return f"{size['value']:.3g}" if size["unit"] == "1" else f"{size['value']:.3g} {size['unit']}"


def excluded_by_kind(data: Data) -> list[list[str]]:
    """For each kind of effect the smallest sizes that these data would have shown with 90 % probability, those first
    that may move the tip most without being found."""
    kinds: dict[str, list[tuple[str, Data]]] = {}
    for name, size in data["excluded"].items():
        key, _, setting = name.partition("[")
        kind, _, joint = key.partition(":")
        kinds.setdefault(f"{kind}[{setting}" if setting else kind, []).append((joint, size))
    rows = []
    for kind, sizes in kinds.items():
        joints = sorted(int(joint) for joint, _ in sizes if joint)
        ordered = sorted((size for _, size in sizes), key=lambda size: (size["value"] is None, size["value"]))
        least, most = size_in_words(ordered[0]), size_in_words(ordered[-1])
        unit = f" {ordered[-1]['unit']}"
        span = most if least == most else f"{least.removesuffix(unit)} to {most}"
        moved = max(np.inf if size["value"] is None else size["tip_mm"] or 0.0 for _, size in sizes)
        listed = of_joints(joints).removeprefix("joints ").removeprefix("joint ") if joints else "–"
        rows.append((-moved, [kind, listed, span, number(moved, 3) if np.isfinite(moved) else "any"]))
    return [row for _, row in sorted(rows, key=lambda pair: pair[0])]


# -- before a diagnosis ------------------------------------------------------------------------------------------------
def untested(skipped: Mapping[str, str]) -> list[str]:
    """One sentence for each reason why effects were not tested;  skipped : effect -> reason."""
    words = {"needs gravity": "needs [gravity] in the arm file", "needs temperature": "needs temperature_C that varies"}
    return [
        f"not tested, {words.get(why, why)}: {', '.join(key for key, reason in skipped.items() if reason == why)}"
        for why in dict.fromkeys(skipped.values())
    ]


def detectability_document(sees: Detectability) -> Document:
    """Visible fraction, smallest size and look-alikes of every effect."""
    rows = []
    for name, visible in zip(sees.names, sees.norm_fractions, strict=True):
        alike = [f"{other} ({likeness:.2f})" for one, other, likeness in sees.pairs() if one == name]
        rest = f" and {len(alike) - 2} more" if len(alike) > 2 else ""
        rows.append([name, f"{visible:.2f}", str(sees.detectable[name]), ",\n".join(alike[:2]) + rest])
    title = "What this plan can show of missing effects (smallest: with 90 % power)"
    table = Sheet(("effect", "visible", "smallest found", "looks like"), rows, title)
    never = [f"never identifiable: {key}: equivalent to {why}" for key, why in sees.aliases.items()]
    freedom = f"{sees.freedom} residual degrees of freedom"
    return Document("Missing effects", [], [table, freedom, *untested(sees.skipped), *never])
