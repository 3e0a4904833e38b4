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
    """What moves keep free, and where they may go.

    margin : of postures (m, n) the margins (m, k) [mm], which are to be >= 0
    levers : (k, n) [mm/rad, 1] how much at most each margin changes by a unit of each joint
    lower, upper : (n,) limits [rad, mm];  units : (n,) what counts as one radian of each joint
    """

    margin: Callable[[Array], Array]
    levers: Array
    lower: Array
    upper: Array
    units: Array

    def travel(self, starts: Array, ends: Array) -> Array:
        """(...) [rad] what the joint that moves most has to go from postures (..., n) to others."""
        return np.asarray(np.abs((ends - starts) / self.units).max(axis=-1))

    def length(self, way: Array) -> float:
        """[rad] travel along a way (v, n)."""
        return float(self.travel(way[:-1], way[1:]).sum())

    def free(self, starts: Array, ends: Array, levels: int | None = None, narrowest: float = 0.5) -> NDArray[np.bool_]:
        """(m,) whether the straight moves from postures (m, n) to postures (m, n) are proven to be free.

        levels : after so many halvings all count as free that nothing was found in the way of; None: until proven
        narrowest : [mm] of the way of a body, below which a stretch is not halved again
        """
        ends_once, number = np.unique(np.concatenate([starts, ends]), axis=0, return_inverse=True)
        before, after = np.split(self.margin(ends_once)[number.reshape(-1)], 2)
        proven = np.all((before >= 0.0) & (after >= 0.0), axis=1)
        first, last, move, level = np.asarray(starts), np.asarray(ends), np.arange(len(starts)), 0
        while len(move) and level != levels:
            ways = np.abs(last - first) @ self.levers.T
            near = before + after < ways
            proven[move[np.any(near & (ways < narrowest), axis=1)]] = False
            left = np.any(near, axis=1) & proven[move]
            move, first, last, before, after = (each[left] for each in (move, first, last, before, after))
            middle, level = 0.5 * (first + last), level + 1
            between = self.margin(middle)
            proven[move[np.any(between < 0.0, axis=1)]] = False
            first, last = np.concatenate([first, middle]), np.concatenate([middle, last])
            before, after = np.concatenate([before, between]), np.concatenate([between, after])
            move = np.tile(move, 2)
        return proven


class Route(NamedTuple):
    """The order of a plan's postures (m, n), and the moves between them.

    rows : (m,) of the plan, in the order of measurement;  ways : of each the (v, n) way-points that lead to it, and it
    unreached : rows of the plan to which no free way was found from most of the others
    """

    rows: Numbers
    ways: list[Array]
    unreached: list[int]


class Roadmap:
    """Postures, and moves between them that nothing is known to be in the way of.

    nodes : (M, n), the plan's postures first;  aims : (m,) nodes by which these are approached, or themselves
    length : (M, M) [rad] of the moves of a node and a later one, inf of those that are seen to collide, NaN where
        nobody has looked;  proven : (M, M) whether they are proven to be free
    """

    def __init__(self, room: Room, postures: Array, entries: Array) -> None:
        self.room, self.nodes = room, np.empty((0, len(room.units)))
        self.length, self.proven = np.empty((0, 0)), np.empty((0, 0), dtype=bool)
        self.starts, entered = self.add(postures), np.flatnonzero(~np.isnan(entries[:, 0]))
        self.aims = self.starts.copy()
        self.aims[entered] = self.add(entries[entered])
        self.proven[self.starts, self.aims] = True
        self.length[self.starts, self.aims] = room.travel(postures, self.nodes[self.aims]) + 1e-9

    def add(self, nodes: Array) -> Numbers:
        """Numbers of new nodes (k, n), without a move to them."""
        old, new = len(self.nodes), (0, len(nodes))
        self.nodes = np.concatenate([self.nodes, nodes])
        self.length, self.proven = np.pad(self.length, new, constant_values=np.nan), np.pad(self.proven, new)
        return np.arange(old, len(self.nodes))

    def connect(self, *pairs: tuple[Numbers, Numbers], levels: int | None = 2) -> None:
        """Looks for moves between nodes (e,) and others, of which nobody has looked.

        levels : as `Room.free` has them; None: proves those that are known, or forgets them
        """
        low, high = np.unique(np.sort(np.concatenate([np.stack(each) for each in pairs], axis=1), axis=0), axis=1)
        wanted = (low < high) & (np.isnan(self.length[low, high]) if levels else ~self.proven[low, high])
        low, high = low[wanted], high[wanted]
        starts, ends = self.nodes[low], self.nodes[high]
        good = self.room.free(starts, ends, levels)
        self.length[low, high] = np.where(good, self.room.travel(starts, ends) + 1e-9, np.inf)
        self.proven[low, high] = good & (levels is None)

    def shortest(self, keep_order: bool) -> tuple[Numbers, list[list[int]], Numbers]:
        """The shortest route whose moves are all proven: its order, the nodes of each of the m - 1 steps, and which of
        the m no way leads to from most of the others."""
        from scipy.sparse.csgraph import dijkstra

        order = self.starts
        while True:
            # (m, M) of the shortest ways to every node, and the nodes before it
            length, before = dijkstra(self.length, directed=False, indices=self.starts, return_predecessors=True)
            cost = length[:, self.aims]
            reached = np.isfinite(cost)
            if not keep_order:
                cost = np.where(reached, cost, 1.0 + 2.0 * cost[reached].sum())  # more than any order
                order = shortest_path(np.maximum(cost, cost.T))
                if np.any(self.aims != self.starts) and order[0] > order[-1]:  # which way round it is gone matters
                    order = order[::-1]
            ways = []
            for one, other in pairwise(order.tolist()):
                way = [int(self.aims[other])]
                while reached[one, other] and way[-1] != one:
                    way.append(int(before[one, way[-1]]))
                ways.append(way[::-1] if reached[one, other] else [one, way[0]])
            one, other = np.sort(
                np.array([pair for way in ways for pair in pairwise(way)], dtype=int).reshape(-1, 2), axis=1
            ).T
            left = np.isfinite(self.length[one, other]) & ~self.proven[one, other]
            if not left.any():
                label = reached.argmax(axis=1)
                return order, ways, np.flatnonzero(label != np.bincount(label).argmax())
            self.connect((one[left], other[left]), levels=None)


def route(postures: Array, room: Room, entries: Array | None = None, keep_order: bool = False, seed: int = 0) -> Route:
    """The shortest order of postures (m, n) with free moves, with way-points where there is no other.

    entries : (m, n) from which each is approached, as the last way-point; None, or NaN: from anywhere
    keep_order : the postures stay in their order

    The map gets random nodes if straight moves are much longer than with nothing in the way, and again, from a wider
    and wider space, as long as some posture is not reached.
    """
    spread, rounds, neighbors = 200, 4, 12  # effort: random nodes at once, how often, and moves that are tried of each
    m, generator = len(postures), np.random.default_rng(seed)
    entries = np.full_like(postures, np.nan) if entries is None else entries
    road = Roadmap(room, postures, entries)
    starts, aims = road.starts, road.aims
    road.connect((starts[:-1], aims[1:]) if keep_order else (np.repeat(starts, m), np.tile(aims, m)))
    ideal = room.travel(postures[:, None], road.nodes[aims])
    around = starts if keep_order else shortest_path(np.maximum(ideal, ideal.T))
    enough = 1.1 * ideal[around[:-1], around[1:]].sum()
    order, ways, missing = road.shortest(keep_order)
    for beyond in 0.3 * 3.0 ** np.arange(rounds):  # [rad] the postures
        if not len(missing) and sum(room.length(road.nodes[way]) for way in ways) <= enough:
            break
        enough = np.inf
        low = np.maximum(postures.min(axis=0) - beyond * room.units, room.lower)
        high = np.minimum(postures.max(axis=0) + beyond * room.units, room.upper)
        drawn = generator.uniform(low, high, (spread, len(low)))
        about = road.nodes[generator.choice(missing if len(missing) else aims, spread)]
        drawn[::2] = (about + 0.3 * generator.random((spread, 1)) * (drawn - about))[::2]
        fresh = np.r_[road.add(drawn[np.all(room.margin(drawn) >= 0.0, axis=1)]), starts, aims]
        apart = room.travel(road.nodes[fresh][:, None], road.nodes)
        nearest = np.argsort(apart, axis=1, kind="stable")[:, 1 : neighbors + 1]
        road.connect((np.repeat(fresh, nearest.shape[1]), nearest.ravel()))
        order, ways, missing = road.shortest(keep_order)
    for share in (0.7, 0.7, 0.5, 0.5):  # of the way from a bend to the straight line
        bends = [way[k - 1 : k + 2] for way in ways for k in range(1, len(way) - 1)]
        if not bends:
            break
        before, here, after = np.array(bends).T
        straight = 0.5 * (road.nodes[before] + road.nodes[after])
        new = road.add(road.nodes[here] + share * (straight - road.nodes[here]))
        road.connect((before, new), (new, after), (before, after), (new[:-1], new[1:]), (new, here))
        order, ways, missing = road.shortest(keep_order)
    steps = [[int(aims[order[0]])], *(way[1:] for way in ways)]
    steps = [step if step[-1] == row else [*step, row] for step, row in zip(steps, order.tolist(), strict=True)]
    return Route(order, [road.nodes[step] for step in steps], sorted(missing.tolist()))


def approaches(postures: Array, senses: Array, room: Room, generator: np.random.Generator, tries: int = 40) -> Array:
    """(m, n) way-points from which each joint moves in its sense, (m, n) of +1 and -1, to postures (m, n); NaN of a
    posture to which none leads, of so many, 0.2 to 3 times as far as is usual."""
    m, n = postures.shape
    steps = np.concatenate([np.full((1, m, n), APPROACH), generator.uniform(0.2, 3.0, (tries, m, n)) * APPROACH])
    begun = postures - senses * room.units * steps  # (tries + 1, m, n)
    good = np.all((begun >= room.lower) & (begun <= room.upper), axis=2)
    good[good] = room.free(begun[good], np.broadcast_to(postures, begun.shape)[good])
    return np.where(good.any(axis=0)[:, None], begun[good.argmax(axis=0), np.arange(m)], np.nan)
