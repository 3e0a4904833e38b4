"""The loop inside `diagnose` (steps 2 to 6): screen, test, rank, look outside the library, until all agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.gap.fit import Fit
from identification.gap.further_orders import explained
from identification.gap.hypotheses import HypothesisSet
from identification.gap.noise import Finding, memory, outliers, screen, whitened
from identification.gap.search import Choice, HypothesisSearch
from identification.gap.selection import Selection, select
from identification.gap.unmodelled import Unknown
from identification.gap.whitening import Rows

# reasons: identification/README.md, "Constants"
MOST_ROWS = 2000  # effort: of more, effects are looked for in so many
PASSES = 4  # effort: rounds of naming and screening
CREDIT = 6.0  # odds of 20 to 1 for another explanation of the scatter


@dataclass(frozen=True)
class Findings:
    """What the data say.

    search : the fits, to the rows that were used, with their noise model;  outlier : (m,) rows left out
    sampled : (m,) rows that effects were looked for in; None: in all
    """

    search: HypothesisSearch
    selection: Selection
    unknown: Unknown
    scatter: tuple[Finding, ...]
    outlier: NDArray[np.bool_]
    sampled: NDArray[np.bool_] | None = None

    @property
    def used(self) -> NDArray[np.bool_]:
        """(m,) rows that the search was made with."""
        return ~self.outlier if self.sampled is None else ~self.outlier & self.sampled


def investigate_some(
    hypotheses: HypothesisSet,
    rows: Rows,
    draws: int,
    generator: np.random.Generator,
    tell: Callable[[str], None] = lambda message: None,
) -> Findings:
    """`investigate`, of very many rows with `MOST_ROWS` of them, taken at random since every fourth of a grid may be
    the same angle; outliers are then looked for among all."""
    if len(rows) <= MOST_ROWS:
        return investigate(hypotheses, rows, draws, generator, tell)
    some = np.sort(generator.permutation(len(rows))[:MOST_ROWS])
    found = investigate(hypotheses, rows.pick(some), draws, generator, tell)
    outlier = outliers(found.search.fit(found.unknown.chosen), rows)
    outlier[some] = found.outlier
    sampled = np.zeros(len(rows), dtype=bool)
    sampled[some] = True
    return replace(found, outlier=outlier, sampled=sampled)


def investigate(
    hypotheses: HypothesisSet,
    rows: Rows,
    draws: int,
    generator: np.random.Generator,
    tell: Callable[[str], None] = lambda message: None,
) -> Findings:
    """Name effects, then look at the scatter under the named model; if that changes what is white, name again.

    The scatter is judged after naming because a missing effect looks like scatter (a drift like serial correlation),
    and before the final naming because scatter looks like an effect.
    """
    tell("fitting the base model")
    noisy = rows
    scatter: tuple[Finding, ...] = ()
    outlier = outliers(HypothesisSearch(hypotheses, rows).fit(()), rows)
    seen: list[tuple[object, ...]] = []
    known: tuple[Choice, ...] = ((),)
    for number in range(PASSES):
        tell(f"testing the effects, pass {number + 1}")
        used = scatter, outlier
        search = HypothesisSearch(hypotheses, noisy.pick(~outlier), noise_estimated=bool(scatter))
        selection = select(search, draws, generator, known)
        known = selection.path
        again = outliers(search.fit(selection.chosen), noisy)
        plain = rows.pick(~again)
        named = HypothesisSearch(hypotheses, plain).fit(selection.chosen)
        new = screen(named, plain, generator)
        state = (*(f.name for f in new), *np.flatnonzero(again))
        if state == (*(f.name for f in scatter), *np.flatnonzero(outlier)) or state in seen:
            break
        seen.append(state)
        outlier, scatter, noisy = again, new, whitened(rows, named, new)
    tell("looking for what the library does not explain")
    last = explained(search, selection, draws, generator)
    found = Findings(last.search, last.selection, last.unknown, *used)
    others = [_explained(found, *other, draws, generator) for other in _other_noise(found, rows, noisy, named)]
    best = min(others, key=lambda f: cost(f, len(rows)), default=found)
    found = best if cost(best, len(rows)) < cost(found, len(rows)) - CREDIT else found
    return min((found, *_with_memory(found, rows, draws, generator)), key=lambda f: cost(f, len(rows)))


def _with_memory(found: Findings, rows: Rows, draws: int, generator: np.random.Generator) -> list[Findings]:
    """The same data with serially correlated noise, where the base model's residuals hint at it.

    An effect that was named takes the correlation out of the residuals that were screened: a drift, a step or an offset
    can be the slow part of such noise, and of few rows it often is. The lower BIC is right, without a credit: it is 5
    to 24 lower where the noise is correlated and 2 to 29 higher where there is a drift or a step (simulated, 30 and 50
    rows).
    """
    known = any(finding.name == "serial_correlation" for finding in found.scatter)
    if known or (not found.unknown.chosen and found.unknown.place is None):
        return []
    plain = rows.pick(~found.outlier)
    base = HypothesisSearch(found.search.hypotheses, plain).fit(())
    hint = memory(base, plain, generator)
    if not hint:
        return []
    scatter = (*found.scatter, *hint)
    return [_explained(found, whitened(rows, base, scatter), scatter, found.outlier, draws, generator)]


def _other_noise(
    found: Findings, rows: Rows, noisy: Rows, named: Fit
) -> list[tuple[Rows, tuple[Finding, ...], NDArray[np.bool_]]]:
    """The same data without outliers, without serial correlation, without a noise model: rows, findings, rows left out.

    An effect that moves a few postures only (a bump at one joint angle) looks like outliers, and a step in time like
    serial correlation; whichever explanation has the lower BIC is right.
    """
    others = []
    if found.outlier.any():
        others.append((noisy, found.scatter, np.zeros_like(found.outlier)))
    memoryless = tuple(f for f in found.scatter if f.name != "serial_correlation")
    fewer = dict.fromkeys((memoryless, ()))  # not a set: its order would change from run to run
    return others + [(whitened(rows, named, f), f, found.outlier) for f in fewer if f != found.scatter]


def _explained(
    before: Findings,
    rows: Rows,
    scatter: tuple[Finding, ...],
    outlier: NDArray[np.bool_],
    draws: int,
    generator: np.random.Generator,
) -> Findings:
    """The findings with another explanation of the scatter than before."""
    hypotheses = before.search.hypotheses
    search = HypothesisSearch(hypotheses, rows.pick(~outlier), noise_estimated=bool(scatter))
    selection = select(search, draws, generator, before.selection.path)
    found = explained(search, selection, draws, generator)
    return Findings(found.search, found.selection, found.unknown, scatter, outlier)


def cost(found: Findings, m: int) -> float:
    """BIC of effects and noise model together, comparable between different sets of outliers.

    Each outlier is a model of its own: d free coordinates at one of m rows. The noise model costs its parameters and
    the logarithm of its covariance's determinant.
    """
    d = found.search.rows.dimension
    n, taken = d * m, int(found.outlier.sum())
    kept = found.search.fit(found.unknown.chosen)
    rest = found.unknown.bic - len(kept.residual) * np.log(kept.squares / len(kept.residual))
    effects = n * np.log(kept.squares / n) + rest
    noise = found.search.rows.log_determinant + len(found.scatter) * np.log(n)
    return float(effects + noise + taken * (d * np.log(n) + 2.0 * np.log(m)))
