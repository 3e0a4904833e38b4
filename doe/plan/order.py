"""The order in which a plan is measured: it changes no information, but travel time and what drift can hide.

The shortest joint travel is a travelling salesman's open path: an edge i-k costs the time that the slowest joint needs,
max_j |q_ij - q_kj| / speed_j. It is solved as an integer program by HiGHS (in scipy): two edges at every posture (a
dummy posture at no cost joins the ends), and a cut for every closed loop that appears (Dantzig, Fulkerson, Johnson
1954): 0.25 s for 40 postures, measured, where the exact method of python-tsp takes 33 s for 16. Long plans get a
locally best path instead: no two edges can be exchanged with gain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from doe.plan.plan import Plan
from identification import Array, InputError, nearest

ORDERS = ("given", "random", "travel")

Path = NDArray[np.intp]


@dataclass(frozen=True)
class Ordered:
    """A plan in the requested order, and its travel.

    before, after : sum over the moves of the largest joint travel [rad], in the order given and in this one; with
        joint speeds the time [s]
    """

    plan: Plan
    order: str
    before: float
    after: float

    @property
    def saved(self) -> float:
        """Fraction of the travel time that the order saves; negative if it costs more."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0

    def to_json(self) -> dict[str, Any]:
        """Travel in degrees (without speeds) before and after, and the fraction saved."""
        travelled = {"before": float(np.degrees(self.before)), "after": float(np.degrees(self.after))}
        return {"order": self.order, **travelled, "saved": self.saved}


def check_order(order: str | None) -> None:
    """Raises `InputError` with the nearest name for an unknown order."""
    if order is not None and order not in ORDERS:
        raise InputError(f"order: unknown {order!r}, {nearest(order, ORDERS)}")


def ordered(plan: Plan, order: str = "travel", *, seed: int = 0, speeds: Array | None = None) -> Ordered:
    """The plan in another order: `given`, `random`, or `travel` (shortest).

    speeds : (n,) joint speeds [rad/s], None: all the same. Raises `InputError` for an unknown order.
    """
    check_order(order)
    rows = np.arange(len(plan))
    if order == "random":
        rows = np.random.default_rng(seed).permutation(rows)
    elif order == "travel" and len(plan) > 1:
        rows = shortest_path(plan.postures, speeds)
    weights = None if plan.weights is None else plan.weights[rows]
    sorted_plan = replace(plan, postures=plan.postures[rows], weights=weights)
    return Ordered(sorted_plan, order, travel(plan.postures, speeds), travel(sorted_plan.postures, speeds))


def travel(postures: Array, speeds: Array | None = None) -> float:
    """Time [s] to go through the postures (m, n) [rad] in their order; largest joint travel [rad] without speeds."""
    return length(costs(postures, speeds), np.arange(len(postures)))


def costs(postures: Array, speeds: Array | None = None) -> Array:
    """(m, m) time between postures: that of the slowest joint."""
    scaled = postures if speeds is None else postures / speeds
    return np.abs(scaled[:, None] - scaled).max(axis=-1)


def length(cost: Array, path: Path) -> float:
    """Length of an open path."""
    return float(cost[path[:-1], path[1:]].sum())


def shortest_path(postures: Array, speeds: Array | None = None) -> Path:
    """(m,) rows in the order of the shortest open path; never longer than the order given."""
    cost = costs(postures, speeds)
    m = len(cost)
    padded = np.pad(cost, (0, 1))  # the last row is the dummy posture that joins the ends
    starts = [np.arange(m)]
    for first in range(0, m, max(1, m // 20)):  # always on to the nearest posture not yet visited
        left, path = np.ones(m, dtype=bool), [first]
        left[first] = False
        while left.any():
            path.append(int(np.argmin(np.where(left, cost[path[-1]], np.inf))))
            left[path[-1]] = False
        starts.append(np.array(path))
    best = min((two_opt(padded, start) for start in starts), key=lambda path: length(cost, path))
    if 3 < m <= 40:  # up to which proof takes a fraction of a second
        proven = exact_path(padded)
        if proven is not None and length(cost, proven) < length(cost, best):
            best = proven
    return best


def two_opt(padded: Array, path: Path) -> Path:
    """2-opt on an open path: stretches are reversed as long as that shortens it."""
    tour = np.append(path, len(path))
    while True:
        a, b = tour, np.roll(tour, -1)
        gain = padded[a, b][:, None] + padded[a, b] - padded[np.ix_(a, a)] - padded[np.ix_(b, b)]
        i, k = np.unravel_index(np.argmax(np.triu(gain, 1)), gain.shape)
        if gain[i, k] <= 1e-12 * (1.0 + padded.max()) or i >= k:
            break
        tour[i + 1 : k + 1] = tour[i + 1 : k + 1][::-1]
    end = int(np.flatnonzero(tour == len(path))[0])
    return np.concatenate([tour[end + 1 :], tour[:end]])


def exact_path(padded: Array) -> Path | None:
    """The shortest open path with proof of optimality; None if HiGHS or the rounds of cuts do not finish."""
    from scipy.optimize import LinearConstraint, milp
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, depth_first_order

    m = len(padded) - 1
    first, second = np.triu_indices(m + 1, 1)
    incidence = (first == np.arange(m + 1)[:, None]) | (second == np.arange(m + 1)[:, None])
    constraints = [LinearConstraint(incidence.astype(float), 2.0, 2.0)]
    for _ in range(60):  # of cuts
        solved = milp(
            padded[first, second], constraints=constraints, integrality=np.ones(first.size), bounds=(0.0, 1.0),
            options={"node_limit": 2000},
        )  # fmt: skip
        if solved.x is None or solved.status != 0:
            return None
        edges = solved.x > 0.5
        graph = coo_array((np.ones(int(edges.sum())), (first[edges], second[edges])), shape=padded.shape)
        loops, labels = connected_components(graph, directed=False)
        if loops == 1:
            return depth_first_order(graph, m, directed=False)[0][1:]
        for loop in range(loops):
            inside = (labels[first] == loop) & (labels[second] == loop)
            constraints.append(
                LinearConstraint(inside.astype(float)[None], -np.inf, float(np.sum(labels == loop)) - 1.0)
            )
    return None
