"""A diagnosis in words: its verdict, what follows from it, and a document of it, by its JSON object."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.arrays import rows_in_words
from identification.document import (
    Action,
    Document,
    Part,
    Pictures,
    Section,
    Sheet,
    as_sentence,
    count_of,
    estimate_text,
    in_a_sentence,
    number,
    of_joints,
    unit_or_dash,
)
from identification.documents import identification as fits
from identification.effects import library
from identification.estimation.result import corrected_values
from identification.running import Status

if TYPE_CHECKING:
    from identification.gap.detectability import Detectability
    from identification.gap.result import Diagnosis

Data = Mapping[str, Any]  # what `armcal diagnose --json` says
MOST = 4  # kinds of effects that a verdict spells out
SCATTER = {  # kind of a finding -> what it is, before its size
    "joint_noise": "larger the farther joint {joint} moves the point, by a relative variance of",
    "reach_noise": "larger far from the base, by a relative variance of",
    "time_noise": "larger {when} in the session, by a relative variance of",
    "serial_correlation": "errors of successive rows are correlated, as in a drift, lag-1 correlation",
    "repeats": "rows of one posture share an error, by a relative variance of",
}
NOISE_FROM = {"repeats": "repeats", "close_repeats": "repeats close in time", "sigma": "sigma_mm"}
ABOUT_GAP = (
    "RMS distance between model and measurement. Before: a plain fit of the arm file. Expected on the data: less than "
    "{}, part of which a fit follows; on other rows: as the model predicts. A smaller gap alone does not prove a name."
)
ACROSS_SESSIONS = (
    "Every session has its own base; everything else is shared. Fitted there: the effect's values from this session "
    "alone. P(the same): probability that they are the same as in the other sessions. An effect replicates where this "
    "is 0.9 or more."
)
CURVES = (
    "Real minus commanded angle over the measured angles, with a 95 % band; zero outside. Dots: estimates from groups "
    "of rows, with everything else in the model. Waves: per turn, strongest first, and their share of the curve."
)
SMALLER = (
    "Effects smaller than these may still be present. Tip: how far the largest of them would move the tip, RMS over "
    "the rows."
)
APPROACH_AGAIN = "Repeat some postures later: repeats show the arm's own scatter, but not what the model lacks"


# -- the verdict -------------------------------------------------------------------------------------------------------
def diagnosis_verdict(data: Data) -> list[str]:
    """What is missing in one short sentence, then with its details: in doubt that first, and whether the model is no
    better than the geometry alone."""
    effects, sets, verdict, lines = data["effects"], data["candidates"], data["verdict"], []
    named, several = effects_in_words(effects), len({label.partition(":")[0] for label in effects}) > 1
    if refuted(data):
        partly = "Not confirmed as predicted: the error on held-out rows falls by less."
        lines.append(partly if shrinks(data) else f"Not confirmed on {judges(data)}.")
    lines += fits.hardly_better(data)
    if verdict == "none" and data["misfit"] and data["misfit"]["significant"]:
        return [*lines, "The model is incomplete or sigma_mm too small; these data do not show what is missing."]
    if verdict == "none":
        return [*lines, "Nothing is missing from the model as far as these data show."]
    if verdict == "named" and several:
        return [*lines, f"Missing from the model: {len(effects)} effects.", as_sentence(named)]
    if verdict == "named":
        return [*lines, f"Missing from the model: {named}."]
    if verdict == "ambiguous" and len(sets) == 1:
        return [*lines, f"Most likely, but with a probability below one half: {named}."]
    if verdict == "ambiguous":
        total = number(sum(c["probability"] for c in sets), 2)
        first = number(sets[0]["probability"], 2)
        count = f"The {len(sets)} likeliest explanations have a probability of {total} together, the first {first}."
        shared, besides = in_common([c["effects"] for c in sets])
        spelt = [effects_in_words(rest) or "nothing" for rest in besides[:MOST]]
        spelt += [f"{len(sets) - MOST} more"] * (len(sets) > MOST)
        common = f"In all of them: {effects_in_words(shared)}. Besides: " if shared else ""
        return [*lines, count, as_sentence(common + "; or ".join(spelt))]
    if perhaps_scatter(data):
        lines.append("The arm scatters by more than sigma_mm, or something outside the library is missing.")
    else:
        lines.append(f"Something outside the library is missing, {place_in_words(data)}.")
    if is_described(data):
        curves = sorted(curve["joint"] for curve in data["curves"])
        words = "An error curve of {} describes" if len(curves) == 1 else "Error curves of {} describe"
        lines.append(f"{words.format(of_joints(curves))} it; its cause is unknown.")
    return [*lines, *([f"In addition, each likelier than not: {named}."] if effects else [])]


def in_common(sets: Sequence[Sequence[str]]) -> tuple[list[str], list[list[str]]]:
    """What all sets of effects share, and what each has besides. Their settings make no difference: those of a set are
    its likeliest, and its probability is of all; what is shared has its setting where that is the same in all."""
    tables = list[dict[tuple[str, int], str]]()  # effect without setting, and which of those of one set it is -> label
    for labels in sets:
        keys = [label.partition("[")[0] for label in labels]
        tables.append(
            {(key, keys[:k].count(key)): label for k, (key, label) in enumerate(zip(keys, labels, strict=True))}
        )
    common = [slot for slot in tables[0] if all(slot in table for table in tables)]
    shared = [tables[0][slot] if len({table[slot] for table in tables}) == 1 else slot[0] for slot in common]
    return shared, [[label for slot, label in table.items() if slot not in common] for table in tables]


def perhaps_scatter(data: Data) -> bool:
    """Whether what is unknown may be the arm's own scatter: more than sigma, and at no place."""
    return data["where"] is None and bool(data["misfit"] and data["misfit"]["significant"])


def findings(data: Data) -> list[str]:
    """What belongs to the verdict, in sentences: a shape, scatter that is not explained, sessions."""
    lines = [f"Its shape: {data['shape']}."] if data["shape"] and not is_described(data) else []
    if (misfit := data["misfit"]) and misfit["significant"]:
        shared = [finding["finding"] == "repeats" for finding in data["scatter"]]
        why = (": rows of one posture share an error" if shared else ", which nothing here explains") * all(shared)
        lines.append(f"The residuals scatter by {misfit['ratio']:.3g} x sigma_mm{why}.")
    elif (data.get("confirmation") or {}).get("beyond_sigma"):
        lines.append("On the held-out rows the residuals are larger than sigma_mm explains.")
    for answer, says in ((True, "Replicates"), (False, "Does not replicate")):
        if effects := [one["effect"] for one in data["replication"] if one["replicates"] is answer]:
            lines.append(f"{says} across sessions: {' + '.join(effects)}.")
    return lines


def gap_in_words(data: Data) -> str:
    """The error before and after, where it was held out if it was."""
    test, unit = data["confirmation"], data.get("reading_unit", "mm")
    if test is not None:
        before, after, expected = (in_a_sentence(test[f"{key}_mm"]) for key in ("before", "after", "predicted"))
        figures = f"from {before} to {after} {unit}; {expected} {unit} was predicted"
        return f"On {count_of(test['rows'], 'held-out row')} the RMS error goes {figures}."
    before, after = (in_a_sentence(data["gap"][f"rms_{when}_mm"]) for when in ("before", "after"))
    if data["verdict"] == "none":
        return f"The model leaves an RMS error of {after} {unit} on the data; no rows were held out."
    figures = f"from {before} to {after} {unit}"
    return f"On the data, with the geometry fitted, the RMS error goes {figures}; no rows were held out to confirm it."


def effects_in_words(labels: Sequence[str]) -> str:
    """`encoder disc off centre, once per turn (encoder_eccentricity:1)`; the first few, one kind is said once; of many
    joints `backlash of joints 1 to 5`, with many settings `transmission_ripple of joints 2 and 3, 12 in all`."""
    kinds: dict[str, list[str]] = {}
    for label in labels:
        kinds.setdefault(label.partition("[")[0].partition(":")[0], []).append(label)
    phrases = []
    for kind, alike in kinds.items():
        joints = {label.partition("[")[0].removeprefix(kind).removeprefix(":") for label in alike}
        listed = ", ".join(alike)
        if len(alike) > 2 and ("" not in joints or len(alike) > MOST):
            whose = f" of {of_joints(sorted(map(int, joints)))}" if "" not in joints else ""
            listed = f"{kind}{whose}{f', {len(alike)} in all' if len(alike) > len(joints) else ''}"
        phrases.append(f"{library()[kind].summary} ({listed})" if kind in library() else listed)
    rest = [f"and {count_of(len(phrases) - MOST, 'more kind')}"] if len(phrases) > MOST else []
    return "; ".join([*phrases[:MOST], *rest])


def shrinks(data: Data) -> bool:
    """Whether the error shrinks in rows that were held out, be it by less than predicted."""
    return bool((data["confirmation"] or {}).get("shrinks"))


def refuted(data: Data) -> bool:
    """Whether the hold-out speaks against the model; without one, whether cross-validation does."""
    tests = [data["confirmation"]] if data["confirmation"] else data["cross_validation"]
    return any(test["confirmed"] is False for test in tests)


def implausible(data: Data) -> bool:
    """Whether rows or arm file must be put right first: no geometry explains the rows as they are."""
    return any(doubt.startswith(("implausible", fits.MOVED)) for doubt in data["warnings"])


def judges(data: Data) -> str:
    """The rows by which a model is confirmed or not; those of cross-validation had a part in the choice of effects."""
    return "held-out rows" if data["confirmation"] else "rows left out in cross-validation"


def is_described(data: Data) -> bool:
    """Whether error curves stand for what is unknown: the fitted set is no name for it, and has no probability."""
    return (data["where"], data["shape"]) in {(f"joint:{c['joint']}", c["shape"]) for c in data["curves"]}


def place_in_words(data: Data) -> str:
    """`at joint 3`, `in time`."""
    where = str(data["where"] or "an unknown place").replace(":", " ")
    words = {"time": "in time", "temperature": "with the temperature", "workspace": "in the workspace"}
    return words.get(where, f"at {where}")


def tests_of(data: Data) -> list[Data]:
    """What rows that were not used for the fits say: the hold-out, and cross-validation."""
    return ([data["confirmation"]] if data["confirmation"] else []) + list(data["cross_validation"])


# -- what to do next ---------------------------------------------------------------------------------------------------
def diagnosis_actions(
    data: Data, arm: str = "arm.toml", rows: Sequence[str] = ("data.csv",), written: Path | None = None
) -> list[Action]:
    """What follows from a diagnosis of these files;  written : the extended model, where it has been"""
    again = " ".join(["armcal diagnose", arm, *rows])
    joined = ", of all rows in one file with a column session" * (len(rows) > 1)
    alone = fits.identify_command(arm, "all.csv" if joined else rows[0], fits.ALONE)
    another = "Measure about twenty other postures, preferably on another day, to confirm what was found:"
    confirm = Action(another, f"{again} --holdout other.csv")
    if implausible(data):
        if any(doubt.startswith(fits.MOVED) for doubt in data["warnings"]):
            rename = "Give the measured points of each session names of their own (column marker), and diagnose again:"
            return [Action(rename, again)]
        return [Action("Put the rows or the arm file right first:", f"armcal check {arm} {rows[0]}")]
    if refuted(data):
        gain = " yet: the error on held-out rows falls by less than predicted"
        why = gain if shrinks(data) else f": {judges(data)} speak against it"
        return [Action(f"Do not put this into the controller{why}."), confirm]
    if data["verdict"] == "none":
        return [Action(f"Use the calibration of the geometry{joined}:", alone), fits.correct("calibrated.toml")]
    if data["verdict"] == "ambiguous":
        apart = " ".join(["armcal discriminate", arm, *rows, "--runs 6 --out next.csv"])
        measure = Action("Measure the postures that tell the explanations apart:", apart)
        return [measure, Action("Add the new rows to the data, and diagnose again:", again)]
    # better by chance perhaps is better still: of simulated arms the geometry alone was farther off in all such cases
    if (offered := data.get("offered")) and offered["rms_mm"] >= offered["rms_geometry_mm"]:
        use = Action(f"Use the calibration of the geometry{joined}, unless other rows show that it is worse:", alone)
        return [use, fits.correct("calibrated.toml"), confirm]
    actions = [] if data["confirmation"] and data["confirmation"]["confirmed"] else [confirm]
    if data["verdict"] == "unknown":
        usable = "; the extended model contains it and may be used in the meantime, within the measured angles"
        look = APPROACH_AGAIN if perhaps_scatter(data) else f"Look for a cause {place_in_words(data)}"
        actions.insert(0, Action(f"{look}{usable if data['predicting'] else ''}."))
    if written is None:
        actions.append(Action("Keep the extended model:", f"{again} --out extended.toml"))
    return [*actions, fits.correct(str(written or "extended.toml"))]


# -- the document ------------------------------------------------------------------------------------------------------
def diagnosis_document(
    diagnosis: Diagnosis,
    files: Sequence[str] = ("arm.toml", "data.csv"),
    written: Path | None = None,
    nominal: float | None = None,
) -> Document:
    """All of a diagnosis.

    files : arm and measurements, for the commands of the next steps;  written : the extended model, where it has been
    nominal : RMS distance of the drawing [mm]
    """

    def picture(name: str) -> Pictures:
        """Drawn where it is seen: matplotlib takes longer to load than a small diagnosis."""
        return Pictures(lambda: resolve_name(f"identification.documents.pictures:{name}")(diagnosis))

    data, named = diagnosis.to_json() | {"files": files}, diagnosis.named
    reliance = [f"95 % intervals: {named.uncertainty.sentence}."] if data["verdict"] in ("named", "ambiguous") else []
    sections = [Section("What is missing", [*missing_parts(data), *reliance])]
    if data["replication"]:
        sessions = []
        for effect, session in ((one, session) for one in data["replication"] for session in one["sessions"]):
            figures = [
                f"{p['name'].rpartition('.')[2]} = {p['value']:.3g} ± {p['std']:.1g} {p['unit']}"
                for p in session["parameters"]
            ]
            fitted = ",\n".join(figures) if len(figures) <= 3 else ""
            answer = {True: "yes", False: "no", None: "open"}[session["replicates"]]
            sessions.append([effect["effect"], session["session"], fitted, number(session["probability"], 2), answer])
        headings = ("effect", "session", "fitted there", "P(the same)", "replicates")
        sections.append(Section("Across sessions", [ACROSS_SESSIONS, Sheet(headings, sessions)]))
    sections.append(Section("The gap, before and after", [*gap_parts(data, nominal), picture("gap_figure")]))
    # of several explanations none alone; beside something unknown the names are off by what they take of it
    best = diagnosis.predicting if data["verdict"] in ("ambiguous", "unknown") else named
    undetermined = [name for name, (low, _) in named.limits_95.items() if np.isnan(low)]
    extended = diagnosis.extended_arm(best)
    values = corrected_values(extended, extended.calibration, unknown=undetermined)
    title = "Corrected values, not confirmed" if refuted(data) else "Corrected values"
    corrected = fits.corrected_section(title, values, folded=refuted(data))
    # errors of any form are not zero on average: zeros and frames make up for them
    if forms := [spec.key for spec in best.specs if spec.curve is None and library()[spec.name].unlisted]:
        sections.append(Section(title, [f"Enter none: zeros and frames hold only together with {', '.join(forms)}."]))
        corrected = Section("Zeros and frames of this model", corrected.parts[:1], folded=True)
    sections.append(corrected)
    sections.append(Section("Signed error against each joint", [picture("signed_of")]))
    if data["curves"]:
        sections.append(Section("Error curves of joints", [curve_table(data), CURVES, picture("curves_figure")]))
    how = "Unsigned distances: points are rows, lines the RMS of groups of rows."
    sections.append(Section("Against joints, time and torque", [how, picture("against_figure")], folded=True))
    alike = [[pair["effect"], pair["like"], f"{pair['likeness']:.3f}"] for pair in data["aliases"]]
    sizes = Sheet(("effect", "joints", "detectable from (90 % power)", "tip [mm]"), excluded_by_kind(data))
    shown: list[Part] = [sizes, SMALLER, Sheet(("effect", "looks like", "likeness"), alike, "Hard to distinguish")]
    # folded but where nothing is named
    sections.append(Section("What these postures can and cannot show", shown, folded=bool(data["effects"])))
    if notes := [as_sentence(note) for note in data["notes"]]:
        sections.append(Section("Notes", notes))
    verdict = [*diagnosis_verdict(data), gap_in_words(data)]
    actions = diagnosis_actions(data, files[0], files[1:], written)
    return Document(f"Gap report: {diagnosis.arm.name or 'arm'}", verdict, sections, actions, data["warnings"])


def missing_parts(data: Data) -> list[Part]:
    """What is named, how likely it is, and its values. Beside something unknown it has none of its own, which would be
    off by what it takes of that: the corrected values are of both."""
    tests, figures, estimates, several = tests_of(data), [], list[Part](), len(data["candidates"]) > 1
    for c in data["candidates"] if data["verdict"] in ("named", "ambiguous") else []:
        p = c["probability"]  # a small one is never rounded to zero
        chance = "< 0.01" if p and p < 0.005 else number(p, 2)
        figures.append([" +\n".join(c["effects"]), chance, f"{c['delta_bic']:.1f}"])
        labels = {key: label for label in c["effects"] for key in (label.partition("[")[0], label)}  # with settings
        rows = []
        for row in c["parameters"]:
            owner, _, short = row["name"].rpartition(".")
            limits = (estimate_text(row[key], row["std"], row["unit"]) for key in ("value", "low_95", "high_95"))
            rows.append([f"{labels.get(owner, owner)}.{short}", *limits, unit_or_dash(row["unit"])])
        title = f"Estimates: {' + '.join(c['effects'])}" if several else "Estimates"
        estimates.append(Sheet(("parameter", "value", "low 95 %", "high 95 %", "unit"), rows, title, 40))
    # the probabilities in one line, and whether no test of other rows has an answer
    is_open = data["effects"] and tests and all(test["confirmed"] is None for test in tests)
    among = " (other rows leave open whether it holds)" if is_open else ""
    # long ones stand in the table alone
    listed = {" + ".join(c["effects"]) for c in data["candidates"] if several and len(c["effects"]) > MOST}
    shares = {name: p for name, p in data["probabilities"].items() if p >= 0.005 and name not in listed}
    every = ", ".join(f"{name} {p:.2f}" for name, p in shares.items())
    parts: list[Part] = [*findings(data), f"Probability{among}: {every}."]
    if several:
        parts.append("Every explanation with at least a twentieth of the best one's probability:")
        parts.append(Sheet(("effects", "probability", "-2 log odds"), figures))
    return [*parts, *estimates]


def gap_parts(data: Data, nominal: float | None = None) -> list[Part]:
    """How far model and measurements are apart, before and after: on the data, less outliers, and on rows that no fit
    has seen, and whether the model holds there."""
    gap, rows, out, unit = data["gap"], data["rows"], data["outlier_rows"], data.get("reading_unit", "mm")
    noise, below = "the noise, which is not known", ""
    if (floor := gap["noise_floor_mm"]) is not None:
        source = NOISE_FROM[gap["noise_floor_from"]]
        noise = f"the noise floor {number(floor)} {unit}, from {source}"
        if gap["noise_floor_from"] == "close_repeats":  # in which errors are missing that change slowly
            noise = f"the noise, which is {number(floor)} {unit} in {source} and more where errors change slowly"
        else:
            below = f"< {number(floor)}"
    counted = f"{rows - len(out)} of {rows}" if out else str(rows)
    shown, sentences = [["the data", counted, number(gap["rms_before_mm"]), number(gap["rms_after_mm"]), below, ""]], []
    for test in tests_of(data):
        answer, sentence = holds_in_words(test, unit)
        figures = (number(test[key]) for key in ("before_mm", "after_mm", "predicted_mm"))
        kind = "held out" if test["by"] == "holdout" else "cross-validated"
        shown.append([f"{kind}: {test['file'] or test['transfer']}", str(test["rows"]), *figures, answer])
        sentences.append(sentence)
    for finding in data["scatter"]:
        kind, _, joint = finding["finding"].partition(":")
        what = SCATTER[kind].format(joint=joint, when="early" if finding["size"] < 0.0 else "late")
        chance = f"probability {1.0 - finding['p']:.2f}"
        sentences.append(f"Scatter: {finding['finding']} ({what} {abs(finding['size']):.2g}, {chance}).")
    through = ", counted through the files" if len(data.get("files", ())) > 2 else ""  # the first is the arm
    sentences += [f"Rows left out as outliers{through}: {', '.join(map(str, out))}."] if out else []
    sentences += [] if nominal is None else [f"Drawing: {number(nominal)} {unit} RMS, {fits.DRAWN['base']}."]
    table = Sheet([f"RMS distance [{unit}]", "rows", "before", "after", "expected", "holds"], shown)
    return [table, ABOUT_GAP.format(noise), *sentences]


def holds_in_words(test: Data, unit: str = "mm") -> tuple[str, str]:
    """Whether the named model holds in rows that were not used for the fits, in a word and in a sentence."""
    confirmed, which = test["confirmed"], test["file"] or test["transfer"]
    groups = f"{count_of(test['rows'], 'row')} in {count_of(test['groups'], 'independent group')}"
    how = "" if test["by"] == "holdout" else "cross-validated, "
    where, answer = f"{which} ({how}{groups})", "no"
    if confirmed is None:
        answer, sentence = "open", f"These rows do not show whether the model holds for {where}."
    elif confirmed and not test["as_predicted"]:  # whether as far as expected stays open
        figures = f"{number(test['after_mm'])} {unit}, where {number(test['predicted_mm'])} {unit} was expected"
        if test["after_mm"] > test["predicted_mm"]:
            figures += f"; {groups} are too few to say whether the difference is chance"
        answer, sentence = "shrinks", f"The error shrinks on rows not fitted ({how}{which}), to {figures}."
    elif confirmed:
        answer, sentence = "yes", f"The model holds for {where}{': the gap shrinks' if test['shrinks'] else ''}."
    elif test["shrinks"]:
        sentence = f"For {where} the gap shrinks, but by less than predicted."
    else:
        reasons = {"shrinks": "the gap does not shrink", "as_predicted": "the gap exceeds the prediction"}
        why = " and ".join(reason for key, reason in reasons.items() if test[key] is False)
        sentence = f"The model does not hold for {where}: {why}."
    refitted = " and ".join(test["refitted"])
    return answer, sentence + (f" Fitted to these rows first, for both models: {refitted}." if refitted else "")


def curve_table(data: Data) -> Sheet:
    """Error curves of joints: over which angles, how large, how sure, and of which shape."""
    rows = []
    for c in data["curves"]:
        kind, waves, _ = str(c["shape"]).partition(": ")
        shape = str(c["shape"]).partition(" over ")[0]  # without the angles
        if waves:  # `waves 11, 14, 2, 5 (93 %)`
            orders = ", ".join(f"{wave['order']:g}" for wave in c["waves"])
            shape = f"{kind} {orders} ({100.0 * sum(wave['share'] for wave in c['waves']):.0f} %)"
        sizes = (f"{np.sqrt(np.mean(np.square(c[key]))):.2g}" for key in ("error_deg", "std_deg"))
        rows.append([str(c["joint"]), f"{c['angle_deg'][0]:.0f} to {c['angle_deg'][-1]:.0f}", *sizes, shape])
    return Sheet(("joint", "angles [deg]", "RMS [deg]", "std [deg]", "shape"), rows)


def excluded_by_kind(data: Data) -> list[list[str]]:
    """For each kind of effect the smallest sizes that these data would have shown with 90 % probability, those first
    that may move the tip most without being found."""
    kinds: dict[str, list[tuple[str, Data]]] = {}
    for name, size in data["excluded"].items():
        key, bracket, setting = name.partition("[")
        kind, _, joint = key.partition(":")
        kinds.setdefault(f"{kind}{bracket}{setting}", []).append((joint, size))
    rows = []
    for kind, sizes in kinds.items():
        joints, unit = sorted(int(joint) for joint, _ in sizes if joint), sizes[0][1]["unit"]
        unit = "" if unit == "1" else f" {unit}"
        values = [np.inf if size["value"] is None else size["value"] for _, size in sizes]
        moved = max(np.inf if size["value"] is None else size["tip_mm"] or 0.0 for _, size in sizes)
        ends = dict.fromkeys("invisible" if v == np.inf else f"{v:.3g}{unit}" for v in (min(values), max(values)))
        listed = of_joints(joints).partition(" ")[2] if joints else "–"
        rows.append((-moved, [kind, listed, " to ".join(ends), number(moved, 3) if np.isfinite(moved) else "any"]))
    return [row for _, row in sorted(rows, key=lambda pair: pair[0])]


# -- before a diagnosis ------------------------------------------------------------------------------------------------
def remarks(result: Diagnosis, skipped: Mapping[str, str], searched: int, status: Status, alone: bool) -> Iterator[str]:
    """Sentences to read before the verdict is trusted.

    skipped : as of `untested`;  searched : rows in which effects were looked for;  status : of the fit of the best set
    alone : whether the geometry alone predicts better
    """
    measurements = result.measurements
    timed, most = {name for name, effect in library().items() if "time" in effect.needs}, 3
    alike = dict[tuple[bool, str], dict[str, float]]()
    for effect, like, share in result.aliases:
        # a drift and an effect of the posture are alike where rows follow one another by posture
        ordered = len({re.split(r"[:[]", label)[0] in timed for label in (effect, like)}) > 1
        one, other = (effect, like) if effect in result.effects or not ordered else (like, effect)
        if one in result.effects and (ordered or "[" in like):
            alike.setdefault((not ordered, one), {}).setdefault(other, share)
    for (angles, effect), others in sorted(alike.items(), key=itemgetter(0))[:most]:
        where, how = ("at these postures", "at other joint angles") if angles else ("in this order", "in random order")
        # the odds stay below 20 up to lambda = 173
        word = "cannot be distinguished from" if max(others.values()) > 0.9999 else "is hard to distinguish from"
        rest = f" and {len(others) - most} more" if len(others) > most else ""
        yield f"{where} {effect} {word} {', '.join([*others][:most])}{rest}; to decide, measure {how}"
    if len(alike) > most:
        yield f"the same holds of {count_of(len(alike) - most, 'more effect')}: --json lists them as aliases"
    if result.curves:
        spans = [np.degrees([curve.angles[0], curve.angles[-1]]) for curve in result.curves]
        ranges = [f"joint {c.joint} {a:.0f} to {b:.0f} deg" for c, (a, b) in zip(result.curves, spans, strict=True)]
        beyond = "where a joint is outside them, the model has no curves, and the geometry that was fitted without them"
        yield f"the error curves are valid for the measured angles ({', '.join(ranges)}); {beyond}"
    if alone:
        yield "the geometry alone predicts better, so --out writes that"
    yield from untested(skipped)
    if len(measurements.sessions) > 1 and measurements.dimension > 2 and any("_step:" in e for e in result.effects):
        yield "a reflector remounted between sessions looks like steps: give it another name (marker) in each session"
    if searched < len(measurements):
        some = f"{searched} of the {len(measurements)} rows, chosen at random"
        yield f"effects were searched for in {some}; what was found is fitted to all"
    if status is not Status.converged:
        yield f"the fit of the best model did not converge: {status.value}"
    if measurements.directions is None and (measurements.gaps is None or not measurements.gaps[1:].all()):
        yield "directions of approach were derived from the order of measurement"
    if result.misfit is not None and measurements.sigma is None and not 0.67 < result.misfit.ratio < 1.5:
        of_file = f"{result.misfit.ratio:.3g} times the sigma_mm of the arm file"
        yield f"the residual scatter is {of_file}; the tests use the scatter, not sigma_mm"
    if rows := result.unexplained_rows:
        which = rows_in_words(np.isin(np.arange(max(rows)) + 1, rows))
        yield f"{which} are not explained; they are kept, since they are whole postures or neighbors"


def untested(skipped: Mapping[str, str]) -> list[str]:
    """One sentence for each reason why effects were not tested;  skipped : effect -> reason."""
    words = {"needs gravity": "needs [gravity] in the arm file", "needs temperature": "needs temperature_C that varies"}
    return [
        f"not tested, {words.get(why, why)}: {', '.join(key for key, reason in skipped.items() if reason == why)}"
        for why in dict.fromkeys(skipped.values())
    ]


def detectability_document(sees: Detectability) -> Document:
    """Visible fraction, smallest size and look-alikes of every effect, and what cannot be tested."""
    rows = []
    for name, visible in zip(sees.names, sees.norm_fractions, strict=True):
        alike = [f"{other} ({likeness:.2f})" for one, other, likeness in sees.pairs() if one == name]
        rest = f" and {len(alike) - 2} more" if len(alike) > 2 else ""
        rows.append([name, f"{visible:.2f}", str(sees.detectable[name]), ",\n".join(alike[:2]) + rest])
    title = "Missing effects that this plan can show (smallest: with 90 % power)"
    table = Sheet(("effect", "visible", "smallest found", "looks like"), rows, title)
    never = [f"never identifiable: {key}: equivalent to {why}" for key, why in sees.aliases.items()]
    freedom = f"{sees.freedom} residual degrees of freedom"
    return Document("Missing effects", [], [table, freedom, *untested(sees.skipped), *never])
