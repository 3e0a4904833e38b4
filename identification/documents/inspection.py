"""What measurements are like before any fit, as a document."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from identification.document import Document, Sheet, facts_sheet, number
from identification.documents.identification import DRAWN

if TYPE_CHECKING:
    from identification.inspection.inspection import Inspection


def inspection_document(result: Inspection, arm: str, rows: str) -> Document:
    """Problems first, then the facts, the range of each joint, what the data cannot say, and the next command."""
    data, few = result.to_json(), result.enough is not None and result.enough.few
    verdict = f"No problems found in these data{', but they are few for a fit' if few else ''}."
    parts: list[Any] = [f"  - {sentence}" for sentence in result.problems]
    counting = result.readings.counting
    if counting is not None and set(result.readings.sentences) & set(result.problems):
        parts.append("If the controller counts that way, the arm file may say so, and data and commands stay its:")
        parts += [f"    {line}" for line in counting.toml.splitlines()]
    figures: list[tuple[str, str | None]] = [
        ("rows", f"{result.rows} rows, {result.postures} postures"),
        ("columns besides", ", ".join(result.given) or "none"),
        ("sessions", ", ".join(result.sessions)),
        ("measured points", ", ".join(result.markers)),
        ("repeats scatter by", None if result.floor.source is None else f"{result.floor.value:.4g} mm"),
    ]
    if result.other_units:
        return Document("Inspection", ["Fix these first:"], [*parts, facts_sheet(figures)])
    figures.append(("drawing", f"{number(result.drawing)} mm RMS, {DRAWN['base']}"))
    figures.append(("a fit leaves", f"{number(data['rms_fitted_mm'])} mm RMS"))
    if (enough := result.enough) is not None:
        figures.append(("such a fit", enough.count))
        if not result.problems:  # else data that are to be put right would be judged
            weak = [f"{name} (std {std:{'.3g' if std < 1000.0 else '.0f'}} {unit})" for name, std, unit in enough.weak]
            figures.append(("determines", "; ".join(enough.identifiable) or "nothing by itself"))
            figures += [("only weakly", "; ".join(weak)), ("does not", "; ".join(enough.open))]
            figures.append(("accuracy", enough.accuracy))
    joints = []
    for joint in result.joints:
        limits = (
            f"{joint.in_file_units(x):.2f}" if joint.limited else "none" for x in (joint.limit_low, joint.limit_high)
        )
        ranges = (f"{joint.in_file_units(x):.2f}" for x in (joint.low, joint.high))
        joints.append([str(joint.joint), *ranges, *limits, joint.unit, str(joint.outside)])
    headings = ("joint", "from", "to", "lower limit", "upper limit", "unit", "rows outside")
    parts += [facts_sheet(figures), Sheet(headings, joints, "Joints"), *(f"note: {note}" for note in result.notes)]
    if result.sag is not None and result.sag.recommended:
        parts.append("\n".join(["", *result.sag.lines, ""]))
    if result.problems:
        return Document("Inspection", ["Fix these first:"], parts)
    then = f"armcal identify {arm} {rows} --out calibrated.toml, then armcal diagnose {arm} {rows}"
    return Document("Inspection", [verdict], [*parts, f"Next: {then}"])
