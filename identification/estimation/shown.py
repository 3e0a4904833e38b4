"""An identification as text and as tables of a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from identification.html_tables import html_facts, html_lines, html_table, in_symbols
from identification.numbers_in_text import to_significant_digits

if TYPE_CHECKING:
    from identification.estimation.result import Identification

MISFIT = "misfit: the residuals scatter"  # the beginning of that sentence
COLUMNS = ("value", "std", "low_95", "high_95")  # figures of a parameter
HEADINGS = ("parameter", "value", "std", "95 % low", "95 % high", "unit")
UNFINISHED = (
    "the fit stopped at the limit of iterations before it converged: values that the measurements hardly determine may "
    "still move together, and their intervals hold only near where it stopped"
)


def p_value_in_words(p: float) -> str:
    """`p = 0.012`; a p-value that underflows is not shown as zero."""
    return f"p = {p:.3g}" if p > 0.0 else "p < 1e-300"


def misfit_sentence(found: Identification, p_value: float, times: float) -> str:
    """That chi2 rejects the model or the sigma given, and what follows; times : residuals in units of that sigma."""
    figures = f"chi2 {found.chi2:.4g}, {found.dof} degrees of freedom, {p_value_in_words(p_value)}"
    prior = "the prior does not hold (above), " if found.contradictions else ""
    cause = f"{prior}the model is incomplete or sigma_mm too small"
    relied = found.uncertainty.kind == "given"
    follows = "rely on sigma_mm and are too narrow" if relied else "do not rely on sigma_mm"
    do = "settle the prior first" if found.contradictions else "armcal diagnose looks for what is missing"
    shown = f"{times:{'.3g' if times < 1000.0 else '.0f'}}"
    scatter = f"{MISFIT} {shown} times sigma_mm = {found.sigma:.4g} ({figures})"
    return f"{scatter}: {cause}. The intervals {follows}; {do}"


def text(found: Identification) -> str:
    """All of it, for a terminal."""
    name, *figures, unit = HEADINGS
    widths = (12, 10, 12, 12)
    lines = [f"{name:<32} {' '.join(f'{h:>{w}}' for h, w in zip(figures, widths, strict=True))}  {unit}"]
    for name, *cells, unit in table_rows(found):
        lines.append(f"{name:<32} {' '.join(f'{c:>{w}}' for c, w in zip(cells, widths, strict=True))}  {unit}")
    return "\n".join([*found.warnings, *lines, *(f"{name} {said}" for name, said in remarks(found))])


def html(found: Identification) -> str:
    """The same as tables: the parameters, rounded by their standard deviations, and what else was found."""
    rows = [
        [name, *(to_significant_digits(row[key], row["std"]) for key in COLUMNS), row["unit"]]
        for name, row in zip(found.shown_names, found.rows(), strict=True)
    ]
    facts = ((in_symbols(name.removesuffix(":")), in_symbols(said)) for name, said in remarks(found))
    return html_lines(map(in_symbols, found.warnings), strong=True) + html_table(HEADINGS, rows) + html_facts(facts)


def table_rows(found: Identification) -> list[list[str]]:
    """Name, figures and unit of each parameter."""
    rows = zip(found.shown_names, found.rows(), strict=True)
    return [[name, *(_cell(row[key]) for key in COLUMNS), row["unit"]] for name, row in rows]


def remarks(found: Identification) -> list[tuple[str, str]]:
    """What, and what is said of it: parameters not distinguishable, sigma, intervals, errors before and after, and how
    the fit ended."""
    lines = [("not identifiable:", combination) for combination in found.not_identifiable]
    known = "given" if found.sigma_known else "estimated"
    sigma = "unknown" if found.sigma is None else f"{found.sigma:.4g} mm ({known})"
    chi2 = "" if found.p_value is None else f", chi2 {found.chi2:.4g}, {p_value_in_words(found.p_value)}"
    lines.append(("sigma", f"{sigma}, {found.dof} degrees of freedom{chi2}"))
    lines.append(("95 % intervals:", found.uncertainty.sentence))
    lines.append(("RMS", f"{found.rms_before:.4g} -> {found.rms_after:.4g} mm"))
    lines.append(("max", f"{found.max_before:.4g} -> {found.max_after:.4g} mm"))
    if found.expected_tip is not None:
        measured = f"{found.expected_tip_measured:.4g} mm at postures like those measured"
        anywhere = f"{found.expected_tip:.4g} mm over the joint limits (RMS)"
        lines.append(("expected error of the tip", f"{measured}, {anywhere}"))
    if found.rms_angles is not None:
        lines.append(("orientations, RMS", "{:.4g} -> {:.4g} deg".format(*np.degrees(found.rms_angles))))
    return [*lines, (f"{found.method}:", found.outcome)]


def _cell(value: Any) -> str:
    return "-" if value is None else format(value, ".6g")
