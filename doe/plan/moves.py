"""Moves between the postures of a plan: straight in the joints, free of collisions, short.

*A move that is proven.* No pair k of bodies comes nearer or gets farther apart than by

    sum_j L_kj |q_j - q'_j|

between two postures, L_kj being its lever about joint j [mm/rad]. So a pair that is r and r' apart at the ends of a
stretch keeps (r + r' - sum_j L_kj |q_j - q'_j|) / 2 all along it; where that is below zero, the stretch is halved
(F. Schwarzer, M. Saha, J.-C. Latombe, "Adaptive dynamic collision checking for single and multiple articulated robots",
IEEE Trans. Robotics 21 (2005) 338-353). The stretches of all moves are evaluated at once, level by level. What becomes
too short to go on counts as not free: nothing here is sampled and hoped for.

*A road map.* The postures, and random ones to go by, are nodes; moves between those that are near each other are edges,
as long as nothing is found in their way at a few places (L. Kavraki, P. Svestka, J.-C. Latombe, M. Overmars,
"Probabilistic roadmaps for path planning in high-dimensional configuration spaces", IEEE Trans. Robotics and Automation
12 (1996) 566-580). The route is the shortest open path through all postures (`doe.plan.plan`) along the map. Only its
moves are proven; those that collide leave the map, and the route is sought again (R. Bohlin, L. Kavraki, "Path planning
using lazy PRM", ICRA 2000). At last nodes are added where it bends, nearer to straight, and it is pulled tight.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from doe.plan.plan import shortest_path
from identification import Array

Numbers = NDArray[np.intp]
APPROACH = float(np.radians(3.0))  # more than any backlash


class Room(NamedTuple):
    """What moves keep free.

    margin : of postures (m, n) the margins (m, k) [mm], which are to be >= 0
    levers : (k, n) [mm/rad, 1] how much at most each margin changes by a unit of each joint
    allows : whether postures (m, n) may be way-points
    """

    margin: Callable[[Array], Array]
    levers: Array
    allows: Callable[[Array], NDArray[np.bool_]]


class Space(NamedTuple):
    """Where way-points may be: (n,) limits [rad, mm], and what counts as one radian of each joint."""

    lower: Array
    upper: Array
    units: Array

    def travel(self, starts: Array, ends: Array) -> Array:
        """(...) [rad] what the joint that moves most has to go from postures (..., n) to others."""
        return np.asarray(np.abs((ends - starts) / self.units).max(axis=-1))

    def length(self, way: Array) -> float:
        """[rad] travel along a way (v, n)."""
        return float(self.travel(way[:-1], way[1:]).sum())


def free(
    starts: Array, ends: Array, room: Room, levels: int | None = None, narrowest: float = 0.5
) -> NDArray[np.bool_]:
    """(m,) whether the straight moves from postures (m, n) to postures (m, n) are proven to be free.

    levels : after so many halvings all count as free that nothing was found in the way of; None: until proven
    narrowest : [mm] of the way of a body, below which a stretch is not halved again
    """
    ends_once, number = np.unique(np.concatenate([starts, ends]), axis=0, return_inverse=True)
    first, last = np.asarray(starts), np.asarray(ends)
    before, after = np.split(room.margin(ends_once)[number.reshape(-1)], 2)
    proven = np.all((before >= 0.0) & (after >= 0.0), axis=1)
    move, level = np.arange(len(first)), 0
    while len(move) and level != levels:
        ways = np.abs(last - first) @ room.levers.T
        near = before + after < ways
        proven[move[np.any(near & (ways < narrowest), axis=1)]] = False
        left = np.any(near, axis=1) & proven[move]
        move, first, last, before, after = (each[left] for each in (move, first, last, before, after))
        middle, level = 0.5 * (first + last), level + 1
        between = room.margin(middle)
        proven[move[np.any(between < 0.0, axis=1)]] = False
        first, last = np.concatenate([first, middle]), np.concatenate([middle, last])
        before, after = np.concatenate([before, between]), np.concatenate([between, after])
        move = np.tile(move, 2)
    return proven


class Roadmap:
    """Postures, and moves between them that nothing is known to be in the way of.

    nodes : (M, n);  length : (M, M) [rad] of the moves of a node and a later one, inf of those that are seen to
    collide, NaN where nobody has looked;  proven : (M, M) whether they are proven to be free
    """

    def __init__(self, room: Room, space: Space) -> None:
        self.room, self.space, self.nodes = room, space, np.empty((0, len(space.units)))
        self.length, self.proven = np.empty((0, 0)), np.empty((0, 0), dtype=bool)

    def add(self, nodes: Array) -> Numbers:
        """Numbers of new nodes (k, n), without a move to them."""
        old, new = len(self.nodes), (0, len(nodes))
        self.nodes = np.concatenate([self.nodes, nodes])
        self.length, self.proven = np.pad(self.length, new, constant_values=np.nan), np.pad(self.proven, new)
        return np.arange(old, len(self.nodes))

    def connect(self, *pairs: tuple[Numbers, Numbers], levels: int | None = 2) -> None:
        """Looks for moves between nodes (e,) and others, of which nobody has looked.

        levels : as `free` has them; None: proves those that are known, or forgets them
        """
        low, high = np.unique(np.sort(np.concatenate([np.stack(each) for each in pairs], axis=1), axis=0), axis=1)
        wanted = (low < high) & (np.isnan(self.length[low, high]) if levels else ~self.proven[low, high])
        low, high = low[wanted], high[wanted]
        starts, ends = self.nodes[low], self.nodes[high]
        good = free(starts, ends, self.room, levels)
        self.length[low, high] = np.where(good, self.space.travel(starts, ends) + 1e-9, np.inf)
        self.proven[low, high] = good & (levels is None)


class Route(NamedTuple):
    """The order of a plan's postures (m, n), and the moves between them.

    rows : (m,) of the plan, in the order of measurement;  vias : of each the (v, n) way-points on the way to it
    unreached : rows of the plan to which no free way was found from most of the others
    """

    rows: Numbers
    vias: list[Array]
    unreached: list[int]


def route(
    postures: Array,
    room: Room,
    space: Space,
    *,
    entries: Array | None = None,
    keep_order: bool = False,
    seed: int = 0,
    spread: int = 200,
    rounds: int = 4,
) -> Route:
    """The shortest order of postures (m, n) with free moves, with way-points where there is no other.

    entries : (m, n) from which each is approached, as the last way-point; None: from anywhere
    keep_order : the postures stay in their order
    spread : random nodes that the map gets if straight moves are much longer than with nothing in the way, and again,
        at most in so many rounds, as long as some posture is not reached
    """
    m, generator, road = len(postures), np.random.default_rng(seed), Roadmap(room, space)
    starts = road.add(postures)
    aims = starts if entries is None else road.add(entries)
    road.proven[starts, aims], road.length[starts, aims] = True, space.travel(postures, road.nodes[aims]) + 1e-9
    road.connect((starts[:-1], aims[1:]) if keep_order else (np.repeat(starts, m), np.tile(aims, m)))
    ideal = space.travel(postures[:, None], road.nodes[aims])
    order, ways, missing = settled(road, starts, aims, keep_order)
    around = np.arange(m) if keep_order else shortest_path(np.maximum(ideal, ideal.T))
    shortest = 1.1 * ideal[around[:-1], around[1:]].sum()
    for k in range(rounds):
        if not len(missing) and sum(space.length(road.nodes[way]) for way in ways) <= shortest:
            break
        beyond = 0.3 * 3.0**k * space.units  # the postures
        low, high = postures.min(axis=0) - beyond, postures.max(axis=0) + beyond
        low, high = np.maximum(low, space.lower), np.minimum(high, space.upper)
        drawn = generator.uniform(low, high, (spread, len(low)))
        about = road.nodes[generator.choice(missing if len(missing) else aims, spread)]
        drawn[::2] = (about + 0.3 * generator.random((spread, 1)) * (drawn - about))[::2]
        fresh = np.r_[road.add(drawn[room.allows(drawn)]), starts, aims]
        apart = space.travel(road.nodes[fresh][:, None], road.nodes)
        nearest = np.argsort(apart, axis=1, kind="stable")[:, 1:13]  # a dozen of each
        road.connect((np.repeat(fresh, nearest.shape[1]), nearest.ravel()))
        order, ways, missing = settled(road, starts, aims, keep_order)
        shortest = np.inf
    for share in (0.7, 0.7, 0.5, 0.5):  # of the way from a bend to the straight line
        bends = [(way[k - 1], way[k], way[k + 1]) for way in ways for k in range(1, len(way) - 1)]
        if not bends:
            break
        before, here, after = np.array(bends, dtype=np.intp).reshape(-1, 3).T
        straight = 0.5 * (road.nodes[before] + road.nodes[after])
        moved = road.nodes[here] + share * (straight - road.nodes[here])
        good = room.allows(moved)
        new, before, after, here = road.add(moved[good]), before[good], after[good], here[good]
        road.connect((before, new), (new, after), (before, after), (new[:-1], new[1:]), (new, here))
        order, ways, missing = settled(road, starts, aims, keep_order)
    vias = [road.nodes[way[1:-1]] for way in ([0, 0], *ways)]
    if entries is not None:
        vias = [np.vstack([via, entries[row]]) for via, row in zip(vias, order, strict=True)]
    return Route(order, vias, sorted(missing.tolist()))


def settled(
    road: Roadmap, starts: Numbers, aims: Numbers, keep_order: bool
) -> tuple[Numbers, list[list[int]], Numbers]:
    """The shortest route from nodes (m,) to nodes (m,) whose moves are all proven: its order, the nodes of each of the
    m - 1 steps, and which of the m no way leads to from most of the others."""
    from scipy.sparse.csgraph import dijkstra

    m = len(starts)
    while True:
        # (m, M) of the shortest ways to every node, and the nodes before it
        length, before = dijkstra(road.length, directed=False, indices=starts, return_predecessors=True)
        cost = length[:, aims]
        reached = np.isfinite(cost)
        order = np.arange(m)
        if not keep_order:
            worst = 1.0 + 2.0 * cost[reached].sum()  # than any order
            cost = np.where(reached, cost, worst)
            order = shortest_path(np.maximum(cost, cost.T))
            if starts is not aims and order[0] > order[-1]:  # which way round it is gone matters
                order = order[::-1]
        ways = []
        for one, other in pairwise(order.tolist()):
            way = [int(aims[other])]
            while reached[one, other] and way[-1] != starts[one]:
                way.append(int(before[one, way[-1]]))
            ways.append(way[::-1] if reached[one, other] else [int(starts[one]), int(aims[other])])
        moves = np.array([pair for way in ways for pair in pairwise(way)], dtype=np.intp).reshape(-1, 2)
        one, other = np.sort(moves, axis=1).T
        left = np.isfinite(road.length[one, other]) & ~road.proven[one, other]
        if not left.any():
            label = reached.argmax(axis=1)
            return order, ways, np.flatnonzero(label != np.bincount(label).argmax())
        road.connect((one[left], other[left]), levels=None)


def approaches(
    postures: Array, senses: Array, room: Room, space: Space, generator: np.random.Generator, tries: int = 40
) -> Array:
    """(m, n) way-points from which each joint moves in its sense, (m, n) of +1 and -1, to postures (m, n); NaN of a
    posture to which none leads, of so many, 0.2 to 3 times as far as is usual."""
    m, n = postures.shape
    steps = np.concatenate([np.full((1, m, n), APPROACH), generator.uniform(0.2, 3.0, (tries, m, n)) * APPROACH])
    starts = (postures - senses * space.units * steps).reshape(-1, n)
    within = np.all((starts >= space.lower) & (starts <= space.upper), axis=1)
    good = np.zeros(len(starts), dtype=bool)
    good[within] = free(starts[within], np.tile(postures, (tries + 1, 1))[within], room)
    first = np.argmax(good.reshape(-1, m), axis=0)
    found = starts.reshape(-1, m, n)[first, np.arange(m)]
    found[~np.any(good.reshape(-1, m), axis=0)] = np.nan
    return found
