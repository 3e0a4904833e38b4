"""A diagnosis as tables, for a terminal and for pages: from its JSON object, as `armcal diagnose --json` gives it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from doe.report.page import Sheet
from doe.report.terminal import estimate_text, number, table, unit_or_dash
from identification.gap.detectability import Size
from identification.gap.result import Diagnosis
from identification.gap.words import findings, gap_rows, headline

MOST_TRIALS = 12
LEFT = ("unit", "change", "shape", "joints", "session", "fitted there")  # columns of words


Data = Mapping[str, Any]  # what `armcal diagnose --json` says


def candidate_sheet(data: Data) -> Sheet:
    """The ambiguity set, or what is named beside an unknown effect: how likely, and the tests."""
    rows = [
        [
            " +\n".join(c["effects"]),
            "its cause is unknown" if is_described(data) else share(c["probability"]),
            *(f"{c[k]:.1f}" for k in ("delta_bic", "f")),
        ]
        for c in _explanations(data)
    ]
    return Sheet(["effects", "probability", "-2 log odds", "F"], rows)


def _explanations(data: Data) -> list[Data]:
    return list(data["candidates"]) or [data["named"]]


def estimate_sheet(candidate: Data) -> Sheet:
    """The parameters of its effects with 95 % intervals, named with their settings."""
    labels = {key: label for label in candidate["effects"] for key in (label.partition("[")[0], label)}
    rows = []
    for found in candidate["parameters"]:
        owner, _, short = found["name"].rpartition(".")
        figures = (estimate_text(found[key], found["std"], found["unit"]) for key in ("value", "low_95", "high_95"))
        rows.append([f"{labels.get(owner, owner)}.{short}", *figures, unit_or_dash(found["unit"])])
    return Sheet(["parameter", "value", "low 95 %", "high 95 %", "unit"], rows)


def estimate_sheets(data: Data) -> list[tuple[str, Sheet]]:
    """Title and table of estimates of each candidate."""
    several = len(data["candidates"]) > 1
    found = [(" + ".join(c["effects"]), estimate_sheet(c)) for c in _explanations(data)]
    return [(f"Estimates: {title}" if several else "Estimates", sheet) for title, sheet in found if sheet.rows]


def is_described(data: Data) -> bool:
    """Whether error curves stand for what is unknown: the fitted set is no name for it, and has no probability."""
    return (data["where"], data["shape"]) in {(f"joint:{c['joint']}", c["shape"]) for c in data["curves"]}


def share(p: float | None) -> str:
    """`0.93`; a small probability is never rounded to zero."""
    return "< 0.01" if p is not None and 0.0 < p < 0.005 else number(p, 2)


def p_value(p: float) -> str:
    """`0.012`; a p-value that underflows is not shown as zero."""
    return f"{p:.2g}" if p > 0.0 else "< 1e-300"


def probability_sheet(data: Data) -> Sheet:
    """Every explanation that is not unlikely, with those that are no candidates."""
    other = {" + ".join(found["effects"]): found["probability"] for found in data["other_sets"]}
    credible = set(data["credible_set"])
    rows = [[name, share(p), "yes" if name in credible else ""] for name, p in (data["probabilities"] | other).items()]
    return Sheet(["explanation", "probability", "in the 90 % set"], rows)


def gap_sheet(data: Data) -> Sheet:
    """RMS distances before and after, on the data and on rows that no fit has seen, and whether it holds there."""
    return Sheet(*gap_rows(data))


def trial_sheet(data: Data) -> Sheet:
    """The strongest effects, one at a time against the base model."""
    rows = [
        [t["effect"], share(1.0 - t["p_adjusted"]), f"{t['f']:.1f}", p_value(t["p"]), f"{t['delta_bic']:.1f}"]
        for t in data["trials"][:MOST_TRIALS]
    ]
    return Sheet(["effect", "probability", "F alone", "p", "-2 log odds alone"], rows)


def excluded_sheet(data: Data) -> Sheet:
    """The smallest size of every effect that these data would have shown with 90 % probability."""
    rows = [[name, str(Size(**size))] for name, size in data["excluded"].items()]
    return Sheet(["effect", "smallest detectable size (90 % power)"], rows)


def largest_excluded_sheet(data: Data) -> Sheet:
    """The same for each kind of effect, those first that may move the tip most without being found."""
    kinds: dict[str, list[tuple[str, Size]]] = {}
    for name, size in data["excluded"].items():
        key, _, setting = name.partition("[")
        kind, _, joint = key.partition(":")
        kinds.setdefault(f"{kind}[{setting}" if setting else kind, []).append((joint, Size(**size)))
    sizes = {kind: sorted((size for _, size in found), key=Size.order) for kind, found in kinds.items()}
    order = sorted(kinds, key=lambda kind: -max(_at_tip(size) for size in sizes[kind]))
    rows = [[kind, _joints([joint for joint, _ in kinds[kind]]), *_spans(sizes[kind])] for kind in order]
    return Sheet(["effect", "joints", "found from (90 % power)", "tip [mm]"], rows)


def _at_tip(size: Size) -> float:
    return np.inf if size.value is None else size.tip_mm or 0.0


def _joints(joints: Sequence[str]) -> str:
    """`1 to 6`, `1, 3`; a dash for an effect of the whole arm."""
    numbers = sorted(int(joint) for joint in joints if joint)
    if len(numbers) > 2 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]} to {numbers[-1]}"
    return ", ".join(map(str, numbers)) or "–"


def _spans(sizes: Sequence[Size]) -> tuple[str, str]:
    """Smallest and largest of sizes in order, and what the largest moves the tip by."""
    least, most = sizes[0], sizes[-1]
    span = str(most) if str(least) == str(most) else f"{str(least).removesuffix(f' {most.unit}')} to {most}"
    moved = _at_tip(max(sizes, key=_at_tip))
    return span, number(moved, 3) if np.isfinite(moved) else "any"


def alias_sheet(data: Data) -> Sheet:
    """Effects that are nearly collinear at these postures."""
    rows = [[pair["effect"], pair["like"], f"{pair['likeness']:.3f}"] for pair in data["aliases"]]
    return Sheet(["effect", "looks like", "likeness"], rows)


def curve_sheet(data: Data) -> Sheet:
    """The error curves: over which angles, how large, and how sure."""
    rows = [
        [f"joint_error_curve:{c['joint']}", f"{c['angle_deg'][0]:.0f} to {c['angle_deg'][-1]:.0f}"]
        + [f"{np.sqrt(np.mean(np.square(c[key]))):.2g}" for key in ("error_deg", "std_deg")]
        for c in data["curves"]
    ]
    return Sheet(["curve", "angles [deg]", "RMS [deg]", "std [deg]"], rows)


def curve_shape_sheet(data: Data) -> Sheet:
    """The same with their shapes: waves per turn, strongest first, and their share of the curve."""
    drawn = curve_sheet(data)
    rows = [[str(c["joint"]), *row[1:], shape_in_short(c)] for c, row in zip(data["curves"], drawn.rows, strict=True)]
    return Sheet(["joint", *drawn.headings[1:], "shape"], rows)


def shape_in_short(curve: Data) -> str:
    """`waves 11, 14, 2, 5 (93 %)`; other shapes as they are said, without the angles."""
    said = str(curve["shape"])
    kind, found, _ = said.partition(": ")
    if not found:
        return said.partition(" over ")[0]
    orders = ", ".join(f"{wave['order']:g}" for wave in curve["waves"])
    return f"{kind} {orders} ({100.0 * sum(wave['share'] for wave in curve['waves']):.0f} %)"


def order_sheet(data: Data) -> Sheet:
    """Named waves whose order the angles measured do not determine."""
    rows = [
        [one["effect"], f"{one['range_deg'][1] - one['range_deg'][0]:.0f}", "{} to {}".format(*one["orders"])]
        for one in data["shapes"]
    ]
    return Sheet(["wave", "joint moved over [deg]", "orders that fit"], rows)


def diagnosis_tables(diagnosis: Diagnosis) -> list[Any]:
    """Verdict first, then the gap, candidates, and what else a person should know."""
    data, lines = diagnosis.to_json(), [*findings(diagnosis, orders=False), *diagnosis.warnings]
    shown: list[Any] = [
        Text(headline(diagnosis), style="bold"),
        *map(Text, lines),
        as_table(gap_sheet(data), padding=0),
    ]
    shown.append(Text("before: the geometry fitted, as armcal identify leaves it"))
    shown.append(Text(f"expected: {diagnosis.gap.floor} on the data; elsewhere what the model predicts"))
    shown += [Text(str(test)) for test in diagnosis.tests if test.confirmed is not None and not test.as_predicted]
    shown += effect_tables(diagnosis, data) if diagnosis.effects else excluded_tables(data)
    if diagnosis.curves:
        shown.append(as_table(curve_shape_sheet(data), "Error curves"))
        shown.append(Text("waves: per turn, strongest first, and their share of the curve; --json has their sizes"))
    shown.append(Text(diagnosis.likely))
    shown += [Text(f"scatter: {finding}") for finding in diagnosis.scatter]
    if diagnosis.outlier_rows:
        shown.append(Text(f"left out as outliers: rows {', '.join(map(str, diagnosis.outlier_rows))}"))
    if diagnosis.replication:
        shown.append(
            as_table(narrow_sheet(replication_sheet(diagnosis)), "Sessions", no_wrap=("fitted there",), padding=0)
        )
    return [*shown, *(Text(f"note: {note}") for note in diagnosis.notes)]


def excluded_tables(data: Data) -> list[Any]:
    """What may be missing without having been found, where nothing is named."""
    title = "Effects smaller than these may still be present"
    said = "tip: what the largest of them would move it by, RMS over the rows. Every joint by itself: --json, --report."
    return [as_table(largest_excluded_sheet(data), title), Text(said)]


def effect_tables(diagnosis: Diagnosis, data: Data) -> list[Any]:
    """What is named: the tests, the estimates."""
    shown: list[Any] = [as_table(candidate_sheet(data))]
    shown += [as_table(sheet, title) for title, sheet in estimate_sheets(data)]
    shown.append(Text(f"95 % intervals: {diagnosis.named.reliance}"))
    if data["shapes"]:
        shown.append(as_table(order_sheet(data), "Shapes, not causes: waves of other orders fit as well"))
    return shown


def replication_sheet(diagnosis: Diagnosis) -> Sheet:
    """Each named effect in each session, and whether it is the same there as in the others."""
    words = {True: "yes", False: "no", None: "open"}
    rows = [
        [effect.effect, there.session, effect.figures(there), f"{there.probability:.2f}", words[there.replicates]]
        for effect in diagnosis.replication
        for there in effect.sessions
    ]
    return Sheet(("effect", "session", "fitted there", "P(the same)", "replicates"), rows)


def narrow_sheet(sheet: Sheet) -> Sheet:
    """The sheet of `replication_sheet` for 80 columns: a line for each parameter."""
    return Sheet(sheet.headings, [[*row[:2], row[2].replace(", ", ",\n"), *row[3:]] for row in sheet.rows])


def as_table(sheet: Sheet, title: str | None = None, **style: Any) -> Table:
    """The same sheet for a terminal."""
    return table(sheet.headings, sheet.rows, title, left=[sheet.headings[0], *LEFT], **style)
