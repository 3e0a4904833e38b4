"""`Replication`: result of the test whether a named effect has the same size in each of several sessions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class InSession:
    """An effect in one session.

    values, deviations : estimates from this session alone with standard deviations, in the unit of files
    explained : fraction of the sum of squares without the effect that the values of the other sessions explain here
    returns : whether the effect replicates in this session; None: undecided
    """

    session: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]
    explained: float
    returns: bool | None


@dataclass(frozen=True)
class Replication:
    """One named effect across sessions.

    names, units : of its parameters, empty for an error curve
    p_equal : p-value of equal values in all sessions, None for an error curve
    returns : whether carried-over values reduce the residuals of all sessions together; None: undecided
    """

    effect: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    p_equal: float | None
    returns: bool | None
    sessions: tuple[InSession, ...]

    @property
    def replicates(self) -> bool | None:
        """Overall conclusion: False if the effect fails to replicate in one session or overall; None: undecided."""
        return False if any(session.returns is False for session in self.sessions) else self.returns

    def __str__(self) -> str:
        says = {True: "replicates", False: "does not replicate", None: "is open"}[self.replicates]
        parts = "; ".join(f"{s.session}: {self.figures(s)}" for s in self.sessions)
        return f"{self.effect} {says} across sessions ({parts})"

    def figures(self, there: InSession) -> str:
        """Its values in a session, as text."""
        figures = zip(self.names, there.values, there.deviations, self.units, strict=True)
        listed = [f"{n.rpartition('.')[2]} = {v:.3g} +- {d:.1g} {u}" for n, v, d, u in figures]
        explained = [f"{100.0 * there.explained:.0f} % explained by the others' values"]
        return ", ".join(listed if 0 < len(listed) <= 3 else explained)

    def to_json(self) -> dict[str, Any]:
        """An entry of `replication` (identification/files/README.md, "JSON keys")."""
        return {
            "effect": self.effect,
            "replicates": self.replicates,
            "p_equal": self.p_equal,
            "sessions": [
                {
                    "session": s.session,
                    "replicates": s.returns,
                    "explained": s.explained,
                    "parameters": [
                        {"name": n, "unit": u, "value": v, "std": d}
                        for n, u, v, d in zip(self.names, self.units, s.values, s.deviations, strict=True)
                    ],
                }
                for s in self.sessions
            ],
        }


def replication_clauses(found: tuple[Replication, ...]) -> Iterator[str]:
    """Clauses of the verdict: which effects replicate across sessions and which do not."""
    for answer, words in ((True, "replicates across sessions"), (False, "does not replicate across sessions")):
        if titles := [r.effect for r in found if r.replicates is answer]:
            yield f"{words}: {' + '.join(titles)}"
