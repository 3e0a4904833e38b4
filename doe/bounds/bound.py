"""An upper bound on a criterion value, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Bound:
    """No design of the design space named by `source` has a criterion value above `value`.

    source : `closed_form` (doe/README.md, "Planar theorem"), `continuous` (every feasible posture) or `grid`
        (the candidates only)
    rigorous : True if it is a theorem (closed form, interval arithmetic, all candidates visited); False if it rests on
        a numerical search for the largest sensitivity, which could have missed a posture
    cut : True if the time ended before the search for a lower bound did: it holds, and may be far from the best plan
    """

    value: float
    source: str
    rigorous: bool = False
    cut: bool = False

    def as_dict(self) -> dict[str, float | str | bool]:
        """The key `bound` (identification/files/README.md, "JSON keys")."""
        known: dict[str, float | str | bool] = {"value": self.value, "source": self.source, "rigorous": self.rigorous}
        return known | {"cut": True} if self.cut else known

    def __str__(self) -> str:
        kind = f"{'rigorous' if self.rigorous else 'numerical'}{', its search was cut' if self.cut else ''}"
        return f"{round(self.value, 12) + 0.0:.10g} ({self.source}, {kind})"
