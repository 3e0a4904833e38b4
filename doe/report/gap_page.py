"""A diagnosis as tables for a terminal and as a page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.report.page import Section, Sheet, page
from doe.report.terminal import number, table
from identification.gap.result import Candidate, Diagnosis, Estimate

MOST_TRIALS = 12
ESTIMATES = "estimates [95 %]"


def candidate_sheet(diagnosis: Diagnosis) -> Sheet:
    """The ambiguity set, or what is named beside an unknown effect: how likely, the tests, 95 % intervals."""
    rows = [
        [
            c.title,
            number(c.probability, 2),
            f"{c.f:.1f}",
            f"{c.p_adjusted:.2g}",
            f"{c.delta_bic:.1f}",
            estimates_text(c),
        ]
        for c in diagnosis.candidates or (diagnosis.named,)
    ]
    headings = ["effects", "probability", "F", "adjusted p", "Delta BIC", ESTIMATES]
    return Sheet(headings, rows)


def probability_sheet(diagnosis: Diagnosis) -> Sheet:
    """Every explanation that is not unlikely, with those that are no candidates."""
    explanations = diagnosis.probability | {f"unknown: {n}": p for n, p in diagnosis.other_sets.items()}
    credible = set(diagnosis.credible_set)
    rows = [
        [n, number(p, 2), "yes" if n.removeprefix("unknown: ") in credible else ""] for n, p in explanations.items()
    ]
    return Sheet(["explanation", "probability", "in the 90 % set"], rows)


def estimates_text(candidate: Candidate) -> str:
    """`a = 0.061 [0.052, 0.071] deg, ...`; of several effects a line for each, with its label."""
    several = len(candidate.effects) > 1
    rows = ((label, ", ".join(map(estimate_text, found))) for label, found in candidate.estimates.items() if found)
    return "\n".join(f"{label}: {text}" if several else text for label, text in rows)


def estimate_text(estimate: Estimate) -> str:
    """`a = 0.061 [0.052, 0.071] deg`."""
    unit = "" if estimate.unit == "1" else f" {estimate.unit}"
    return f"{estimate.short} = {estimate.value:.4g} [{estimate.low_95:.4g}, {estimate.high_95:.4g}]{unit}"


def gap_sheet(diagnosis: Diagnosis) -> Sheet:
    """RMS distances before and after, on the data and on data no fit has seen."""
    gap = diagnosis.gap
    rows = [["the data", number(gap.rms_before), number(gap.rms_after), number(gap.noise_floor)]]
    if gap.held_out_after is not None:
        rows.append(["held out", number(gap.held_out_before), number(gap.held_out_after), number(gap.predicted)])
    return Sheet(["RMS distance [mm]", "before", "after", "expected"], rows)


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
        [t.effect, f"{t.f:.1f}", f"{t.p_adjusted:.2g}", f"{t.delta_bic:.1f}"] for t in diagnosis.trials[:MOST_TRIALS]
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
    """The error curves: over which angles, how large, how sure, and what they look like."""
    rows = [
        [
            curve.key,
            f"{np.degrees(curve.angles[0]):.0f} to {np.degrees(curve.angles[-1]):.0f}",
            f"{np.degrees(np.sqrt(np.mean(curve.error**2))):.2g}",
            f"{np.degrees(np.sqrt(np.mean(curve.std**2))):.2g}",
            curve.shape,
        ]
        for curve in diagnosis.curves
    ]
    return Sheet(["curve", "angles [deg]", "RMS [deg]", "standard deviation [deg]", "shape"], rows)


def diagnosis_tables(diagnosis: Diagnosis) -> list[Any]:
    """Verdict first, then candidates, gap, and what else a person should know."""
    effects = candidate_sheet(diagnosis) if diagnosis.effects else excluded_sheet(diagnosis)
    shown: list[Any] = [Text(diagnosis.sentence, style="bold"), *map(Text, diagnosis.warnings)]
    shown += [as_table(gap_sheet(diagnosis)), as_table(effects)]
    shown.append(Text(diagnosis.likely))
    if len(diagnosis.rounds) > 1:
        shown.append(Text("Named in rounds, with the gap each left: " + "; ".join(map(str, diagnosis.rounds)) + "."))
    if diagnosis.effects:
        shown.append(Text(f"95 % intervals: {diagnosis.named.reliance}"))
    if diagnosis.curves:
        shown.append(as_table(curve_sheet(diagnosis)))
    shown += [Text(f"scatter: {finding}") for finding in diagnosis.scatter]
    if diagnosis.outlier_rows:
        shown.append(Text(f"left out as outliers: rows {', '.join(map(str, diagnosis.outlier_rows))}"))
    shown += [Text(str(test)) for test in diagnosis.tests]
    if diagnosis.replication:
        shown.append(as_table(replication_sheet(diagnosis), "Sessions"))
    return [*shown, *(Text(f"note: {note}") for note in diagnosis.notes)]


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
    return table(sheet.headings, sheet.rows, title, left=[sheet.headings[0], ESTIMATES])


def curve_sections(diagnosis: Diagnosis) -> list[Section]:
    """The part about error curves of joints, where there are any."""
    if not diagnosis.curves:
        return []
    from doe.report.gap_figures import curves_figure

    text = (
        "Real less commanded angle over the angles measured, with a 95 % band; zero outside. Dots: what groups of rows "
        "say, with everything else in the model."
    )
    return [Section("Error curves of joints", text, [curve_sheet(diagnosis)], [curves_figure(diagnosis)])]


def gap_sections(diagnosis: Diagnosis) -> Sequence[Section]:
    """The parts of the page that show a diagnosis."""
    # deferred: tables need no pictures, and matplotlib takes longer to load than a small diagnosis
    from doe.report.gap_figures import against_figure, alias_figure, workspace_figure

    notes = ["Sizes of effects that would have been found, and effects that are hard to distinguish."]
    if diagnosis.outlier_rows:
        notes.append(f"Rows left out as outliers: {', '.join(map(str, diagnosis.outlier_rows))}.")
    notes += [f"{w}." for w in diagnosis.warnings]
    notes += [*(f"Scatter: {finding}." for finding in diagnosis.scatter), *(f"{n}." for n in diagnosis.notes)]
    candidates = [candidate_sheet(diagnosis)] if diagnosis.effects else []
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
