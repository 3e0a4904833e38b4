"""Two effects at once: the pairs that explain the data best, whatever else is named.

Two missing effects mask each other, each being scatter in the test of the other, and a third effect that resembles a
part of both can be more significant than either. A search that adds one effect after the other begins with that one,
and single exchanges do not lead from it to the pair. So the best single effects are each given their best partner, in
the model linearized about the base fit, where that needs no further fit.
"""

from __future__ import annotations

import numpy as np

from identification.gap.selection.search import Choice, HypothesisSearch

# reasons: identification/README.md, "Constants"
STARTS = 8  # effort: single effects that are given a partner


def pairs(search: HypothesisSearch) -> list[tuple[Choice, float]]:
    """The best effects by BIC, each with its best partner, and the change of BIC; all linearized, lowest BIC first."""
    first = search.state(())
    found: dict[frozenset[str], tuple[Choice, float]] = {}
    starts: dict[str, int] = {}
    for k in np.argsort(first.change, kind="stable").tolist():
        starts.setdefault(first.members[k].key, k)
        if len(starts) == STARTS:
            break
    for k in starts.values():
        member = first.members[k]
        state = search.linear_state((member,), search.fit(()).residual, search.moments(()))
        others = np.where([h.key == member.key for h in state.members], np.inf, state.change)
        if not np.isfinite(others).any():
            continue
        best = int(np.argmin(others))
        pair = member.free, state.members[best].free
        found.setdefault(frozenset(h.label for h in pair), (pair, float(first.change[k] + others[best])))
    return sorted(found.values(), key=lambda option: option[1])
