"""Rounds of the search: the effects that each added or removed, and the gap afterwards."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from identification.gap.fits.fit import Fit
from identification.gap.selection.search import Choice, HypothesisSearch
from identification.measurements import rms_distance

SPELLED = 5  # names of a round that are spelled out


@dataclass(frozen=True)
class Round:
    """added, removed : labels of effects;  rms : RMS distance [mm] after the round, without outliers"""

    added: tuple[str, ...]
    removed: tuple[str, ...]
    rms: float

    def __str__(self) -> str:
        changes = [*_signed("+", self.added), *_signed("-", self.removed)]
        return f"{' '.join(changes)}: {self.rms:.4g} mm left"

    def to_json(self) -> dict[str, object]:
        """An entry of `rounds` (identification/files/README.md, "JSON keys")."""
        return {"added": list(self.added), "removed": list(self.removed), "rms_mm": self.rms}


def _signed(sign: str, labels: tuple[str, ...]) -> list[str]:
    """The first `SPELLED` labels with a sign, and the number of further ones."""
    rest = [f"{sign} {len(labels) - SPELLED} more"] if len(labels) > SPELLED else []
    return [f"{sign} {label}" for label in labels[:SPELLED]] + rest


def rounds_of(
    search: HypothesisSearch, path: tuple[Choice, ...], last: Fit, named: tuple[str, ...]
) -> tuple[Round, ...]:
    """The rounds that changed something.

    path : sets of effects after each round, the first of them empty
    last, named : fit and labels of the best set, in which error curves may replace named effects
    """
    steps = [(tuple(h.label for h in chosen), search.fit(chosen)) for chosen in path]
    found = []
    for (before, _), (after, fitted) in pairwise([*steps, (named, last)]):
        added = tuple(label for label in after if label not in before)
        removed = tuple(label for label in before if label not in after)
        if added or removed:
            found.append(Round(added, removed, rms_distance(fitted.left)))
    return tuple(found)
