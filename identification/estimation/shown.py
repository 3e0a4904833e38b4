"""An identification as text and as tables of a notebook."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from identification.document import Document, Facts, Sheet
from identification.numbers_in_text import number, to_significant_digits

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


def misfit_sentence(fit: Identification, p_value: float, times: float) -> str:
    """That chi2 rejects the model or the sigma given, and what follows; times : residuals in units of that sigma."""
    figures = f"chi2 {fit.chi2:.4g}, {fit.dof} degrees of freedom, {p_value_in_words(p_value)}"
    prior = "the prior does not hold (above), " if fit.contradictions else ""
    cause = f"{prior}the model is incomplete or sigma_mm too small"
    relied = fit.uncertainty.kind == "given"
    follows = "rely on sigma_mm and are too narrow" if relied else "do not rely on sigma_mm"
    do = "settle the prior first" if fit.contradictions else "armcal diagnose looks for what is missing"
    shown = f"{times:{'.3g' if times < 1000.0 else '.0f'}}"
    scatter = f"{MISFIT} {shown} times sigma_mm = {fit.sigma:.4g} ({figures})"
    return f"{scatter}: {cause}. The intervals {follows}; {do}"


def document(fit: Identification) -> Document:
    """All of it: the parameters, rounded by their standard deviations, and what else was found."""
    rows = [
        [name, *(to_significant_digits(row[key], row["std"]) for key in COLUMNS), row["unit"]]
        for name, row in zip(fit.shown_names, fit.rows(), strict=True)
    ]
    open_ones = [("not identifiable", combination) for combination in fit.not_identifiable]
    return Document("Identification", [], [Sheet(HEADINGS, rows), Facts([*open_ones, *facts(fit)])], (), fit.warnings)


def facts(fit: Identification) -> list[tuple[str, str | None]]:
    """What, and what is said of it: how the fit ended, errors before and after, what it promises, sigma, intervals."""
    origin = "given" if fit.sigma_known else "estimated"
    sigma = "unknown" if fit.sigma is None else f"{fit.sigma:.4g} mm per axis ({origin})"
    chi2 = None if fit.p_value is None else f"{fit.chi2:.4g}, {p_value_in_words(fit.p_value)}"
    doubt = "; but chi2 says that it is not" if fit.misfit else ""
    tip = None
    if fit.expected_tip is not None:
        measured = f"{fit.expected_tip_measured:.4g} mm at the tip at postures like those measured"
        tip = f"{measured}, {fit.expected_tip:.4g} mm over the joint limits (RMS), if the model is right{doubt}"
    angles = None if fit.rms_angles is None else "{:.4g} -> {:.4g} deg".format(*np.degrees(fit.rms_angles))
    return [
        ("method", f"{fit.method}: {fit.outcome}"),
        ("RMS", f"{fit.rms_before:.4g} -> {fit.rms_after:.4g} mm"),
        ("largest", f"{fit.max_before:.4g} -> {fit.max_after:.4g} mm"),
        ("orientations, RMS", angles),
        ("expected error", tip),
        ("sigma", f"{sigma}, {fit.dof} degrees of freedom"),
        ("chi2", chi2 and f"{chi2}: the residuals scatter {number(fit.scatter, 5)} mm"),
        ("95 % intervals", fit.uncertainty.sentence),
    ]
