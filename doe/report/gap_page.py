"""A diagnosis as tables for a terminal and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.report.page import Section, Sheet, page
from doe.report.terminal import number, significant, table
from identification.gap.candidate import Candidate, Estimate
from identification.gap.result import Diagnosis
from identification.gap.summary import findings, headline

MOST_TRIALS = 12
LEFT = ("unit", "change")  # columns of words
ANSWERS = {True: "yes", False: "no", None: "too few rows"}


def candidate_sheet(diagnosis: Diagnosis) -> Sheet:
    """The ambiguity set, or what is named beside an unknown effect: how likely, and the tests."""
    rows = [
        [
            c.title.replace(" + ", " +\n"),
            share(c.probability),
            f"{c.delta_bic:.1f}",
            f"{c.f:.1f}",
            p_value(c.p_adjusted),
        ]
        for c in diagnosis.candidates or (diagnosis.named,)
    ]
    return Sheet(["effects", "probability", "Delta BIC", "F", "adjusted p"], rows)


def estimate_sheet(candidate: Candidate) -> Sheet:
    """The parameters of its effects with 95 % intervals, named with their settings."""
    rows = [
        [f"{label}.{p.short}", *(significant(figure, p.std) for figure in (p.value, p.low_95, p.high_95)), _unit(p)]
        for label, found in candidate.estimates.items()
        for p in found
    ]
    return Sheet(["parameter", "value", "low 95 %", "high 95 %", "unit"], rows)


def _unit(estimate: Estimate) -> str:
    return "" if estimate.unit == "1" else estimate.unit


def estimate_sheets(diagnosis: Diagnosis) -> list[tuple[str, Sheet]]:
    """Title and table of estimates of each candidate."""
    several = len(diagnosis.candidates) > 1
    found = [(c, estimate_sheet(c)) for c in diagnosis.candidates or (diagnosis.named,)]
    return [(f"Estimates: {c.title}" if several else "Estimates", sheet) for c, sheet in found if sheet.rows]


def share(p: float | None) -> str:
    """`0.93`; a probability that is not zero is shown as none."""
    return "< 0.01" if p is not None and 0.0 < p < 0.005 else number(p, 2)


def p_value(p: float) -> str:
    """`0.012`; a probability below all numbers is no zero."""
    return f"{p:.2g}" if p > 0.0 else "< 1e-300"


def probability_sheet(diagnosis: Diagnosis) -> Sheet:
    """Every explanation that is not unlikely, with those that are no candidates."""
    explanations = diagnosis.probability | {f"unknown: {n}": p for n, p in diagnosis.other_sets.items()}
    credible = set(diagnosis.credible_set)
    rows = [[n, share(p), "yes" if n.removeprefix("unknown: ") in credible else ""] for n, p in explanations.items()]
    return Sheet(["explanation", "probability", "in the 90 % set"], rows)


def gap_sheet(diagnosis: Diagnosis) -> Sheet:
    """RMS distances before and after, on the data and on rows that no fit has seen, and whether it holds there."""
    gap, rows = diagnosis.gap, len(diagnosis.residuals.before)
    shown = [["the data", str(rows), number(gap.rms_before), number(gap.rms_after), number(gap.noise_floor), ""]]
    for test in diagnosis.tests:
        kind = "held out" if test.by == "holdout" else "cross-validated"
        figures = (number(figure) for figure in (test.before, test.after, test.predicted))
        shown.append([f"{kind}: {test.transfer}", str(test.rows), *figures, ANSWERS[test.confirmed]])
    return Sheet(["RMS distance [mm]", "rows", "before", "after", "expected", "holds"], shown)


def gap_text(diagnosis: Diagnosis) -> str:
    """What the figures of the gap mean, and what the rows say that no fit has seen."""
    text = (
        "RMS distance between model and measurement, before as armcal identify leaves it. Expected on the data: the "
        f"{diagnosis.gap.floor}. A smaller gap alone does not prove a name."
    )
    if diagnosis.confirmation is not None:
        text += " Expected on the held-out rows: what the named model predicts."
    return " ".join([text, *(f"The model {test}." for test in diagnosis.tests if test.confirmed is not None)])


def trial_sheet(diagnosis: Diagnosis) -> Sheet:
    """The strongest effects, one at a time against the base model."""
    rows = [
        [t.effect, f"{t.f:.1f}", p_value(t.p_adjusted), f"{t.delta_bic:.1f}"] for t in diagnosis.trials[:MOST_TRIALS]
    ]
    return Sheet(["effect alone", "F", "adjusted p", "change of BIC"], rows)


def excluded_sheet(diagnosis: Diagnosis) -> Sheet:
    """The smallest size of every effect that these data would have shown with 90 % probability."""
    return Sheet(
        ["effect", "smallest detectable size (90 % power)"], [[n, str(size)] for n, size in diagnosis.excluded.items()]
    )


def alias_sheet(diagnosis: Diagnosis) -> Sheet:
    """What looks like what on these postures."""
    return Sheet(["effect", "looks like", "likeness"], [[a, b, f"{c:.3f}"] for a, b, c in diagnosis.aliases])


def curve_sheet(diagnosis: Diagnosis) -> Sheet:
    """The error curves: over which angles, how large, and how sure."""
    rows = [
        [
            curve.key,
            f"{np.degrees(curve.angles[0]):.0f} to {np.degrees(curve.angles[-1]):.0f}",
            f"{np.degrees(np.sqrt(np.mean(curve.error**2))):.2g}",
            f"{np.degrees(np.sqrt(np.mean(curve.std**2))):.2g}",
        ]
        for curve in diagnosis.curves
    ]
    return Sheet(["curve", "angles [deg]", "RMS [deg]", "std [deg]"], rows)


def round_sheet(diagnosis: Diagnosis) -> Sheet:
    """What each round of naming added (+) and took back (-), and the gap that it left."""
    changes = ([*(f"+ {n}" for n in one.added), *(f"- {n}" for n in one.removed)] for one in diagnosis.rounds)
    rows = zip(changes, diagnosis.rounds, strict=True)
    shown = [[str(k), "\n".join(change), number(one.rms)] for k, (change, one) in enumerate(rows, start=1)]
    return Sheet(["round", "change", "left [mm]"], shown)


def diagnosis_tables(diagnosis: Diagnosis) -> list[Any]:
    """Verdict first, then the gap, candidates, and what else a person should know."""
    lines = [*findings(diagnosis), *diagnosis.warnings]
    shown: list[Any] = [Text(headline(diagnosis), style="bold"), *map(Text, lines), as_table(gap_sheet(diagnosis))]
    shown.append(Text(f"expected: {diagnosis.gap.floor} on the data; elsewhere what the model predicts"))
    shown += [Text(str(test)) for test in diagnosis.tests if test.confirmed is False]
    shown += effect_tables(diagnosis) if diagnosis.effects else [as_table(excluded_sheet(diagnosis))]
    shown.append(Text(diagnosis.likely))
    if len(diagnosis.rounds) > 1:
        shown.append(as_table(round_sheet(diagnosis), "Named in rounds"))
    shown += [Text(f"scatter: {finding}") for finding in diagnosis.scatter]
    if diagnosis.outlier_rows:
        shown.append(Text(f"left out as outliers: rows {', '.join(map(str, diagnosis.outlier_rows))}"))
    if diagnosis.replication:
        shown.append(as_table(replication_sheet(diagnosis), "Sessions"))
    return [*shown, *(Text(f"note: {note}") for note in diagnosis.notes)]


def effect_tables(diagnosis: Diagnosis) -> list[Any]:
    """What is named: the tests, the estimates, the curves."""
    shown: list[Any] = [as_table(candidate_sheet(diagnosis))]
    shown += [as_table(sheet, title) for title, sheet in estimate_sheets(diagnosis)]
    shown.append(Text(f"95 % intervals: {diagnosis.named.reliance}"))
    if diagnosis.curves:
        shown.append(as_table(curve_sheet(diagnosis), "Error curves"))
        shown += [Text(f"joint {curve.joint}: {curve.shape}") for curve in diagnosis.curves]
    return shown


def replication_sheet(diagnosis: Diagnosis) -> Sheet:
    """Each named effect in each session, and whether the values of the other sessions hold there."""
    words = {True: "yes", False: "no", None: "open"}
    rows = [
        [effect.effect, there.session, effect.figures(there), f"{100.0 * there.explained:.1f} %", words[there.returns]]
        for effect in diagnosis.replication
        for there in effect.sessions
    ]
    return Sheet(("effect", "session", "fitted there", "explained by the others' values", "replicates"), rows)


def as_table(sheet: Sheet, title: str | None = None) -> Table:
    """The same sheet for a terminal."""
    return table(sheet.headings, sheet.rows, title, left=[sheet.headings[0], *LEFT])


def curve_sections(diagnosis: Diagnosis) -> list[Section]:
    """The part about error curves of joints, where there are any."""
    if not diagnosis.curves:
        return []
    from doe.report.gap_figures import curves_figure

    text = (
        "Real less commanded angle over the angles measured, with a 95 % band; zero outside. Dots: what groups of rows "
        "say, with everything else in the model."
    )
    plain = curve_sheet(diagnosis)
    rows = [[*row, curve.shape] for row, curve in zip(plain.rows, diagnosis.curves, strict=True)]
    sheet = Sheet([*plain.headings, "shape"], rows)
    return [Section("Error curves of joints", text, [sheet], [curves_figure(diagnosis)])]


def gap_sections(diagnosis: Diagnosis) -> Sequence[Section]:
    """The parts of the page that show a diagnosis."""
    # deferred: tables need no pictures, and matplotlib takes longer to load than a small diagnosis
    from doe.report.gap_figures import against_figure, alias_figure, workspace_figure

    notes = ["Sizes of effects that would have been found, and effects that are hard to distinguish."]
    if diagnosis.outlier_rows:
        notes.append(f"Rows left out as outliers: {', '.join(map(str, diagnosis.outlier_rows))}.")
    found = [*diagnosis.warnings, *(f"scatter: {finding}" for finding in diagnosis.scatter), *diagnosis.notes]
    notes += [f"{text[:1].upper()}{text[1:]}." for text in found]
    estimates = [sheet for _, sheet in estimate_sheets(diagnosis)]
    candidates = [candidate_sheet(diagnosis), *estimates] if diagnosis.effects else []
    return [
        Section(
            "What is missing",
            "Every explanation within 6 BIC units of the best one; a single row means a single explanation.",
            [*candidates, probability_sheet(diagnosis), trial_sheet(diagnosis)],
        ),
        *sessions_section(diagnosis),
        Section(
            "The gap",
            gap_text(diagnosis),
            [gap_sheet(diagnosis)],
            [workspace_figure(diagnosis)],
        ),
        *curve_sections(diagnosis),
        Section(
            "Residuals before and after",
            "Points: rows. Lines: RMS in groups of rows. What is explained is flat after, at the noise floor.",
            (),
            [against_figure(diagnosis)],
        ),
        Section(
            "What these postures can and cannot show",
            " ".join(notes),
            [excluded_sheet(diagnosis), alias_sheet(diagnosis)],
            [alias_figure(diagnosis.detectability)],
        ),
    ]


def sessions_section(diagnosis: Diagnosis) -> list[Section]:
    """What each named effect is in each session, where there are several."""
    lead = (
        "Every session has a base of its own, everything else is shared. Fitted there: the effect's values from this "
        "session alone. Explained: the share of the session's squares that the values of the other sessions explain, "
        "with only the base of this one adapted. An effect replicates where that is more than chance."
    )
    return [Section("Across sessions", lead, [replication_sheet(diagnosis)])] if diagnosis.replication else []


def gap_page(diagnosis: Diagnosis) -> str:
    """The page of `armcal diagnose --report`."""
    return page(f"Gap report: {diagnosis.arm.name}", diagnosis.sentence, gap_sections(diagnosis))
