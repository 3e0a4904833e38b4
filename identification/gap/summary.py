"""A diagnosis in words: the verdict in one line, then what it rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from identification.estimation.result import in_words as p_in_words
from identification.gap.order_range import in_words
from identification.gap.replication import said

if TYPE_CHECKING:
    from identification.gap.candidate import Candidate
    from identification.gap.result import Diagnosis

SHORT = 60  # characters of names that a verdict spells out; the tables have all of them
VERDICTS = {
    "none": "none: no missing effect is detectable; effects larger than the sizes listed are excluded",
    "named": "named: {effects} missing from the model",
    "ambiguous": "ambiguous: {count} explanations fit about equally well{options}; measure more postures",
    "unknown": "unknown: something outside the library at {where}{beside}",
}


def headline(found: Diagnosis) -> str:
    """The verdict alone, what speaks against it first."""
    options = " | ".join(c.title for c in found.candidates)
    verdict = VERDICTS[found.verdict].format(
        effects=f"{named(found)} {'is' if len(found.effects) == 1 else 'are'}",
        count=len(found.candidates),
        options=f" ({options})" if len(options) <= SHORT else "",
        where=found.where,
        beside=f", beside {named(found)}" if found.effects else "",
    )
    return f"not confirmed: {verdict}" if found.confirmed is False else verdict


def named(found: Diagnosis) -> str:
    """The effects of the best set, or how many they are."""
    title = found.named.title
    return title if len(title) <= SHORT or len(found.effects) == 1 else f"{len(found.effects)} effects"


def findings(found: Diagnosis) -> list[str]:
    """What else must be read with the verdict, a clause for each."""
    shape = [f"its shape: {found.shape}"] if found.shape and not found.curves else []
    return [*shape, *unexplained(found), *said(found.replication), *in_words(found.shapes)]


def sentence(found: Diagnosis) -> str:
    """The verdict with its findings in one line."""
    return "; ".join([headline(found), *findings(found)])


def unexplained(found: Diagnosis) -> list[str]:
    """What is left over the given sigma, where that is more than noise."""
    if found.misfit is None or not found.misfit.significant:
        return []
    return [f"scatter {found.misfit.ratio:.3g} x sigma_mm, not explained"]


def rests_on(found: Diagnosis) -> list[str]:
    """What the verdict rests on: the gap, the rows that were held out, and what the scatter does."""
    lines = [*str(found.gap).splitlines(), *map(str, found.tests)]
    lines += [f"scatter: {finding}" for finding in found.scatter]
    if found.outlier_rows:
        lines.append(f"left out as outliers: rows {', '.join(map(str, found.outlier_rows))}")
    return lines


def candidate_lines(candidate: Candidate) -> list[str]:
    """How well a set of effects explains the data, and its estimates."""
    figures = f"F = {candidate.f:.1f}, {p_in_words(candidate.p_adjusted)}, Delta BIC = {candidate.delta_bic:.1f}"
    stated = {label: found for label, found in candidate.estimates.items() if found}  # a curve has no parameters
    estimates = [f"  {label}: {', '.join(map(str, found))}" for label, found in stated.items()]
    return [f"{candidate.title}: {figures}", *estimates, f"  95 % intervals: {candidate.reliance}"]


def text(found: Diagnosis) -> str:
    """All of it, for a terminal."""
    lines = [f"warning: {w}" for w in found.warnings] + findings(found) + rests_on(found)
    for candidate in found.candidates or (found.named,):
        lines += candidate_lines(candidate) if candidate.effects else []
    lines += [f"round {k}: {one}" for k, one in enumerate(found.rounds, start=1) if len(found.rounds) > 1]
    lines += [found.likely, *map(str, found.replication)]
    if not found.effects:
        lines += [f"excluded: {name} > {size}" for name, size in found.excluded.items()]
    lines += [f"note: {note}" for note in found.notes]
    return "\n".join([headline(found), *(f"  {line}" for line in lines)])
