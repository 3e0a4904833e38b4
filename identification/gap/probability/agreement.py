"""Make the verdict consistent with the posterior probabilities: no effect is named that they rule out.

The tests control the rate of false alarms, whatever the sizes of the effects. The probabilities weigh the named
effects against three alternatives: nothing is missing, a shape outside the library, and one effect less. Where one of
the first two alone forms the 90 % credible set, it becomes the verdict; an effect without which the others are
likelier by odds of `SUPERFLUOUS` is no longer named.
"""

from __future__ import annotations

from dataclasses import replace

from identification.gap.outside.unmodelled import Unknown, likeliest_shape
from identification.gap.probability.probabilities import Probabilities
from identification.gap.selection.search import Choice
from identification.gap.selection.selection import ALPHA_FIRST, Selection, neighbors, swapped
from identification.gap.workflow import Findings

# reasons: identification/README.md, "Constants"
SUPERFLUOUS = 20.0  # odds


def agreeing(found: Findings, likely: Probabilities) -> Findings:
    """The findings, with the named effects withdrawn where an alternative alone forms the credible set, and one of
    several where the others are clearly likelier without it."""
    credible, unknown = list(likely.credible), found.unknown
    if not unknown.chosen or unknown.place is not None:
        return found
    if credible == [None]:  # something outside the library
        return replace(found, unknown=likeliest_shape(found.search, unknown))
    if credible == [()]:
        return _naming(found, ())
    rest = _without_superfluous(unknown.chosen, likely)
    return found if rest == unknown.chosen else _naming(found, swapped(found.search, rest))


def _without_superfluous(chosen: Choice, likely: Probabilities) -> Choice:
    """Two or more effects less those without which the others are likelier by odds of `SUPERFLUOUS`."""
    while len(chosen) > 1:
        fewer = (chosen[:k] + chosen[k + 1 :] for k in range(len(chosen)))
        best = max(fewer, key=lambda rest: likely.of(h.key for h in rest))
        if likely.of(h.key for h in best) <= SUPERFLUOUS * likely.of(h.key for h in chosen):
            break
        chosen = best
    return chosen


def _naming(found: Findings, chosen: Choice) -> Findings:
    """The findings with fewer effects named."""
    search, before = found.search, found.selection
    path = (*before.path, chosen) if chosen else ((),)
    fewer = Selection(chosen, neighbors(search, chosen), before.first, before.first, path)
    return replace(found, selection=fewer, unknown=Unknown(found.unknown.p, None, None, chosen, search.bic(chosen)))


def overruled(found: Findings, likely: Probabilities) -> list[str]:
    """A note naming the most significant effect where the verdict is `none` although its test is significant."""
    test = found.selection.first.omnibus_test
    if found.unknown.chosen or found.unknown.place is not None or not test.p.size:
        return []
    best = int(test.adjusted.argmin())
    if test.adjusted[best] > ALPHA_FIRST * found.search.level_factor:
        return []
    name = found.selection.first.members[best].label
    return [f"{name}: p = {test.adjusted[best]:.2g}, yet nothing missing is likelier (probability {likely.none:.2f})"]
