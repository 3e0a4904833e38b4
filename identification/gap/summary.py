"""Present a diagnosis as text: the verdict in one line, then the evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from identification.gap.order_range import order_clauses
from identification.gap.replication import replication_clauses

if TYPE_CHECKING:
    from identification.gap.candidate import Candidate
    from identification.gap.result import Diagnosis

SHORT = 60  # characters of names that a verdict spells out; the tables have all of them
VERDICTS = {
    "none": "none: no missing effect is detectable; effects larger than the sizes listed are excluded",
    "named": "named: {effects} missing from the model",
    "ambiguous": "ambiguous: {count} explanations fit about equally well{options}; measure more postures",
    "likeliest": "ambiguous: {effects} likeliest, but less likely than not; measure more postures",
    "unknown": "unknown: something outside the library, {where}{beside}",
}


def headline(found: Diagnosis) -> str:
    """The verdict alone, preceded by `not confirmed`, and by how the model compares with the geometry alone where it is
    no better."""
    likeliest = sorted(found.candidates, key=lambda c: -(c.probability or 0.0))
    options = " | ".join(f"{c.title} {c.probability or 0.0:.2f}" for c in likeliest)
    options = options if len(options) <= SHORT else " | ".join(c.title for c in likeliest)
    alone = found.verdict == "ambiguous" and len(found.candidates) == 1
    verdict = VERDICTS["likeliest" if alone else found.verdict].format(
        effects=f"{named(found)} {'is' if len(found.effects) == 1 else 'are'}",
        count=len(found.candidates),
        options=f" ({options})" if len(options) <= SHORT else "",
        where=place(found),
        beside=f", beside {named(found)}" if found.effects else "",
    )
    if found.verdict == "unknown" and described(found):
        fits = f"no effect in the library fits; {describing(found)} describe the errors"
        verdict = f"cause unknown ({place(found)} first): {fits}"
    if found.offered is not None and not found.offered.better:
        verdict = f"{found.offered.sentence}; {verdict}"
    return f"not confirmed: {verdict}" if found.confirmed is False else verdict


def described(found: Diagnosis) -> bool:
    """Whether an error curve describes the unknown effect: its size and shape are known, its cause is not."""
    return (found.where, found.shape) in {(f"joint:{curve.joint}", curve.shape) for curve in found.curves}


def among(found: Diagnosis) -> str:
    """What the probabilities leave open: names that are shapes rather than causes, and rows too few for a test."""
    shapes = ["among the library's shapes, whatever makes them"] if found.effects and found.shapes else []
    few = found.effects and found.tests and all(test.confirmed is None for test in found.tests)
    said = [*shapes, *(["too few rows to confirm it on others"] if few else [])]
    return f" ({'; '.join(said)})" if said else ""


def place(found: Diagnosis) -> str:
    """Place of the unknown effect: `joint 3`, `time`."""
    return (found.where or "a place that is not known").replace(":", " ")


def named(found: Diagnosis) -> str:
    """The effects of the best set, or their number if the list is long."""
    title = " + ".join(found.effects)
    return title if len(title) <= SHORT or len(found.effects) <= 1 else f"{len(found.effects)} effects"


def describing(found: Diagnosis) -> str:
    """Error curves by their joints, and the effects beside them."""
    curves = f"error curves of {of_joints([curve.joint for curve in found.curves])}"
    return " + ".join([curves, *([named(found)] if found.effects else [])])


def of_joints(joints: Sequence[int]) -> str:
    """`joint 2`, `joints 1 and 3`, `joints 1 to 5`."""
    if len(joints) == 1:
        return f"joint {joints[0]}"
    if len(joints) > 2 and list(joints) == list(range(joints[0], joints[-1] + 1)):
        return f"joints {joints[0]} to {joints[-1]}"
    return f"joints {', '.join(map(str, joints[:-1]))} and {joints[-1]}"


def findings(found: Diagnosis, *, orders: bool = True) -> list[str]:
    """Findings that belong to the verdict, one clause each;  orders : those about waves of undetermined order too"""
    shape = [f"its shape: {found.shape}"] if found.shape and not described(found) else []
    return [
        *shape,
        *unexplained(found),
        *replication_clauses(found.replication),
        *(order_clauses(found.shapes) if orders else []),
    ]


def sentence(found: Diagnosis) -> str:
    """The verdict with its findings in one line."""
    return "; ".join([headline(found), *findings(found)])


def unexplained(found: Diagnosis) -> list[str]:
    """A clause about residuals significantly larger than the given sigma, if they are."""
    if found.misfit is None or not found.misfit.significant:
        return []
    return [f"scatter {found.misfit.ratio:.3g} x sigma_mm, not explained"]


def rests_on(found: Diagnosis) -> list[str]:
    """Evidence for the verdict: the gap, the tests on other rows, properties of the noise, and outliers."""
    lines = [str(found.gap), *map(str, found.tests)]
    lines += [f"scatter: {finding}" for finding in found.scatter]
    if found.outlier_rows:
        lines.append(f"left out as outliers: rows {', '.join(map(str, found.outlier_rows))}")
    return lines


def candidate_lines(candidate: Candidate) -> list[str]:
    """Test statistics and estimates of a candidate, one line each."""
    likely = "" if candidate.probability is None else f"probability {candidate.probability:.2f}, "
    figures = f"{likely}F = {candidate.f:.1f}, -2 log odds = {candidate.delta_bic:.1f}"
    stated = {label: found for label, found in candidate.estimates.items() if found}  # a curve has no parameters
    estimates = [f"  {label}: {', '.join(map(str, found))}" for label, found in stated.items()]
    sure = [f"  95 % intervals: {candidate.reliance}"] if stated else []
    return [f"{candidate.title}: {figures}", *estimates, *sure]


def text(found: Diagnosis) -> str:
    """The whole diagnosis as text."""
    lines = [f"warning: {w}" for w in found.warnings] + findings(found) + rests_on(found)
    for candidate in found.candidates or (found.named,):
        lines += candidate_lines(candidate) if candidate.effects else []
    return "\n".join([headline(found), *(f"  {line}" for line in (*lines, *remarks(found)))])


def remarks(found: Diagnosis) -> list[str]:
    """Further lines: probabilities, replication, sizes excluded if nothing is named, and notes."""
    lines = [found.likely, *map(str, found.replication)]
    if not found.effects:
        lines += [f"excluded: {name} > {size}" for name, size in found.excluded.items()]
    return [*lines, *(f"note: {note}" for note in found.notes)]
