"""Steps 2 to 6: screen, gate, rank, ambiguity, unknown; repeated until screening and naming agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.gap.hypotheses import HypothesisSet
from identification.gap.noise import Finding, outliers, screen, whitened
from identification.gap.select import Search, Selection, select
from identification.gap.unknown import Unknown, look
from identification.gap.whitening import Rows

PASSES = 4


@dataclass(frozen=True)
class Findings:
    """What the data say.

    search : the fits, to the rows that were kept, with their noise model;  outlier : (m,) rows left out
    """

    search: Search
    selection: Selection
    unknown: Unknown
    scatter: tuple[Finding, ...]
    outlier: NDArray[np.bool_]


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
    outlier = _screen_rows(Search(hypotheses, rows), (), rows)
    seen: list[tuple[object, ...]] = []
    for number in range(PASSES):
        tell(f"testing the effects, pass {number + 1}")
        search = Search(hypotheses, noisy.pick(~outlier))
        selection = select(search, draws, generator)
        again = _screen_rows(search, selection.chosen, noisy)
        plain = rows.pick(~again)
        named = Search(hypotheses, plain).fit(selection.chosen)
        new = screen(named, plain, generator)
        state = (*(f.name for f in new), *np.flatnonzero(again))
        if state == (*(f.name for f in scatter), *np.flatnonzero(outlier)) or state in seen:
            break
        seen.append(state)
        outlier, scatter, noisy = again, new, whitened(rows, named, new)
    tell("looking for what the library does not explain")
    unknown = look(search, selection.chosen, generator)
    found = Findings(search, selection, unknown, scatter, outlier)
    return _without_outliers(found, noisy, draws, generator) if outlier.any() else found


def _without_outliers(found: Findings, rows: Rows, draws: int, generator: np.random.Generator) -> Findings:
    """The same data with all rows, if that is the better explanation.

    An effect that moves a few postures only (a bump at one joint angle) looks like outliers. Each outlier is a model
    of its own: two free coordinates at one of m rows; BIC decides between them and the effects.
    """
    search = Search(found.search.hypotheses, rows)
    selection = select(search, draws, generator)
    unknown = look(search, selection.chosen, generator)
    if not selection.chosen and unknown.place is None:
        return found
    n, taken = 2 * len(rows), int(found.outlier.sum())
    kept = found.search.fit(found.unknown.chosen)
    own = found.unknown.bic - len(kept.residual) * np.log(kept.squares / len(kept.residual))
    trimmed = n * np.log(kept.squares / n) + own + taken * (2.0 * np.log(n) + 2.0 * np.log(len(rows)))
    if unknown.bic >= trimmed:
        return found
    return Findings(search, selection, unknown, found.scatter, np.zeros(len(rows), dtype=bool))


def _screen_rows(search: Search, chosen: tuple, rows: Rows) -> NDArray[np.bool_]:
    found = search.fit(chosen)
    position, jacobian = found.model.linearise(rows.postures, found.values, rows.conditions)
    return outliers(position, jacobian, rows)
