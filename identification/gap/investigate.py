"""Steps 2 to 6: screen, gate, rank, ambiguity, unknown; repeated until screening and naming agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.gap.hypotheses import HypothesisSet
from identification.gap.noise import Finding, Scatter, outliers, screen
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
    outlier = _screen_rows(Search(hypotheses, rows), (), rows)
    scatter = Scatter((), rows.pick(~outlier))
    seen: set[tuple[str, ...]] = set()
    for number in range(PASSES):
        tell(f"testing the effects, pass {number + 1}")
        search = Search(hypotheses, scatter.rows)
        selection = select(search, draws, generator)
        again = _screen_rows(search, selection.chosen, rows)
        plain = rows.pick(~again)
        found = Search(hypotheses, plain).fit(selection.chosen)
        new = screen(found, plain, generator)
        state = (*new.names, *map(str, np.flatnonzero(again)))
        if (set(new.names) <= set(scatter.names) and np.array_equal(again, outlier)) or state in seen:
            break
        seen.add(state)
        outlier, scatter = again, new
    tell("looking for what the library does not explain")
    unknown = look(search, selection.chosen, generator)
    return Findings(search, selection, unknown, scatter.findings, outlier)


def _screen_rows(search: Search, chosen: tuple, rows: Rows) -> NDArray[np.bool_]:
    found = search.fit(chosen)
    position, jacobian = found.model.linearise(rows.postures, found.values, rows.conditions)
    return outliers(position, jacobian, rows)
