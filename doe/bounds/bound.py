"""An upper bound on a criterion value, and where it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

SCOPES = {"closed_form": "all postures", "continuous": "all postures", "grid": "list"}
PROVEN, NUMERICAL = "proven", "numerical"


@dataclass(frozen=True)
class Bound:
    """No design of the design space named by `source` has a criterion value above `value`.

    source : `closed_form` (doe/README.md, "Planar theorem"), `continuous` (every feasible posture) or `grid`
        (the candidates only)
    rigorous : True if it is a theorem (closed form, interval arithmetic, all candidates visited); False if it rests on
        a numerical search for the largest sensitivity, which could have missed a posture
    cut : True if the time ended before the search for a lower bound did: it holds, and may be far from the best plan
    candidates : how many postures the list has, None: all postures within limits and constraints
    """

    value: float
    source: str
    rigorous: bool = False
    cut: bool = False
    candidates: int | None = None

    @property
    def scope(self) -> str:
        """Of which designs it holds: of `all postures` within limits and constraints, or of those of a `list`."""
        return SCOPES[self.source]

    @property
    def proof(self) -> str:
        """`proven`, or `numerical`: as good as a search for the largest sensitivity."""
        return PROVEN if self.rigorous else NUMERICAL

    def as_dict(self) -> dict[str, Any]:
        """The key `bound` (identification/files/README.md, "JSON keys")."""
        data: dict[str, Any] = {"value": self.value, "source": self.source, "scope": self.scope, "proof": self.proof}
        data |= {"rigorous": self.rigorous} | ({} if self.candidates is None else {"candidates": self.candidates})
        return data | {"cut": True} if self.cut else data

    def __str__(self) -> str:
        return f"{round(self.value, 12) + 0.0:.10g} ({bound_in_words(self.as_dict())})"


def bound_in_words(bound: Mapping[str, Any]) -> str:
    """Of what a bound, as in JSON, holds, and how surely: `closed form, all postures, proven`.

    Files of earlier versions do not say which postures.
    """
    source = {"closed_form": "closed form, "}.get(bound["source"], "")
    proof = PROVEN if bound.get("rigorous", False) else NUMERICAL
    cut = ", its search was cut by the time limit" if bound.get("cut") else ""
    return f"{source}{postures_in_words(bound)}, {proof}{cut}"


def postures_in_words(bound: Mapping[str, Any]) -> str:
    """`all postures`, `the list of 2,000 postures`."""
    if SCOPES.get(bound["source"]) == "list":
        count = bound.get("candidates")
        return "the postures of the list" if count is None else f"the list of {count:,} postures"
    return "all postures"
