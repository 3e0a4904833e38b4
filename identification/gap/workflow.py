"""The loop of `diagnose` (steps 2 to 6): select effects and model the noise in turn until both agree."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.gap.fits.fit import Fit
from identification.gap.fits.whitening import Rows
from identification.gap.hypotheses.hypotheses import HypothesisSet
from identification.gap.noise.noise import Finding, memory, outliers, screen, whitened
from identification.gap.outside.further_orders import extended_search
from identification.gap.outside.unmodelled import Unknown
from identification.gap.selection.search import Choice, HypothesisSearch
from identification.gap.selection.selection import Selection, select
from identification.progress import Tell, say_nothing, within

# reasons: identification/README.md, "Constants"
MOST_ROWS = 1250  # an effect with a gain of `LEAST_GAIN` is then found in 99 of 100 cases
PASSES = 4  # effort: rounds of naming and screening
CREDIT = 6.0  # odds of 20 to 1 for another explanation of the scatter


@dataclass(frozen=True)
class Findings:
    """Result of the search.

    search : the tests, with their noise model;  selection : effects of the library;  unknown : effect outside it
    scatter : findings about the noise;  outlier : (m,) rows left out
    whole : fits to all rows, if effects were searched in a sample of them; None: as `search`
    """

    search: HypothesisSearch
    selection: Selection
    unknown: Unknown
    scatter: tuple[Finding, ...]
    outlier: NDArray[np.bool_]
    whole: HypothesisSearch | None = None

    @property
    def fits(self) -> HypothesisSearch:
        """Fits to all rows except outliers."""
        return self.whole or self.search


@dataclass(frozen=True)
class Workflow:
    """The search for missing effects.

    draws : of each bootstrap, from the generator
    tell : called with a message at each step; how many follow depends on what they find, so there is no time left
    """

    hypotheses: HypothesisSet
    draws: int
    generator: np.random.Generator
    tell: Tell = say_nothing

    def findings(self, rows: Rows) -> Findings:
        """Search these rows for missing effects.

        Of more than `MOST_ROWS` rows a random sample is searched (random, as every fourth row of a grid may have the
        same angle); outliers and noise are then determined from all rows, and the named effects are fitted to all.
        """
        if len(rows) <= MOST_ROWS:
            return self._investigated(rows)
        some = np.sort(self.generator.permutation(len(rows))[:MOST_ROWS])
        found = self._investigated(rows.pick(some))
        self.tell("fit to all rows")
        chosen = found.unknown.chosen
        outlier = outliers(found.search.fit(chosen), rows)
        outlier[some] = found.outlier
        plain = rows.pick(~outlier)
        named = HypothesisSearch(found.search.hypotheses, plain).fit(chosen)
        scatter = screen(named, plain, self.generator)
        whole = HypothesisSearch(found.search.hypotheses, whitened(plain, named, scatter), bool(scatter))
        return replace(found, outlier=outlier, scatter=scatter, whole=whole)

    def _investigated(self, rows: Rows) -> Findings:
        """Select effects and screen the noise of the named model in turn, until the noise model no longer changes.

        The noise is screened after the selection because a missing effect resembles noise (a drift resembles serial
        correlation), and before the final selection because noise can resemble an effect.
        """
        self.tell("base model")
        noisy = rows
        scatter: tuple[Finding, ...] = ()
        outlier = outliers(HypothesisSearch(self.hypotheses, rows).fit(()), rows)
        seen: list[tuple[object, ...]] = []
        known: tuple[Choice, ...] = ((),)
        for number in range(PASSES):
            used = scatter, outlier
            search = HypothesisSearch(self.hypotheses, noisy.pick(~outlier), noise_estimated=bool(scatter))
            selection = select(search, self.draws, self.generator, known, within(f"pass {number + 1}, ", self.tell))
            known = selection.path
            again = outliers(search.fit(selection.chosen), noisy)
            plain = rows.pick(~again)
            named = HypothesisSearch(self.hypotheses, plain).fit(selection.chosen)
            new = screen(named, plain, self.generator)
            state = (*(f.name for f in new), *np.flatnonzero(again))
            if state == (*(f.name for f in scatter), *np.flatnonzero(outlier)) or state in seen:
                break
            seen.append(state)
            outlier, scatter, noisy = again, new, whitened(rows, named, new)
        found = self._extended(search, selection, *used, self.tell)
        noises = _other_noise(found, rows, noisy, named)
        parts = (f"scatter {k} of {len(noises)}, " for k in range(1, len(noises) + 1))
        others = [self._with_noise(found, *noise, part) for noise, part in zip(noises, parts, strict=True)]
        best = min(others, key=lambda f: cost(f, len(rows)), default=found)
        found = best if cost(best, len(rows)) < cost(found, len(rows)) - _credit(found, best) else found
        return min((found, *self._with_memory(found, rows)), key=lambda f: cost(f, len(rows)))

    def _extended(
        self,
        search: HypothesisSearch,
        selection: Selection,
        scatter: tuple[Finding, ...],
        outlier: NDArray[np.bool_],
        tell: Tell,
    ) -> Findings:
        """The findings of a search, with the unknown effect beside its selection, if any."""
        last = extended_search(search, selection, self.draws, self.generator, tell)
        return Findings(last.search, last.selection, last.unknown, scatter, outlier)

    def _with_noise(
        self, before: Findings, rows: Rows, scatter: tuple[Finding, ...], outlier: NDArray[np.bool_], part: str
    ) -> Findings:
        """The findings with another explanation of the scatter than before;  part : what this is, to be told"""
        tell = within(part, self.tell)
        search = HypothesisSearch(before.search.hypotheses, rows.pick(~outlier), noise_estimated=bool(scatter))
        selection = select(search, self.draws, self.generator, before.selection.path, tell)
        return self._extended(search, selection, scatter, outlier, tell)

    def _with_memory(self, found: Findings, rows: Rows) -> list[Findings]:
        """The findings with serially correlated noise, if the residuals of the base model suggest it; else empty.

        A named drift, step or offset can be the slow part of correlated noise, especially with few rows, and then
        removes the correlation from the residuals that were screened. The lower BIC decides, without a credit: it is 5
        to 24 lower where the noise is correlated and 2 to 29 higher where there is a drift or a step (simulated, 30 and
        50 rows).
        """
        known = any(finding.name == "serial_correlation" for finding in found.scatter)
        if known or (not found.unknown.chosen and found.unknown.place is None):
            return []
        plain = rows.pick(~found.outlier)
        base = HypothesisSearch(found.search.hypotheses, plain).fit(())
        hint = memory(base, plain, self.generator)
        if not hint:
            return []
        scatter = (*found.scatter, *hint)
        return [self._with_noise(found, whitened(rows, base, scatter), scatter, found.outlier, "scatter with memory, ")]


def _credit(found: Findings, other: Findings) -> float:
    """By how much the cost of another explanation of the scatter must be lower.

    Nothing where uneven scatter leaves nothing missing and a cause takes its place: a wave at a joint looks like noise
    of that joint.
    """
    nothing = not found.unknown.chosen and found.unknown.place is None
    return 0.0 if nothing and np.array_equal(found.outlier, other.outlier) else CREDIT


def _other_noise(
    found: Findings, rows: Rows, noisy: Rows, named: Fit
) -> list[tuple[Rows, tuple[Finding, ...], NDArray[np.bool_]]]:
    """Alternatives to the noise model: without outliers, without serial correlation, and without any noise model.

    Returns rows, findings and (m,) rows left out of each. An effect that acts at a few postures only (a bump at one
    joint angle) resembles outliers, and a step in time resembles serial correlation; the lower BIC decides.
    """
    others = []
    if found.outlier.any():
        others.append((noisy, found.scatter, np.zeros_like(found.outlier)))
    memoryless = tuple(f for f in found.scatter if f.name != "serial_correlation")
    fewer = dict.fromkeys((memoryless, ()))  # not a set: its order would change from run to run
    return others + [(whitened(rows, named, f), f, found.outlier) for f in fewer if f != found.scatter]


def cost(found: Findings, m: int) -> float:
    """BIC of effects and noise model together, comparable between different sets of outliers.

    Each outlier counts as d free coordinates at one of m rows. The noise model costs its parameters and the log
    determinant of its covariance.
    """
    d = found.search.rows.dimension
    n, taken = d * m, int(found.outlier.sum())
    kept = found.search.fit(found.unknown.chosen)
    rest = found.unknown.bic - len(kept.residual) * np.log(kept.squares / len(kept.residual))
    effects = n * np.log(kept.squares / n) + rest
    noise = found.search.rows.log_determinant + len(found.scatter) * np.log(n)
    return float(effects + noise + taken * (d * np.log(n) + 2.0 * np.log(m)))
