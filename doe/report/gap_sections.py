"""A diagnosis as sections of a page; what needs no rows can be made from its JSON object alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from doe.report.gap_tables import (
    Data,
    alias_sheet,
    candidate_sheet,
    curve_sheet,
    estimate_sheets,
    excluded_sheet,
    gap_sheet,
    probability_sheet,
    replication_sheet,
    trial_sheet,
)
from doe.report.identification_tables import DH_TABLE, conventions, corrected_sheet, dh_notes
from doe.report.origin import Origin, origin_section
from doe.report.page import Section, Sheet, page
from doe.report.terminal import number
from doe.report.verdict import diagnosis_actions, diagnosis_verdict, expected_elsewhere
from identification.estimation.corrected_values import CorrectedValue, corrected_values
from identification.gap.result import Diagnosis
from identification.gap.scatter import Finding
from identification.gap.words import tests_of
from identification.measurements import Measurements, rms_distance
from identification.model import Model
from identification.validate import DRAWN, drawing_residuals

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def missing_section(data: Data) -> Section:
    """What is named, with its values."""
    if not data["effects"]:
        return Section("What is missing", f"{data['sentence'][:1].upper()}{data['sentence'][1:]}.")
    least = "Every explanation with at least a twentieth of the best one's probability."
    several = least if len(data["candidates"]) > 1 else ""
    text = f"{data['sentence'][:1].upper()}{data['sentence'][1:]}. {several}"
    return Section("What is missing", text, [candidate_sheet(data), *(sheet for _, sheet in estimate_sheets(data))])


def gap_section(data: Data, figures: Sequence[Figure] = (), nominal: float | None = None) -> Section:
    """How far model and measurements are apart, before and after.

    nominal : RMS distance of the drawing [mm]
    """
    lead = [*gap_text(data), *([] if nominal is None else [f"Drawing: {number(nominal)} mm RMS, {DRAWN['base']}."])]
    return Section("The gap, before and after", lead, [gap_sheet(data)], figures)


def gap_text(data: Data) -> list[str]:
    """In paragraphs: what the figures of the gap mean, and what the rows say that no fit has seen."""
    known = {"repeats": "repeats", "close_repeats": "repeats close in time", "sigma": "sigma_mm"}
    floor = data["gap"]["noise_floor_mm"]
    noise = "the noise, which is not known" if floor is None else f"the noise floor {number(floor)} mm"
    source = "" if floor is None else f", from {known[data['gap']['noise_floor_from']]}"
    text = [
        "RMS distance between model and measurement, before as armcal identify leaves it. Expected on the data: "
        f"{noise}{source}; on rows that no fit has seen: what the model predicts. A smaller gap alone does not prove a "
        "name.",
        " ".join(said(test) for test in tests_of(data) if test["confirmed"] is not None),
        " ".join(f"Scatter: {Finding(f['finding'], f['p'], f['size'])}." for f in data["scatter"]),
    ]
    if rows := data["outlier_rows"]:
        text.append(f"Rows left out as outliers: {', '.join(map(str, rows))}.")
    return text


def said(test: Data) -> str:
    """Whether the named model holds in rows that were not used for the fits, in a sentence."""
    how = "" if test["by"] == "holdout" else "cross-validated, "
    which, rows = test.get("file") or test["transfer"], f"{test['rows']} rows in {test['groups']} independent groups"
    where = f"{which} ({how}{rows})"
    if test["confirmed"] and not test["as_predicted"]:
        unsure = f"{rows} are too few to say whether by as much as expected"
        return f"The error shrinks on rows not fitted ({how}{which}); {unsure}."
    if test["confirmed"]:
        return f"The model holds for {where}{': the gap shrinks' if test['shrinks'] else ''}."
    if test["shrinks"]:
        return f"For {where} the gap shrinks, but by less than predicted."
    shrinks = ["the gap does not shrink"] if test["shrinks"] is False else []
    exceeds = ["the gap exceeds the prediction"] if test["as_predicted"] is False else []
    return f"The model does not hold for {where}: {' and '.join(shrinks + exceeds)}."


def further_sections(data: Data, figures: Sequence[Figure] = ()) -> list[Section]:
    """What was tried, and what these postures can show: for those who open it."""
    notes = " ".join(f"{note[:1].upper()}{note[1:]}." for note in data["notes"])
    sizes = "Sizes of effects that would have been found, and effects that are hard to distinguish."
    return [
        Section(
            "Everything that was tried",
            "How likely each explanation is, and the strongest effects one at a time against the base model.",
            [probability_sheet(data), trial_sheet(data)],
            folded=True,
        ),
        Section(
            "What these postures can and cannot show",
            f"{sizes} {notes}",
            [excluded_sheet(data), alias_sheet(data)],
            figures,
            folded=True,
        ),
    ]


def curve_sections(data: Data, figures: Sequence[Figure] = ()) -> list[Section]:
    """The part about error curves of joints, where there are any."""
    if not data["curves"]:
        return []
    text = (
        "Real less commanded angle over the angles measured, with a 95 % band; zero outside. Dots: what groups of rows "
        "say, with everything else in the model."
    )
    plain = curve_sheet(data)
    rows = [[*row, curve["shape"]] for row, curve in zip(plain.rows, data["curves"], strict=True)]
    return [Section("Error curves of joints", text, [Sheet([*plain.headings, "shape"], rows)], figures)]


def sessions_section(diagnosis: Diagnosis) -> list[Section]:
    """What each named effect is in each session, where there are several."""
    lead = (
        "Every session has a base of its own, everything else is shared. Fitted there: the effect's values from this "
        "session alone. P(the same): how likely it is that they are those of the other sessions. An effect replicates "
        "where that is 0.9 or more."
    )
    return [Section("Across sessions", lead, [replication_sheet(diagnosis)])] if diagnosis.replication else []


def signed_section(diagnosis: Diagnosis) -> Section:
    """Residuals of the data with their sign, against each joint."""
    from doe.report.gap_figures import rows_kept
    from doe.report.signed_residuals import READ, Compared, caption, signed_figures

    shown, kept = diagnosis.residuals, rows_kept(diagnosis)
    named = (*diagnosis.effects, *(curve.key for curve in diagnosis.curves))
    postures = np.column_stack([values for name, values in shown.against.items() if name.startswith("joint ")])
    postures, before, after = (values[kept] for values in (postures, shown.before, shown.after))
    model = Model(diagnosis.extended_arm())
    conditions = shown.conditions.rows(kept)
    figures = signed_figures(Compared(diagnosis.arm, postures, before, after, conditions, model, named))
    lead = caption("the model without what is named", "the model with what is named", named)
    lead = lead if named else f"{READ} Nothing is named: before and after are nearly one model."
    return Section("Signed error against each joint", lead, figures=figures)


def corrected_section(
    rows: Sequence[CorrectedValue], spatial: bool, name: str = "", fit: Mapping[str, Any] | None = None
) -> Section:
    """The corrected values to enter in the controller.

    name : of the file that has it;  fit : what `identify` said of it
    """
    expected = expected_elsewhere(fit or {}).strip()
    text = " ".join(
        [*([f"As in {name}."] if name else []), *([expected] if expected else []), *conventions(rows, spatial)]
    )
    return Section(f"Corrected values{f': {name}' if name else ''}", text, [corrected_sheet(rows)])


def dh_section(rows: Sequence[CorrectedValue], lines: Sequence[str], name: str) -> list[Section]:
    """The corrected Denavit-Hartenberg table and the places that belong to it; none without rows.

    name : of the file that has it
    """
    text = [" ".join(dh_notes(rows)), *lines]
    return [Section(f"{DH_TABLE}: {name}", text, [corrected_sheet(rows)])] if rows else []


def doubted(corrected: Section) -> Section:
    """Values that rows speak against which no fit has seen: closed, and said so."""
    return replace(corrected, title=f"{corrected.title}, not confirmed", folded=True)


def gap_sections(diagnosis: Diagnosis, nominal: float | None = None) -> Sequence[Section]:
    """The parts of the page that show a diagnosis.

    nominal : RMS distance of the drawing [mm]
    """
    # deferred: tables need no pictures, and matplotlib takes longer to load than a small diagnosis
    from doe.report.gap_figures import against_figures, alias_figure, curve_figures, workspace_figure

    data, arm = diagnosis.to_json(), diagnosis.extended_arm(diagnosis.named)
    corrected = corrected_section(corrected_values(arm, diagnosis.named.calibration), arm.chain is not None)
    distances = "Distances, without their sign: rows as points, RMS in groups of rows as lines."
    return [
        missing_section(data),
        *sessions_section(diagnosis),
        gap_section(data, [workspace_figure(diagnosis)], nominal),
        doubted(corrected) if data["confirmed"] is False else corrected,
        signed_section(diagnosis),
        *curve_sections(data, curve_figures(diagnosis) if diagnosis.curves else ()),
        Section("Against time and torque", distances, figures=against_figures(diagnosis), folded=True),
        *further_sections(data, [alias_figure(diagnosis.detectability)]),
    ]


def gap_page(
    diagnosis: Diagnosis,
    measurements: Measurements | None = None,
    origin: Origin | None = None,
    written: Path | None = None,
    files: Sequence[Path] = (),
) -> str:
    """The page of `armcal diagnose --report`.

    measurements : that were diagnosed, to see what the drawing leaves of them;  origin : of the page
    written : the extended model, where it is written beside the page
    files : arm and measurements, for the commands of the next steps
    """
    data = diagnosis.to_json()
    nominal = None if measurements is None else rms_distance(drawing_residuals(diagnosis.arm, measurements))
    sections = [*gap_sections(diagnosis, nominal), *([] if origin is None else [origin_section(origin)])]
    arm, *rows = [*map(str, files)] or ["arm.toml"]
    title = f"Gap report: {diagnosis.arm.name or 'arm'}"
    actions = diagnosis_actions(data, arm, rows or ["data.csv"], written)
    return page(title, diagnosis_verdict(data), sections, actions, data["warnings"])
