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
from doe.problem.problem import Stop, never
from identification import Array

Numbers = NDArray[np.intp]
APPROACH = float(np.radians(3.0))  # more than any backlash
NARROWEST = 0.5  # [mm] of the way of a body, below which a stretch is not halved again


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

    def free(self, starts: Array, ends: Array, levels: int | None = None) -> NDArray[np.bool_]:
        """(m,) whether the straight moves from postures (m, n) to postures (m, n) are proven to be free.

        levels : after so many halvings all count as free that nothing was found in the way of; None: until proven
        """
        ends_once, number = np.unique(np.concatenate([starts, ends]), axis=0, return_inverse=True)
        before, after = np.split(self.margin(ends_once)[number.reshape(-1)], 2)
        proven = np.all((before >= 0.0) & (after >= 0.0), axis=1)
        first, last, move, level = np.asarray(starts), np.asarray(ends), np.arange(len(starts)), 0
        while len(move) and level != levels:
            ways = np.abs(last - first) @ self.levers.T
            near = before + after < ways
            proven[move[np.any(near & (ways < NARROWEST), axis=1)]] = False
            left = np.any(near, axis=1) & proven[move]
            move, first, last, before, after = (each[left] for each in (move, first, last, before, after))
            middle, level = 0.5 * (first + last), level + 1
            between = self.margin(middle)
            proven[move[np.any(between < 0.0, axis=1)]] = False
            first, last = np.concatenate([first, middle]), np.concatenate([middle, last])
            before, after = np.concatenate([before, between]), np.concatenate([between, after])
            move = np.tile(move, 2)
        return proven


class Roadmap:
    """Nodes (M, n), and the moves between them that nothing is known to be in the way of.

    length : (M, M) [rad] of the moves of a node and a later one, inf where there is none;  proven : (M, M) which of
        them are proven to be free
    """

    def __init__(self, room: Room) -> None:
        self.room, self.nodes = room, np.empty((0, len(room.units)))
        self.length, self.proven = np.empty((0, 0)), np.empty((0, 0), dtype=bool)

    def add(self, nodes: Array, neighbors: int, *moves: Numbers) -> None:
        """More nodes (k, n), with moves to so many of the nearest, from those that have them among their nearest, and
        from nodes (e,) to others (e,), unless a few places on the way collide."""
        old, new = len(self.nodes), (0, len(nodes))
        self.nodes, self.proven = np.concatenate([self.nodes, nodes]), np.pad(self.proven, new)
        self.length = np.pad(self.length, new, constant_values=np.inf)
        apart = self.room.travel(self.nodes[:, None], self.nodes) + 1e-9
        near = apart <= np.sort(apart, axis=1)[:, : neighbors + 1].max(axis=1, initial=0.0)[:, None]
        near[moves or ([], [])] = True
        low, high = np.nonzero(np.triu(near | near.T, 1))
        low, high = low[high >= old], high[high >= old]
        free = self.room.free(self.nodes[low], self.nodes[high], levels=2)
        self.length[low, high] = np.where(free, apart[low, high], np.inf)

    def shortest(self, aims: Numbers, keep_order: bool, stop: Stop) -> tuple[Numbers, list[list[int]], Numbers]:
        """The shortest route whose moves are all proven through the first m nodes, each by its aim (m,): its order, the
        nodes of each of the m - 1 steps, and which of the m no way leads to from most of the others."""
        from scipy.sparse.csgraph import dijkstra

        order = np.arange(len(aims))
        while True:
            # (m, M) of the shortest ways to every node, and the nodes before it
            length, before = dijkstra(self.length, directed=False, indices=range(len(aims)), return_predecessors=True)
            cost = length[:, aims]
            reached = np.isfinite(cost)
            if not keep_order:
                cost = np.where(reached, cost, 1.0 + 2.0 * cost[reached].sum())  # more than any order
                order = shortest_path(np.maximum(cost, cost.T))
            ways = []
            for one, other in pairwise(order.tolist()):
                way = [int(aims[other])]
                while reached[one, other] and way[-1] != one:
                    way.append(int(before[one, way[-1]]))
                ways.append(way[::-1] if reached[one, other] else [one, way[0]])
            moves = np.array([pair for way in ways for pair in pairwise(way)], dtype=int).reshape(-1, 2)
            low, high = np.unique(np.sort(moves, axis=1), axis=0).T
            doubtful = np.isfinite(self.length[low, high]) & ~self.proven[low, high]
            if not doubtful.any() or stop():
                label = reached.argmax(axis=1)
                return order, ways, np.flatnonzero(label != np.bincount(label).argmax())
            low, high = low[doubtful], high[doubtful]
            self.proven[low, high] = free = self.room.free(self.nodes[low], self.nodes[high])
            self.length[low[~free], high[~free]] = np.inf


def route(
    postures: Array,
    room: Room,
    entries: Array | None = None,
    keep_order: bool = False,
    seed: int = 0,
    stop: Stop = never,
) -> tuple[Numbers, list[Array], list[int]]:
    """The shortest order of postures (m, n) with free moves, with way-points where there is no other: their rows (m,)
    in the order of measurement; of each the (v, n) way-points that lead to it, and it; and the rows to which no free
    way leads from most of the others.

    entries : (m, n) from which each is approached, as the last way-point; None, or NaN: from anywhere
    keep_order : the postures stay in their order
    stop : ends the search; moves that are left unproven then may collide

    The map gets random nodes if straight moves are much longer than with nothing in the way, and again, from a wider
    and wider space, as long as some posture is not reached.
    """
    spread, rounds, neighbors = 200, 4, 12  # effort: random nodes at once, how often, and moves that are tried of each
    generator, rows = np.random.default_rng(seed), np.arange(len(postures))
    entries = postures[:0] if entries is None else np.where(np.isnan(entries), postures, entries)
    road, aims = Roadmap(room), rows + len(entries)
    everywhere = neighbors if keep_order else 2 * len(rows)
    road.add(np.concatenate([postures, entries]), everywhere, rows[:-1], aims[1:])
    road.proven[rows, aims] = True
    road.length[rows, aims] = room.travel(postures, road.nodes[aims]) + 1e-9
    ideal = room.travel(postures[:, None], road.nodes[aims])
    around = rows if keep_order else shortest_path(np.maximum(ideal, ideal.T))
    enough = 1.1 * ideal[around[:-1], around[1:]].sum()
    order, ways, missing = road.shortest(aims, keep_order, stop)
    for beyond in 0.3 * 3.0 ** np.arange(rounds):  # [rad] the postures
        if stop() or (not len(missing) and sum(room.length(road.nodes[way]) for way in ways) <= enough):
            break
        enough = np.inf
        low = np.maximum(postures.min(axis=0) - beyond * room.units, room.lower)
        high = np.minimum(postures.max(axis=0) + beyond * room.units, room.upper)
        drawn = generator.uniform(low, high, (spread, len(low)))
        about = road.nodes[generator.choice(missing if len(missing) else aims, spread)]
        drawn[::2] = (about + 0.3 * generator.random((spread, 1)) * (drawn - about))[::2]
        road.add(drawn[np.all(room.margin(drawn) >= 0.0, axis=1)], neighbors)
        order, ways, missing = road.shortest(aims, keep_order, stop)
    steps = [road.nodes[aims[order[:1]]], *(tightened(road.nodes[way], room)[1:] for way in ways)]
    alike = np.all(road.nodes[aims] == postures, axis=1)
    steps = [step if alike[row] else np.vstack([step, postures[row]]) for step, row in zip(steps, order, strict=True)]
    return order, steps, missing.tolist()


def tightened(way: Array, room: Room) -> Array:
    """A way (v, n) with its bends nearer to straight lines, or without them, as far as the moves stay free."""
    for share in (1.0, 0.7, 0.5):  # of the way from a bend to the straight line
        for bend in range(len(way) - 2, 0, -1):
            first, here, last = way[bend - 1 : bend + 2]
            nearer = here + share * (0.5 * (first + last) - here)
            if room.free(np.array([first, nearer]), np.array([nearer, last])).all():
                way[bend] = nearer
                way = np.delete(way, bend, axis=0) if share == 1.0 else way
    return way


def approaches(postures: Array, senses: Array, room: Room, generator: np.random.Generator, tries: int = 40) -> Array:
    """(m, n) way-points from which each joint moves in its sense, (m, n) of +1 and -1, to postures (m, n); NaN of a
    posture to which none leads, of so many, a ninth to 3 times as far as is usual."""
    m, n = postures.shape
    steps = APPROACH * 3.0 ** np.concatenate([np.zeros((1, m, n)), generator.uniform(-2.0, 1.0, (tries, m, n))])
    begun = postures - senses * room.units * steps  # (tries + 1, m, n)
    good = np.all((begun >= room.lower) & (begun <= room.upper), axis=2)
    good[good] = room.free(begun[good], np.broadcast_to(postures, begun.shape)[good])
    return np.where(good.any(axis=0)[:, None], begun[good.argmax(axis=0), np.arange(m)], np.nan)
