"""The inspection of measurements as tables for a terminal (rich)."""

from __future__ import annotations

from typing import Any

from rich.text import Text

from doe.report.terminal import facts, number, table
from identification.inspection.inspection import Inspection
from identification.validate import DRAWN


def inspection_tables(found: Inspection, arm: str, data_file: str) -> list[Any]:
    """Problems first, then the facts, the range of each joint, what the data cannot say, and the next command."""
    data = found.to_json()
    shown: list[Any] = [Text(_head(found), style="bold"), *(Text(f"  - {sentence}") for sentence in found.problems)]
    if (counting := found.readings.counting) is not None and set(found.readings.sentences) & set(found.problems):
        shown.append(
            Text("If the controller counts that way, the arm file may say so, and data and commands stay its:")
        )
        shown += [Text(f"    {line}") for line in counting.toml.splitlines()]
    lines = [
        ("rows", f"{found.rows} rows, {found.postures} postures"),
        ("columns besides", ", ".join(found.given) or "none"),
    ]
    if found.sessions:
        lines.append(("sessions", ", ".join(found.sessions)))
    if found.markers:
        lines.append(("measured points", ", ".join(found.markers)))
    if found.floor.source is not None:
        lines.append(("repeats scatter by", f"{found.floor.value:.4g} mm"))
    if found.other_units:
        return [*shown, facts(lines)]
    lines.append(("drawing", f"{number(found.drawing)} mm RMS, {DRAWN['base']}"))
    lines.append(("a fit leaves", f"{number(data['rms_fitted_mm'])} mm RMS"))
    lines += _enough(found)
    rows = [
        [
            str(j.joint),
            *(f"{j.in_file_units(x):.2f}" for x in (j.low, j.high)),
            *(f"{j.in_file_units(x):.2f}" if j.limited else "none" for x in (j.limit_low, j.limit_high)),
            j.unit,
            str(j.outside),
        ]
        for j in found.joints
    ]
    headings = ("joint", "from", "to", "lower limit", "upper limit", "unit", "rows outside")
    shown += [facts(lines), table(headings, rows, "Joints", left=("unit",))]
    shown += [Text(f"note: {note}") for note in found.notes]
    if found.sag is not None and found.sag.recommended:
        shown += ["", *(Text(line) for line in found.sag.lines), ""]
    return [*shown, *_next(found, f"{arm} {data_file}")]


def _enough(found: Inspection) -> list[tuple[str, str]]:
    """What a fit determines, and how well; of data that are to be put right only how many numbers there are."""
    if (enough := found.enough) is None:
        return []
    lines = [("such a fit", enough.count)]
    if found.problems:
        return lines
    lines.append(("determines", "; ".join(enough.found) or "nothing by itself"))
    weak = [f"{name} (std {std:{'.3g' if std < 1000.0 else '.0f'}} {unit})" for name, std, unit in enough.weak]
    lines += [("only weakly", "; ".join(weak))] if weak else []
    lines += [("does not", "; ".join(enough.open))] if enough.open else []
    return [*lines, ("accuracy", enough.accuracy)]


def _head(found: Inspection) -> str:
    """What the data are like, in a line."""
    if found.problems:
        return "Fix these first:"
    few = found.enough is not None and found.enough.few
    return f"No problems found in these data{', but they are few for a fit' if few else ''}."


def _next(found: Inspection, files: str) -> list[str]:
    said = f"Next: armcal identify {files} --out calibrated.toml, then armcal diagnose {files}"
    return [] if found.problems else [said]
