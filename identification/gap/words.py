"""A diagnosis in words: the verdict in one line, the evidence, caveats; as text, and as tables for a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.arrays import rows_in_words
from identification.gap.blocks import REST
from identification.gap.posterior import MOST_ROWS
from identification.gap.replication import replication_clauses
from identification.html_tables import html_folded, html_lines, html_table, in_symbols
from identification.inspection.data_checks import gap_notes
from identification.measurements import Measurements, distances
from identification.numbers_in_text import number, to_significant_digits
from identification.status import Status

if TYPE_CHECKING:
    from identification.gap.detectability import OrderRange
    from identification.gap.fit import Fit
    from identification.gap.posterior import Posterior
    from identification.gap.result import Candidate, Diagnosis

# reason: identification/README.md, "Constants"
SHORT = 60  # characters of names that a verdict spells out; the tables have all of them
KINDS = {
    "time": "smooth in time",
    "workspace": "smooth over the workspace",
    "wobble": "tilt or shift across the axis",
    "shared": "depends on other joints too",
    "history": "depends on the direction of approach",
    REST: "many small effects",
}


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
        beside = f" + {title}" if result.effects else ""
        fits = f"no effect in the library fits; {curves}{beside} describe the errors"
        verdict = f"cause unknown ({where} first): {fits}"
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


def of_joints(joints: Sequence[int]) -> str:
    """`joint 2`, `joints 1 and 3`, `joints 1 to 5`."""
    if len(joints) == 1:
        return f"joint {joints[0]}"
    if len(joints) > 2 and list(joints) == list(range(joints[0], joints[-1] + 1)):
        return f"joints {joints[0]} to {joints[-1]}"
    return f"joints {', '.join(map(str, joints[:-1]))} and {joints[-1]}"


def findings(result: Diagnosis, *, orders: bool = True) -> list[str]:
    """Findings that belong to the verdict, one clause each;  orders : those about waves of undetermined order too"""
    shape = [f"its shape: {result.shape}"] if result.shape and not described(result) else []
    over = result.misfit is not None and result.misfit.significant
    scatter = [f"scatter {result.misfit.ratio:.3g} x sigma_mm, not explained"] if result.misfit and over else []
    return [
        *shape,
        *scatter,
        *replication_clauses(result.replication),
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


def evidence(result: Diagnosis) -> list[str]:
    """The probabilities, properties of the noise, outliers, and what returns in other sessions."""
    out = [f"left out as outliers: rows {', '.join(map(str, result.outlier_rows))}"] if result.outlier_rows else []
    return [result.likely, *(f"scatter: {one}" for one in result.scatter), *out, *map(str, result.replication)]


def text(result: Diagnosis) -> str:
    """The whole diagnosis as text."""
    lines = [*(f"warning: {warning}" for warning in result.warnings), *findings(result)]
    lines += [str(result.gap), *map(str, result.tests)]
    for one in explanations(result):
        probability = "" if one.probability is None else f"probability {one.probability:.2f}, "
        lines.append(f"{one.title}: {probability}F = {one.f:.1f}, -2 log odds = {one.delta_bic:.1f}")
        # a curve has no parameters
        lines += [f"  {label}: {', '.join(map(str, figures))}" for label, figures in one.estimates.items() if figures]
        lines += [f"  95 % intervals: {one.reliance}"] if one.parameters else []
    lines += evidence(result)
    lines += [] if result.effects else [f"excluded: {name} > {size}" for name, size in result.excluded.items()]
    return "\n".join([headline(result), *(f"  {line}" for line in (*lines, *(f"note: {n}" for n in result.notes)))])


def explanations(result: Diagnosis) -> list[Candidate]:
    """The candidates, or what is named beside something unknown."""
    return [one for one in result.candidates or (result.named,) if one.effects]


def html(result: Diagnosis) -> str:
    """The whole diagnosis as HTML: verdict, gap and what is named as tables, everything else behind a fold."""
    sets = explanations(result)
    parts = [
        html_lines(map(in_symbols, [headline(result), *result.warnings]), strong=True),
        html_lines(map(in_symbols, findings(result))),
        html_table(*gap_rows(result.to_json())),
        html_lines([f"expected: {result.gap.floor} on the data; elsewhere what the model predicts"]),
    ]
    if sets:
        # what curves describe is no name, and has no probability
        shares = ["-" if described(result) else number(one.probability, 2) for one in sets]
        rows = [[one.title, p, f"{one.f:.1f}", f"{one.delta_bic:.1f}"] for one, p in zip(sets, shares, strict=True)]
        parts.append(html_table(("effects", "probability", "F", "-2 log odds"), rows))
    for one in (one for one in sets if one.parameters):
        rows = [
            [f"{label}.{p.short}", *(to_significant_digits(x, p.std) for x in (p.value, p.low_95, p.high_95)), p.unit]
            for label, figures in one.estimates.items()
            for p in figures
        ]
        parts.append(html_lines([f"Estimates of {one.title}:"]) if len(sets) > 1 else "")
        parts.append(html_table(("parameter", "value", "95 % low", "95 % high", "unit"), rows))
        parts.append(html_lines([f"95 % intervals: {one.reliance}"]))
    parts.append(html_lines(map(in_symbols, evidence(result))))
    if not result.effects:
        sizes = html_table(
            ("effect", "smallest size that would have been found"),
            [[name, str(size)] for name, size in result.excluded.items()],
        )
        parts.append(html_folded("Sizes that are excluded", sizes))
    return "".join([*parts, html_folded("Notes", html_lines(result.notes))])


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


def notes(
    result: Diagnosis, posterior: Posterior, measurements: Measurements, best: Fit, holdout: Measurements | None
) -> list[str]:
    """Sentences to read before the verdict is trusted;  best : fit of the likeliest set"""
    listed = []
    for effect in result.effects:
        waves = [(like, share) for key, like, share in result.aliases if key == effect and "[" in like]
        if waves:
            same = waves[0][1] > 0.9999  # the odds stay below 20 up to lambda = 173
            word = "cannot be distinguished from" if same else "is hard to distinguish from"
            rest = f" and {len(waves) - 3} more" if len(waves) > 3 else ""
            likes = f"{', '.join(like for like, _ in waves[:3])}{rest}"
            listed.append(f"at these postures {effect} {word} {likes}; to decide, measure at other joint angles")
    if result.curves:
        spans = [np.degrees([curve.angles[0], curve.angles[-1]]) for curve in result.curves]
        ranges = [f"joint {c.joint} {a:.0f} to {b:.0f} deg" for c, (a, b) in zip(result.curves, spans, strict=True)]
        beyond = "where a joint is beyond them, the model is without curves, with the geometry that was fitted alone"
        listed.append(f"the error curves hold for the angles measured ({', '.join(ranges)}); {beyond}")
    if any(test.shrinks is False and test.after > test.before for test in result.cross_validation[:1]):
        listed.append("other rows are predicted better by the geometry alone: that is what --out writes")
    listed += untested(posterior.library.skipped)
    if len(measurements) > MOST_ROWS:
        searched = f"{MOST_ROWS} of the {len(measurements)} rows, taken at random"
        listed.append(f"effects were looked for in {searched}; what was found is fitted to all")
    if best.status is not Status.converged:
        listed.append(f"the fit of the best model did not converge: {best.status.value}")
    if measurements.directions is None:
        listed += ["directions of approach were derived from the order of measurement", *gap_notes(measurements)]
    for j in np.flatnonzero(np.ptp(measurements.postures, axis=0) == 0.0).tolist():
        first = "its offset cannot be separated from the orientation of the base"
        link = f"the parameters of link {j + 1} cannot be separated from those of link {j}" if j else first
        listed.append(f"joint {j + 1} does not move in these data: {link}")
    if result.misfit is not None and measurements.sigma is None and not 0.67 < result.misfit.ratio < 1.5:
        of_file = f"{result.misfit.ratio:.3g} times the sigma_mm of the arm file"
        listed.append(f"the residual scatter is {of_file}; the tests use the scatter, not sigma_mm")
    after, predicted = result.gap.held_out_after, result.gap.predicted
    if after is not None and predicted is not None and after > 3.0 * predicted:
        times = f"{after / predicted:.2g} times larger than predicted"
        listed.append(f"the held-out residuals are {times}: other postures or set-up?")
    if once := [h.key for h in posterior.best.effects if h.effect.once]:
        which = f"{', '.join(once)}: of this session only; the extended model has what is left of it at the end, as"
        listed.append(f"{which} validate and compensate take it")
    if holdout is not None and any("drift" in h.key for h in posterior.best.effects):
        listed.append("a drift of one session does not carry over to another; confirm it on held-out rows of this one")
    if rows := [k - 1 for k in result.unexplained_rows]:
        far = f"up to {distances(result.residuals.after)[rows].max():.3g} mm off"
        which = rows_in_words(np.isin(np.arange(len(measurements)), rows))
        listed.append(f"{which} are not explained ({far}); they stay in, as whole postures or neighbors")
    return listed
