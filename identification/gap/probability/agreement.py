"""Make the verdict consistent with the posterior probabilities: no effect is named that they rule out.

The tests control the rate of false alarms, whatever the sizes of the effects. The probabilities weigh the named
effects against two alternatives: nothing is missing, and a shape outside the library. Where one alternative alone
forms the 90 % credible set, it becomes the verdict.
"""

from __future__ import annotations

from dataclasses import replace

from identification.gap.outside.unmodelled import Unknown, likeliest_shape
from identification.gap.probability.probabilities import Probabilities
from identification.gap.selection.selection import ALPHA_FIRST, Selection, neighbors
from identification.gap.workflow import Findings


def agreeing(found: Findings, likely: Probabilities) -> Findings:
    """The findings, with the named effects withdrawn where an alternative alone forms the credible set."""
    credible, unknown = list(likely.credible), found.unknown
    if not unknown.chosen or unknown.place is not None or len(credible) != 1:
        return found
    if credible[0] is None:  # something outside the library
        return replace(found, unknown=likeliest_shape(found.search, unknown))
    if credible[0] == ():
        search, before = found.search, found.selection
        none = Selection((), neighbors(search, ()), before.first, before.first, ((),))
        return replace(found, selection=none, unknown=Unknown(unknown.p, None, None, (), search.bic(())))
    return found


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
