"""What a named effect is in each of several sessions, and whether it returns."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class InSession:
    """An effect in one session.

    values, deviations : fitted to this session alone, in the unit of files
    explained : share of the squares without the effect that the values of the other sessions explain here
    returns : True, False, or None where it cannot be said
    """

    session: str
    values: tuple[float, ...]
    deviations: tuple[float, ...]
    explained: float
    returns: bool | None


@dataclass(frozen=True)
class Replication:
    """One named effect across sessions.

    names, units : of its parameters, none for an error curve
    p_equal : probability of values that differ so much if in truth they are equal, None for an error curve
    returns : whether carried-over values explain something, in all sessions together
    """

    effect: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    p_equal: float | None
    returns: bool | None
    sessions: tuple[InSession, ...]

    @property
    def replicates(self) -> bool | None:
        """False if carried-over values do harm in one session or explain nothing, None: cannot be said."""
        return False if any(session.returns is False for session in self.sessions) else self.returns

    def __str__(self) -> str:
        says = {True: "replicates", False: "does not replicate", None: "is open"}[self.replicates]
        parts = "; ".join(f"{s.session}: {self.figures(s)}" for s in self.sessions)
        return f"{self.effect} {says} across sessions ({parts})"

    def figures(self, there: InSession) -> str:
        """Its values in a session, for people."""
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


def said(found: tuple[Replication, ...]) -> Iterator[str]:
    """For the verdict: what returns in other sessions and what does not."""
    for answer, words in ((True, "replicates across sessions"), (False, "does not replicate across sessions")):
        if titles := [r.effect for r in found if r.replicates is answer]:
            yield f"{words}: {' + '.join(titles)}"
