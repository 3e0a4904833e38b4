"""A diagnosis as a notebook shows it: verdict, gap and what is named as tables, everything else behind a fold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from identification.gap import summary
from identification.html_tables import html_folded, html_lines, html_table, in_symbols
from identification.numbers_in_text import number, to_significant_digits

if TYPE_CHECKING:
    from identification.gap.candidate import Candidate
    from identification.gap.result import Diagnosis


def html(found: Diagnosis) -> str:
    """The whole diagnosis as HTML."""
    candidates = [c for c in found.candidates or (found.named,) if c.effects]
    sets = ("effects", "probability", "F", "-2 log odds")
    said = [found.likely, *(f"scatter: {finding}" for finding in found.scatter), *map(str, found.replication)]
    if found.outlier_rows:
        said.append(f"left out as outliers: rows {', '.join(map(str, found.outlier_rows))}")
    return "".join(
        [
            html_lines(map(in_symbols, [summary.headline(found), *found.warnings]), strong=True),
            html_lines(map(in_symbols, summary.findings(found))),
            html_table(*gap_rows(found.to_json())),
            html_lines([f"expected: {found.gap.floor} on the data; elsewhere what the model predicts"]),
            html_table(sets, [_figures(found, c) for c in candidates]) if candidates else "",
            *(_estimates(c, several=len(candidates) > 1) for c in candidates if c.parameters),
            html_lines(map(in_symbols, said)),
            *_folded(found),
        ]
    )


def gap_rows(data: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows, by the JSON object of a diagnosis: RMS distances before and after, on the data, less
    outliers, and on rows that no fit has seen, and whether the model holds there."""
    gap, rows, out = data["gap"], data.get("rows"), len(data.get("outlier_rows", ()))
    answers = {True: "yes", False: "no", None: "too few rows"}  # `shrinks`: whether as far as expected stays open
    own = (number(gap[key]) for key in ("rms_before_mm", "rms_after_mm", "noise_floor_mm"))
    counted = "" if rows is None else f"{rows - out} of {rows}" if out else str(rows)
    shown = [["the data", counted, *own, ""]]
    for test in tests_of(data):
        kind = "held out" if test["by"] == "holdout" else "cross-validated"
        figures = (number(test[key]) for key in ("before_mm", "after_mm", "predicted_mm"))
        answer = "shrinks" if test["confirmed"] and not test["as_predicted"] else answers[test["confirmed"]]
        shown.append([f"{kind}: {test.get('file') or test['transfer']}", str(test["rows"]), *figures, answer])
    return ["RMS distance [mm]", "rows", "before", "after", "expected", "holds"], shown


def tests_of(data: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """What rows that were not used for the fits say: the hold-out, and cross-validation."""
    return ([data["confirmation"]] if data["confirmation"] else []) + list(data["cross_validation"])


def _figures(found: Diagnosis, candidate: Candidate) -> list[str]:
    """How likely a candidate is, and its tests; what curves describe is no name, and has no probability."""
    likely = "-" if summary.described(found) else number(candidate.probability, 2)
    return [candidate.title, likely, f"{candidate.f:.1f}", f"{candidate.delta_bic:.1f}"]


def _estimates(candidate: Candidate, several: bool) -> str:
    """The parameters of a candidate;  several : there are others, it is named."""
    rows = [
        [f"{label}.{p.short}", *(to_significant_digits(x, p.std) for x in (p.value, p.low_95, p.high_95)), p.unit]
        for label, estimates in candidate.estimates.items()
        for p in estimates
    ]
    headings = ("parameter", "value", "95 % low", "95 % high", "unit")
    title = html_lines([f"Estimates of {candidate.title}:"]) if several else ""
    return title + html_table(headings, rows) + html_lines([f"95 % intervals: {candidate.reliance}"])


def _folded(found: Diagnosis) -> list[str]:
    """Sizes that are excluded where nothing is named, and notes."""
    sizes = [] if found.effects else [[name, str(size)] for name, size in found.excluded.items()]
    return [
        html_folded(
            "Sizes that are excluded", html_table(("effect", "smallest size that would have been found"), sizes)
        )
        if sizes
        else "",
        html_folded("Notes", html_lines(found.notes)),
    ]
