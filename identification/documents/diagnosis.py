"""A diagnosis in words: its verdict in a line, and a document of it, by the JSON object of `armcal diagnose`; with the
diagnosis itself with pictures too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.document import (
    Action,
    Document,
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
from identification.documents.identification import DRAWN, correct, corrected_section, hardly_better
from identification.effects import library
from identification.estimation.result import corrected_values
from identification.model import Model

if TYPE_CHECKING:
    from identification.gap.detectability import Detectability, OrderRange
    from identification.gap.result import Diagnosis

Data = Mapping[str, Any]  # what `armcal diagnose --json` says
MOST = 4  # kinds of effects that a verdict spells out
SHORT = 60  # characters of names that a verdict spells out; the tables have all of them


# -- the verdict in a line ---------------------------------------------------------------------------------------------
def sentence(result: Diagnosis) -> str:
    """The verdict with its findings in one line."""
    return "; ".join([headline(result), *findings(result)])


def headline(result: Diagnosis) -> str:
    """The verdict alone, preceded by `not confirmed`, and by how the model compares with the geometry alone where it is
    no better."""
    title, count = named(result), len(result.candidates)
    missing = f"{title} {'is' if len(result.effects) == 1 else 'are'}"
    where = (result.where or "a place that is not known").replace(":", " ")
    if result.verdict == "none":
        verdict = "none: no missing effect is detectable; effects larger than the sizes listed are excluded"
    elif result.verdict == "named":
        verdict = f"named: {missing} missing from the model"
    elif result.verdict == "ambiguous" and count == 1:
        verdict = f"ambiguous: {missing} likeliest, but less likely than not; measure more postures"
    elif result.verdict == "ambiguous":
        likeliest = sorted(result.candidates, key=lambda c: -(c.probability or 0.0))
        lists = [" | ".join(f"{c.title} {c.probability or 0.0:.2f}" for c in likeliest)]
        lists.append(" | ".join(c.title for c in likeliest))
        options = next((f" ({listed})" for listed in lists if len(listed) <= SHORT), "")
        verdict = f"ambiguous: {count} explanations fit about equally well{options}; measure more postures"
    elif described(result):
        curves = f"error curves of {of_joints([curve.joint for curve in result.curves])}"
        what = f"{curves} + {title}" if result.effects else f"no effect in the library fits; {curves}"
        verdict = f"cause unknown ({where} first): {what} describe the errors"
    else:
        verdict = f"unknown: something outside the library, {where}{f', beside {title}' if result.effects else ''}"
    if result.offered is not None and not result.offered.better:
        verdict = f"{result.offered.sentence}; {verdict}"
    return f"not confirmed: {verdict}" if result.confirmed is False else verdict


def named(result: Diagnosis) -> str:
    """The effects of the best set, or their number if the list is long."""
    title = " + ".join(result.effects)
    return title if len(title) <= SHORT or len(result.effects) <= 1 else f"{len(result.effects)} effects"


def described(result: Diagnosis) -> bool:
    """Whether an error curve describes the unknown effect: its size and shape are known, its cause is not."""
    return (result.where, result.shape) in {(f"joint:{curve.joint}", curve.shape) for curve in result.curves}


def findings(result: Diagnosis, *, orders: bool = True) -> list[str]:
    """Findings that belong to the verdict, one clause each;  orders : those about waves of undetermined order too"""
    shape = [f"its shape: {result.shape}"] if result.shape and not described(result) else []
    over = result.misfit is not None and result.misfit.significant
    scatter = [f"scatter {result.misfit.ratio:.3g} x sigma_mm, not explained"] if result.misfit and over else []
    says = {True: "replicates across sessions", False: "does not replicate across sessions"}
    titles = {answer: [r.effect for r in result.replication if r.replicates is answer] for answer in says}
    replication = [f"{says[answer]}: {' + '.join(effects)}" for answer, effects in titles.items() if effects]
    return [
        *shape,
        *scatter,
        *replication,
        *(order_clauses(result.shapes) if orders else []),
    ]


def order_clauses(shapes: Sequence[OrderRange]) -> list[str]:
    """One clause for the waves of undetermined order of each joint."""
    clauses = []
    for joint in sorted({shape.joint for shape in shapes}):
        waves = [shape for shape in shapes if shape.joint == joint]
        low, high = waves[0].range_deg
        listed = " and ".join("{} (orders {} to {} fit)".format(wave.effect, *wave.orders) for wave in waves)
        what = "is a shape, not a cause" if len(waves) == 1 else "are shapes, not causes"
        clauses.append(f"over the {high - low:.0f} deg that joint {joint} moved, {listed} {what}")
    return clauses


def likely(result: Diagnosis) -> str:
    """The probabilities in one line, with those of other sets, and what they leave open: names that are shapes rather
    than causes, and rows too few for a test."""
    few = result.effects and result.tests and all(test.confirmed is None for test in result.tests)
    shapes = ["among the library's shapes, whatever makes them"] if result.effects and result.shapes else []
    among = "; ".join([*shapes, *(["too few rows to confirm it on others"] if few else [])])
    short = {c.title: "what is named" for c in result.candidates[:1] if len(c.title) > SHORT}
    every = ", ".join(f"{short.get(name, name)} {p:.2f}" for name, p in result.probability.items() if p >= 0.005)
    other = ", ".join(f"{name} {p:.2f}" for name, p in result.other_sets.items())
    return f"probability{f' ({among})' if among else ''}: {every}{f' (of that {other})' if other else ''}"


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
    title = f"Gap report: {(diagnosis.arm.name if diagnosis else '') or 'arm'}"
    actions = diagnosis_actions(data, files[0], files[1:], written)
    return Document(
        title, diagnosis_verdict(data), diagnosis_sections(data, diagnosis, nominal), actions, data["warnings"]
    )


# -- in words ----------------------------------------------------------------------------------------------------------
def diagnosis_verdict(data: Data) -> list[str]:
    """What is missing in one short sentence, then with its details, and what it does to the error."""
    effects, sets, kinds = data["effects"], data["candidates"], kinds_of(data["effects"])
    which = effects_in_words(effects) if len(kinds) == 1 else f"{len(effects)} effects"
    lines = []
    if data["confirmed"] is False:
        partly = "Not confirmed as predicted: rows that no fit has seen gain less."
        lines.append(partly if helps(data) else "Not confirmed on rows that no fit has seen.")
    if (offered := data.get("offered")) is not None and not offered["better"]:
        lines.append(hardly_better(offered))
    lines.append(
        {
            "none": "Nothing is missing from the model that these data can show.",
            "named": f"Missing from the model: {which}.",
            "ambiguous": f"{len(sets)} explanations fit about equally well.",
            "unknown": f"Something that the library does not have is missing, at {place_in_words(data)}.",
        }[data["verdict"]]
    )
    if data["verdict"] == "ambiguous":
        lines.append(as_sentence("; or ".join([effects_in_words(c["effects"]) or "nothing" for c in sets][:MOST])))
    if data["verdict"] == "named" and len(kinds) > 1:
        lines.append(as_sentence(effects_in_words(effects)))
    if data["verdict"] == "unknown" and is_described(data):
        curves = sorted(curve["joint"] for curve in data["curves"])
        words = "An error curve of {} describes" if len(curves) == 1 else "Error curves of {} describe"
        lines.append(f"{words.format(of_joints(curves))} it; its cause is open.")
    if data["verdict"] == "unknown" and effects:
        lines.append(f"Beside it: {effects_in_words(effects)}.")
    return [*lines, gap_in_words(data)]


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


def helps(data: Data) -> bool:
    """Whether the error shrinks in rows that were held out, be it by less than predicted."""
    return bool((data["confirmation"] or {}).get("shrinks"))


def is_described(data: Data) -> bool:
    """Whether error curves stand for what is unknown: the fitted set is no name for it, and has no probability."""
    return (data["where"], data["shape"]) in {(f"joint:{c['joint']}", c["shape"]) for c in data["curves"]}


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


def holds_in_words(test: Data) -> str:
    """Whether the named model holds in rows that were not used for the fits, in a sentence."""
    how = "" if test["by"] == "holdout" else "cross-validated, "
    which, rows = test.get("file") or test["transfer"], f"{test['rows']} rows in {test['groups']} independent groups"
    where = f"{which} ({how}{rows})"
    refitted = " and ".join(test.get("refitted", ()))
    set_up = f" Another set-up: {refitted} refitted to these rows." if refitted else ""
    if test["confirmed"] is None:
        return f"The rows are too few to say whether the model holds for {where}.{set_up}"
    if test["confirmed"] and not test["as_predicted"]:
        unsure = f"{rows} are too few to say whether by as much as expected"
        return f"The error shrinks on rows not fitted ({how}{which}); {unsure}.{set_up}"
    if test["confirmed"]:
        return f"The model holds for {where}{': the gap shrinks' if test['shrinks'] else ''}.{set_up}"
    if test["shrinks"]:
        return f"For {where} the gap shrinks, but by less than predicted.{set_up}"
    shrinks = ["the gap does not shrink"] if test["shrinks"] is False else []
    exceeds = ["the gap exceeds the prediction"] if test["as_predicted"] is False else []
    return f"The model does not hold for {where}: {' and '.join(shrinks + exceeds)}.{set_up}"


def diagnosis_actions(
    data: Data, arm: str = "arm.toml", rows: Sequence[str] = ("data.csv",), written: Path | None = None
) -> list[Action]:
    """What follows from a diagnosis of these files;  written : the extended model, where it has been."""
    called = " ".join(["armcal diagnose", arm, *rows])
    fit = f"armcal identify {arm} {rows[0]}" if len(rows) == 1 else called  # identify takes one file
    use, command = "Use the calibration of the geometry", f"{fit} --out calibrated.toml"
    confirm = Action(
        "Measure some twenty other postures, best on another day, and let them confirm what was found:",
        f"{called} --holdout other.csv",
    )
    if data["confirmed"] is False:
        partly = "Do not put this into the controller yet: rows that no fit has seen gain less than predicted."
        wrong = "Do not put this into the controller: rows that no fit has seen speak against it."
        return [Action(partly if helps(data) else wrong), confirm]
    if data["verdict"] == "none":
        return [Action(f"{use}:", command), correct("calibrated.toml")]
    if data["verdict"] == "ambiguous":
        apart = " ".join(["armcal discriminate", arm, *rows, "--runs 6 --out next.csv"])
        again = Action("Add the new rows to the data, and diagnose again:", called)
        return [Action("Measure the postures that tell the explanations apart:", apart), again]
    if (offered := data.get("offered")) is not None and not offered["better"]:
        return [Action(f"{use}, which predicts as well:", command), correct("calibrated.toml"), confirm]
    keep = [] if written else [Action("Keep the extended model:", f"{called} --out extended.toml")]
    part = "the error curves, within the angles measured," if is_described(data) else "the named part"
    meanwhile = f"; {part} may be used meanwhile" if data["effects"] or is_described(data) else ""
    look = Action(f"Look for a cause at {place_in_words(data)}{meanwhile}.")
    unknown = [look] if data["verdict"] == "unknown" else []
    return [*unknown, *([] if data["confirmed"] else [confirm]), *keep, correct(str(written or "extended.toml"))]


# -- sections ----------------------------------------------------------------------------------------------------------
def diagnosis_sections(data: Data, diagnosis: Diagnosis | None = None, nominal: float | None = None) -> list[Section]:
    """The parts that show a diagnosis, without its verdict;  diagnosis, nominal : as for `diagnosis_document`"""
    sections = [missing_section(data, diagnosis), *replication_sections(data), gap_section(data, diagnosis, nominal)]
    if diagnosis is not None:
        arm = diagnosis.extended_arm(diagnosis.named)
        values = corrected_values(arm, diagnosis.named.calibration)
        doubted = data["confirmed"] is False
        title = "Corrected values, not confirmed" if doubted else "Corrected values"
        sections.append(corrected_section(title, values, not arm.chain.planar, folded=doubted))
        sections.append(signed_section(diagnosis))
    sections += curve_sections(data, diagnosis)
    if diagnosis is not None:
        how = "Distances, without their sign: rows as points, RMS in groups of rows as lines."
        pictures = Pictures(lambda: [how, _pictures().against_figure(diagnosis)])
        sections.append(Section("Against time and torque", [pictures], folded=True))
    return [*sections, *further_sections(data, diagnosis)]


def _pictures() -> Any:
    """Deferred: tables need no pictures, and matplotlib takes longer to load than a small diagnosis."""
    from identification.documents import pictures

    return pictures


def missing_section(data: Data, diagnosis: Diagnosis | None = None) -> Section:
    """What is named, how likely it is, and its values; what is named beside an unknown effect."""
    several = len(data["candidates"]) > 1
    least = " Every explanation with at least a twentieth of the best one's probability." if several else ""
    parts: list[Any] = [as_sentence(data["sentence"]) + least]
    explanations = (list(data["candidates"]) or [data["named"]]) if data["effects"] else []
    figures = [
        [
            " +\n".join(c["effects"]),
            "its cause is unknown" if is_described(data) else probability_text(c["probability"]),
            *(f"{c[key]:.1f}" for key in ("delta_bic", "f")),
        ]
        for c in explanations
    ]
    parts.append(Sheet(("effects", "probability", "-2 log odds", "F"), figures))
    for c in explanations:
        parts.append(Sheet(*estimate_rows(c), f"Estimates: {' + '.join(c['effects'])}" if several else "Estimates"))
    if diagnosis is not None:
        parts += [f"95 % intervals: {diagnosis.named.reliance}."] if explanations else []
        parts.append(as_sentence(diagnosis.likely))
    orders = [
        [one["effect"], f"{one['range_deg'][1] - one['range_deg'][0]:.0f}", "{} to {}".format(*one["orders"])]
        for one in data["shapes"]
    ]
    headings = ("wave", "joint moved over [deg]", "orders that fit")
    parts.append(Sheet(headings, orders, "Shapes, not causes: waves of other orders fit as well"))
    return Section("What is missing", parts)


def estimate_rows(candidate: Data) -> tuple[Sequence[str], list[list[str]]]:
    """Headings and rows: the parameters of its effects with 95 % intervals, named with their settings."""
    labels = {key: label for label in candidate["effects"] for key in (label.partition("[")[0], label)}
    rows = []
    for row in candidate["parameters"]:
        owner, _, short = row["name"].rpartition(".")
        figures = (estimate_text(row[key], row["std"], row["unit"]) for key in ("value", "low_95", "high_95"))
        rows.append([f"{labels.get(owner, owner)}.{short}", *figures, unit_or_dash(row["unit"])])
    return ("parameter", "value", "low 95 %", "high 95 %", "unit"), rows


def probability_text(p: float | None) -> str:
    """`0.93`; a small probability is never rounded to zero."""
    return "< 0.01" if p is not None and 0.0 < p < 0.005 else number(p, 2)


def replication_sections(data: Data) -> list[Section]:
    """Each named effect in each session, where there are several."""
    lead = (
        "Every session has a base of its own, everything else is shared. Fitted there: the effect's values from this "
        "session alone. P(the same): how likely it is that they are those of the other sessions. An effect replicates "
        "where that is 0.9 or more."
    )
    rows = []
    for effect in data["replication"]:
        for session in effect["sessions"]:
            values = [
                f"{p['name'].rpartition('.')[2]} = {p['value']:.3g} +- {p['std']:.1g} {p['unit']}"
                for p in session["parameters"]
            ]
            answer = {True: "yes", False: "no", None: "open"}[session["replicates"]]
            fitted = ",\n".join(values) if len(values) <= 3 else ""
            rows.append([effect["effect"], session["session"], fitted, number(session["probability"], 2), answer])
    headings = ("effect", "session", "fitted there", "P(the same)", "replicates")
    return [Section("Across sessions", [lead, Sheet(headings, rows)])] if rows else []


def gap_rows(data: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows, by the JSON object of a diagnosis: RMS distances before and after, on the data, less
    outliers, and on rows that no fit has seen, and whether the model holds there."""
    gap, rows, out = data["gap"], data.get("rows"), len(data.get("outlier_rows", ()))
    answers = {True: "yes", False: "no", None: "too few rows"}  # `shrinks`: whether as far as expected stays open
    figures = (number(gap[key]) for key in ("rms_before_mm", "rms_after_mm", "noise_floor_mm"))
    counted = "" if rows is None else f"{rows - out} of {rows}" if out else str(rows)
    shown = [["the data", counted, *figures, ""]]
    for test in tests_of(data):
        kind = "held out" if test["by"] == "holdout" else "cross-validated"
        figures = (number(test[key]) for key in ("before_mm", "after_mm", "predicted_mm"))
        answer = "shrinks" if test["confirmed"] and not test["as_predicted"] else answers[test["confirmed"]]
        shown.append([f"{kind}: {test.get('file') or test['transfer']}", str(test["rows"]), *figures, answer])
    return ["RMS distance [mm]", "rows", "before", "after", "expected", "holds"], shown


def tests_of(data: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What rows that were not used for the fits say: the hold-out, and cross-validation."""
    return ([data["confirmation"]] if data["confirmation"] else []) + list(data["cross_validation"])


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


def gap_section(data: Data, diagnosis: Diagnosis | None = None, nominal: float | None = None) -> Section:
    """How far model and measurements are apart, before and after, and what rows say that no fit has seen."""
    sources = {"repeats": "repeats", "close_repeats": "repeats close in time", "sigma": "sigma_mm"}
    floor = data["gap"]["noise_floor_mm"]
    noise = "the noise, which is not known"
    if floor is not None:
        noise = f"the noise floor {number(floor)} mm, from {sources[data['gap']['noise_floor_from']]}"
    outliers = ", ".join(map(str, data["outlier_rows"]))
    parts: list[Any] = [
        Sheet(*gap_rows(data)),
        "RMS distance between model and measurement, before as armcal identify leaves it. Expected on the data: "
        f"{noise}; on rows that no fit has seen: what the model predicts. A smaller gap alone does not prove a name.",
        *map(holds_in_words, tests_of(data)),
        *(f"Scatter: {scatter_in_words(finding)}." for finding in data["scatter"]),
        *([f"Rows left out as outliers: {outliers}."] if outliers else []),
        *([] if nominal is None else [f"Drawing: {number(nominal)} mm RMS, {DRAWN['base']}."]),
    ]
    if diagnosis is not None:
        parts.append(Pictures(lambda: [_pictures().gap_figure(diagnosis)]))
    return Section("The gap, before and after", parts)


def signed_section(diagnosis: Diagnosis) -> Section:
    """Residuals of the data with their sign, against each joint."""

    def draw() -> Sequence[Any]:
        from identification.documents.pictures import READ, Compared  # deferred: as `_pictures`

        shown, kept = diagnosis.residuals, _pictures().rows_kept(diagnosis)
        named = (*diagnosis.effects, *(curve.key for curve in diagnosis.curves))
        angles = [values for name, values in shown.against.items() if name.startswith("joint ")]
        postures, before, after = (values[kept] for values in (np.column_stack(angles), shown.before, shown.after))
        rows = postures, before, after, shown.conditions.rows(kept)
        compared = Compared(diagnosis.arm, *rows, Model(diagnosis.extended_arm()), named)
        pictures = compared.pictures("the model without what is named", "the model with what is named").draw()
        nothing = f"{READ} Nothing is named: before and after are nearly one model."
        return pictures if named else [nothing, *pictures[1:]]

    return Section("Signed error against each joint", [Pictures(draw)])


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
    pictures = [] if diagnosis is None else [Pictures(lambda: [_pictures().curves_figure(diagnosis)])]
    return [Section("Error curves of joints", [table, text, *pictures])] if rows else []


def further_sections(data: Data, diagnosis: Diagnosis | None = None) -> list[Section]:
    """What was tried, what these postures can show, and notes; folded but where nothing is named."""
    other = {" + ".join(one["effects"]): one["probability"] for one in data["other_sets"]}
    credible = set(data["credible_set"])
    likely = [
        [name, probability_text(p), "yes" if name in credible else ""]
        for name, p in (data["probabilities"] | other).items()
    ]
    trials = [
        [
            t["effect"],
            probability_text(1.0 - t["p_adjusted"]),
            f"{t['f']:.1f}",
            f"{t['p']:.2g}" if t["p"] > 0.0 else "< 1e-300",
            f"{t['delta_bic']:.1f}",
        ]
        for t in data["trials"][:12]
    ]
    tried: list[Any] = [
        "How likely each explanation is, and the strongest effects one at a time against the base model.",
        Sheet(("explanation", "probability", "in the 90 % set"), likely),
        Sheet(("effect", "probability", "F alone", "p", "-2 log odds alone"), trials),
    ]
    alike = [[pair["effect"], pair["like"], f"{pair['likeness']:.3f}"] for pair in data["aliases"]]
    each = [[name, size_in_words(size)] for name, size in data["excluded"].items()]
    pictures = [] if diagnosis is None else [Pictures(lambda: [_pictures().alias_figure(diagnosis.detectability)])]
    excluded = Sheet(("effect", "joints", "found from (90 % power)", "tip [mm]"), excluded_by_kind(data))
    shown: list[Any] = [
        excluded,
        "Effects smaller than these may still be present. Tip: what the largest of them would move it by, RMS over the "
        "rows.",
    ]
    single: list[Any] = [
        Sheet(("effect", "smallest detectable size (90 % power)"), each, "Every joint by itself"),
        Sheet(("effect", "looks like", "likeness"), alike, "Hard to distinguish"),
        *pictures,
    ]
    title = "What these postures can and cannot show"
    sections = [Section("Everything that was tried", tried, folded=True)]
    if data["effects"]:
        sections.append(Section(title, [*shown, *single], folded=True))
    else:
        sections += [Section(title, shown), Section(f"{title}, effect by effect", single, folded=True)]
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

    def at_tip(size: Data) -> float:
        return np.inf if size["value"] is None else size["tip_mm"] or 0.0

    kinds: dict[str, list[tuple[str, Data]]] = {}
    for name, size in data["excluded"].items():
        key, _, setting = name.partition("[")
        kind, _, joint = key.partition(":")
        kinds.setdefault(f"{kind}[{setting}" if setting else kind, []).append((joint, size))
    rows = []
    for kind, sizes in sorted(kinds.items(), key=lambda item: -max(at_tip(size) for _, size in item[1])):
        joints = sorted(int(joint) for joint, _ in sizes if joint)
        ordered = sorted((size for _, size in sizes), key=lambda size: (size["value"] is None, size["value"]))
        least, most = size_in_words(ordered[0]), size_in_words(ordered[-1])
        unit = f" {ordered[-1]['unit']}"
        span = most if least == most else f"{least.removesuffix(unit)} to {most}"
        moved = max(at_tip(size) for _, size in sizes)
        listed = of_joints(joints).removeprefix("joints ").removeprefix("joint ") if joints else "–"
        rows.append([kind, listed, span, number(moved, 3) if np.isfinite(moved) else "any"])
    return rows
