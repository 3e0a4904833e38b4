"""The order of measurement.

It changes no information, but travel time and what drift can hide. The shortest joint travel is a travelling salesman's
open path: an edge i-k costs the time that the slowest joint needs, max_j |q_ij - q_kj| / speed_j. It is solved as an
integer program by HiGHS (in scipy): two edges at every posture (a dummy posture at no cost joins the ends), and a cut
for every closed loop that appears (Dantzig, Fulkerson, Johnson 1954). Long plans get a locally best path instead: no
two edges can be exchanged with gain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from identification import Array

Path = NDArray[np.intp]


def shortest_path(cost: Array, proof: bool = True) -> Path:
    """(m,) rows in the order of the shortest open path by the costs (m, m) of edges; never longer than that given.

    proof : of few rows it is the shortest; else, in a fraction of the time, one that is hardly longer
    """
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
    paths = [_two_opt(padded, start) for start in starts]
    # up to where proof takes a fraction of a second
    if proof and 3 < m <= 40 and (proven := _exact_path(padded)) is not None:
        paths.append(proven)
    return min(paths, key=lambda path: float(cost[path[:-1], path[1:]].sum()))


def _two_opt(padded: Array, path: Path) -> Path:
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


def _exact_path(padded: Array) -> Path | None:
    """The shortest open path with proof of optimality; None if HiGHS or the rounds of cuts do not finish."""
    from scipy.optimize import LinearConstraint, milp
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, depth_first_order

    m = len(padded) - 1
    first, second = np.triu_indices(m + 1, 1)
    incidence = (first == np.arange(m + 1)[:, None]) | (second == np.arange(m + 1)[:, None])
    constraints = [LinearConstraint(incidence.astype(float), 2.0, 2.0)]
    whole, effort = np.ones(first.size), {"node_limit": 2000}
    for _ in range(60):  # of cuts
        solved = milp(padded[first, second], constraints=constraints, integrality=whole, bounds=(0, 1), options=effort)
        if solved.x is None or solved.status != 0:
            return None
        edges = solved.x > 0.5
        graph = coo_array((np.ones(int(edges.sum())), (first[edges], second[edges])), shape=padded.shape)
        loops, labels = connected_components(graph, directed=False)
        if loops == 1:
            return depth_first_order(graph, m, directed=False)[0][1:]
        for loop in range(loops):
            inside = ((labels[first] == loop) & (labels[second] == loop)).astype(float)
            constraints.append(LinearConstraint(inside[None], -np.inf, float(np.sum(labels == loop)) - 1.0))
    return None
