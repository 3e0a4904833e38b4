"""Assemble the explanation of the data: candidates with probabilities, error curves, fits before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from identification.gap.candidate import Candidate
from identification.gap.candidates import candidate, candidate_list
from identification.gap.curves.curves import Curves, curve_candidate, find_curves
from identification.gap.fits.fit import Fit, fit
from identification.gap.fits.whitening import Rows
from identification.gap.library.library_prior import LibraryPrior
from identification.gap.library.prior_fits import held, held_candidate
from identification.gap.probability.agreement import agreeing
from identification.gap.probability.probabilities import Probabilities, probabilities
from identification.gap.selection.search import Choice
from identification.gap.workflow import Findings
from identification.measurements import Measurements
from identification.model import Model
from identification.progress import Tell, say_nothing


@dataclass(frozen=True)
class Explanation:
    """The effects that explain the data best.

    found : findings, with the noise model that applies if there are error curves
    chosen : effects of the best set other than curves;  candidates, named : ambiguity set, and best set
    fit : of the best set, without a prior;  likely : probabilities of all explanations
    smooth : error curves, None without;  prior : of the further effects in `Fits`, None without
    """

    found: Findings
    chosen: Choice
    candidates: tuple[Candidate, ...]
    named: Candidate
    fit: Fit
    likely: Probabilities
    smooth: Curves | None
    prior: LibraryPrior | None = None


def explanation(
    found: Findings,
    measurements: Measurements,
    draws: int,
    generator: np.random.Generator,
    tell: Tell = say_nothing,
) -> Explanation:
    """The ambiguity set and the best set; error curves replace named effects where they explain the data better."""
    tell("probabilities")
    likely = probabilities(found)
    found = agreeing(found, likely)
    chosen = found.unknown.chosen
    tell("error curves")
    fitted, smooth = found.fits.fit(chosen), find_curves(found, measurements)
    if smooth is None:
        tell("candidates")
        candidates = candidate_list(found, draws, generator)
        same = (c for c in candidates if set(c.effects) == {h.label for h in chosen})
        named = next(same, None) or candidate(found.search, found.fits, chosen, 0.0, draws, generator)
    else:
        fitted, found, chosen = smooth.fit, replace(found, scatter=smooth.scatter), smooth.kept
        named = curve_candidate(smooth)
        # the curve of an unknown function is no name for it
        known = named.keys if found.unknown.place is None else None
        candidates, likely = (named,), likely.with_odds(known, smooth.gain / 2.0)
    candidates = tuple(replace(c, probability=likely.of(c.keys)) for c in candidates)
    named = replace(named, probability=likely.of(named.keys))
    return Explanation(found, chosen, candidates, named, fitted, likely, smooth)


@dataclass(frozen=True)
class Fits:
    """Fits to all rows but outliers: the base model as `identify` fits it, and the best set."""

    base: Fit
    after: Fit


def fits_of(explained: Explanation, measurements: Measurements) -> Fits:
    """Fits of the base model and of the best set."""
    found = explained.found
    base = fit(found.search.hypotheses.base, Rows.of(measurements).pick(~found.outlier))
    return Fits(base, explained.fit if explained.chosen or explained.smooth else base)


def explained_fits(
    found: Findings,
    measurements: Measurements,
    draws: int,
    generator: np.random.Generator,
    prior: bool = False,
    names: Sequence[str] | None = None,
    tell: Tell = say_nothing,
) -> tuple[Explanation, Fits]:
    """The explanation of the data, and the fits before and after.

    prior : add the rest of the library with its prior;  names : restrict it to these effects, None: all
    """
    explained = explanation(found, measurements, draws, generator, tell)
    fits = fits_of(explained, measurements)
    return with_prior(explained, fits, measurements, names) if prior else (explained, fits)


def with_prior(
    explained: Explanation, fits: Fits, measurements: Measurements, names: Sequence[str] | None
) -> tuple[Explanation, Fits]:
    """Add the rest of the library with its prior to the fits of the candidates and of the best set.

    names : restrict it to these effects, None: all
    """
    used = measurements.rows(~explained.found.outlier)
    after, library = held(fits.after, used, names)
    named = held_candidate(explained.named, after, library)

    def again(one: Candidate) -> Candidate:
        if one.effects == named.effects:
            return named
        arm = fits.base.model.arm
        own = fit(Model(arm.with_effects(*arm.effects, *one.specs)), explained.fit.rows, one.calibration.values)
        return held_candidate(one, *held(own, used, names))

    candidates = tuple(map(again, explained.candidates))
    return replace(explained, candidates=candidates, named=named, prior=library), replace(fits, after=after)
