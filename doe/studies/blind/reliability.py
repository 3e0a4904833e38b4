"""Are statements of probability p right in a fraction p of the cases, and do 95 % intervals cover 95 %?"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np

ALL = "all sets"  # stands for a cell where a figure is of all cells together
EDGES = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
MIDDLE = (0.7, 0.95)  # where a good classifier is easily too sure
BASE = ("length_error:", "joint_offset:")


def probability_judged(row: Mapping[str, Any]) -> dict[str, Any]:
    """What was said with which probability, and whether it is right; the credible set, where something is hidden.

    The verdict is what is said: nothing, the named set, or something outside the library.
    """
    if row.get("probability") is None:
        return {}
    hidden = sorted(row["hidden"] or ())
    truth = "unknown" if row.get("outside") is not None else " + ".join(hidden) or "none"
    verdict = row["verdict"]
    said = verdict if verdict in ("none", "unknown") else " + ".join(sorted(row["named"]))
    judged: dict[str, Any] = {"said": row["probability"], "right": said == truth}
    if hidden:
        judged["in the 90 % set"] = truth in row["credible_set"]
        judged["size of the 90 % set"] = len(row["credible_set"])
    return judged


def intervals_judged(row: Mapping[str, Any], exact: bool) -> dict[str, float]:
    """Shares of the true values inside their 95 % intervals: base parameters, and those of effects rightly named."""
    inside = _inside(row)
    base = [held for name, held in inside.items() if name.startswith(BASE)]
    own = [held for name, held in inside.items() if not name.startswith(BASE)]
    shares = {"intervals, base": base} | ({"intervals, effects": own} if exact else {})
    return {name: float(np.mean(held)) for name, held in shares.items() if held}


def share_inside(row: Mapping[str, Any]) -> float | None:
    """Share of all true values that have a 95 % interval inside it; None where none is known."""
    inside = _inside(row)
    return float(np.mean(list(inside.values()))) if inside else None


def _inside(row: Mapping[str, Any]) -> dict[str, bool]:
    """Parameter -> whether its 95 % interval holds the true value, for those that have both."""
    truth = dict(zip(row.get("parameters") or (), row.get("values") or (), strict=True))
    limits = zip(row.get("interval_of") or (), row.get("low_95") or (), row.get("high_95") or (), strict=True)
    return {name: low <= truth[name] <= high for name, low, high in limits if name in truth}


def reliability(sets: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Bins of what was said: from, to, mean of what was said, share that was right, data sets."""
    pairs = [(s["said"], s["right"]) for s in sets if s.get("said") is not None]
    rows = []
    for low, high in pairwise(EDGES):
        own = [(p, right) for p, right in pairs if low <= p < high or (high == 1.0 and p >= 1.0)]
        if own:
            said, right = np.mean(own, axis=0)
            rows.append({"from": low, "to": high, "said": float(said), "right": float(right), "count": len(own)})
    return rows


def calibration(sets: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Expected calibration error, and how much too sure the middle of the scale is, with their standard errors."""
    rows = reliability(sets)
    total = sum(row["count"] for row in rows)
    if not total:
        return
    error = sum(row["count"] * abs(row["said"] - row["right"]) for row in rows) / total
    yield _measure("calibration error", error, [row["count"] / total for row in rows], rows, total)
    middle = [s for s in sets if s.get("said") is not None and MIDDLE[0] <= s["said"] < MIDDLE[1]]
    if middle:
        said, right = (float(np.mean([s[name] for s in middle])) for name in ("said", "right"))
        own = [{"right": right, "count": len(middle)}]
        yield _measure("said less right, 0.7 to 0.95", abs(said - right), [1.0], own, len(middle))


def _measure(
    name: str, value: float, shares: Sequence[float], rows: Sequence[Mapping[str, Any]], count: int
) -> dict[str, Any]:
    """A row of the cells' table; the standard error is that of the shares that were right, at least of half a set."""
    variances = (max(row["right"] * (1.0 - row["right"]), 0.25 / row["count"]) / row["count"] for row in rows)
    error = sqrt(sum(share**2 * variance for share, variance in zip(shares, variances, strict=True)))
    return {"cell": ALL, "measure": name, "value": value, "standard_error": error, "count": count}
