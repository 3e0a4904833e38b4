"""Moves between the postures of a plan: straight in the joints, free of collisions, short.

*A move that is proven.* No pair k of bodies comes nearer or gets farther apart than by

    sum_j L_kj |q_j - q'_j|

between two postures, L_kj being its lever about joint j [mm/rad]. So a pair that is r and r' apart at the ends of a
stretch keeps (r + r' - sum_j L_kj |q_j - q'_j|) / 2 all along it; where that is below zero, the stretch is halved
(F. Schwarzer, M. Saha, J.-C. Latombe, "Adaptive dynamic collision checking for single and multiple articulated robots",
IEEE Trans. Robotics 21 (2005) 338-353). The stretches of all moves are evaluated at once, level by level. What becomes
too short to go on counts as not free: nothing here is sampled and hoped for.

*The order* is the shortest open path (`doe.plan.plan`). Most moves are never looked at: those of the shortest path are,
the ones that collide count more, and again, until none does, or those that do are worth a way round.

*A way round* is found by a random tree from each end of a move, which grow a few postures at a time, until one of them
can be reached from both (J. J. Kuffner, S. M. LaValle, "RRT-Connect", ICRA 2000); what lies on the way becomes
way-points, pulled straight as far as they can be. From then on the move counts as long as that is, so that no order of
straight moves is shorter than what is found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from doe.plan.plan import shortest_path
from identification import Array

COARSE = 4  # levels at which all margins are looked at together: up to 16 stretches of a move
NARROWEST = 0.5  # [mm] of the way of a body, below which a stretch is not halved again
CLOUD, FEW, GROWTHS = 60, 12, 10  # postures of a cloud, those tried at once, and clouds before a move is given up
ALONE = 3  # growths after which an end from which nothing was reached is given up
NEAR = 0.2  # of the joints' ranges: how far about a straight move the first cloud lies; each next one twice as far
APPROACH, TRIES = float(np.radians(3.0)), 40  # more than any backlash; how many others are tried, 0.2 to 3 times as far
NEIGHBOURS = 5  # of a posture with a move that collides, to which moves are looked at in advance
DETOUR = 2.0  # times the travel of a straight move that collides, till the way round is known: few are asked for
PULLS = 3  # times that the way-points of a detour are pulled straight


class Room(NamedTuple):
    """What moves keep free.

    margin : of postures (m, n) the margins (m, k) [mm], which are to be >= 0
    levers : (k, n) [mm/rad, 1] how much at most each margin changes by a unit of each joint
    allows : whether postures (m, n) may be way-points
    alone : number of a margin -> what gives it alone, (m, 1);  often : those that are below zero most often
    """

    margin: Callable[[Array], Array]
    levers: Array
    allows: Callable[[Array], NDArray[np.bool_]]
    alone: Callable[[int], Callable[[Array], Array]]
    often: Sequence[int] = ()


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


class Stretches(NamedTuple):
    """Parts of moves: numbers (s,) of the moves, ends (s, n), and margins (s, k) at both ends."""

    move: NDArray[np.intp]
    first: Array
    last: Array
    before: Array
    after: Array

    def of(self, rows: NDArray[np.bool_]) -> Stretches:
        """Some of them."""
        return Stretches(self.move[rows], self.first[rows], self.last[rows], self.before[rows], self.after[rows])


def free(starts: Array, ends: Array, room: Room) -> NDArray[np.bool_]:
    """(m,) whether the straight moves from postures (m, n) to postures (m, n) are proven to be free."""
    starts, ends = np.asarray(starts), np.asarray(ends)
    before, after = np.split(room.margin(np.concatenate([starts, ends])), 2)
    proven = np.all((before >= 0.0) & (after >= 0.0), axis=1)
    left = Stretches(np.arange(len(starts)), starts, ends, before, after)

    def by_pair(k: int, levels: int | None = None) -> None:
        here = np.s_[:, k : k + 1]
        pair = left._replace(before=left.before[here], after=left.after[here])
        halved(pair.of(proven[left.move]), proven, room.alone(k), room.levers[k : k + 1], levels)

    for k in room.often:  # most moves that collide are found by few pairs, and one takes less time than all
        by_pair(k, COARSE)
    left = halved(left.of(proven), proven, room.margin, room.levers, COARSE)
    for k in range(len(room.levers)):  # few are near each other for long
        by_pair(k)
    return proven


def halved(
    left: Stretches,
    proven: NDArray[np.bool_],
    margin: Callable[[Array], Array],
    levers: Array,
    levels: int | None = None,
) -> Stretches:
    """The stretches of which nothing is proven yet after so many levels, None: after all; moves that collide, or whose
    stretches become too short, are no longer `proven`."""
    level = 0
    while True:
        ways = np.abs(left.last - left.first) @ levers.T
        near = left.before + left.after < ways
        proven[left.move[np.any(near & (ways < NARROWEST), axis=1)]] = False
        left = left.of(np.any(near, axis=1) & proven[left.move])
        if not len(left.move) or level == levels:
            return left
        middle = 0.5 * (left.first + left.last)
        between, level = margin(middle), level + 1
        proven[left.move[np.any(between < 0.0, axis=1)]] = False
        left = Stretches(
            np.tile(left.move, 2),
            np.concatenate([left.first, middle]),
            np.concatenate([middle, left.last]),
            np.concatenate([left.before, between]),
            np.concatenate([between, left.after]),
        )


def detour(start: Array, end: Array, room: Room, space: Space, generator: np.random.Generator) -> Array | None:
    """(v, n) way-points of free moves from one posture to another, None where none are found."""
    nodes, parents = [start[None], end[None]], [[-1], [-1]]
    for growth in range(GROWTHS):
        spread = min(NEAR * 2.0**growth, 2.0) * (space.upper - space.lower)
        cloud = start + generator.random((CLOUD, 1)) * (end - start)
        cloud = np.clip(cloud + spread * generator.uniform(-0.5, 0.5, cloud.shape), space.lower, space.upper)
        cloud = cloud[room.allows(cloud)]
        cloud = cloud[np.argsort(space.travel(start, cloud) + space.travel(cloud, end))]
        for few in np.split(cloud, range(FEW, len(cloud), FEW)):
            nearest = [np.argmin(space.travel(tree[:, None], few), axis=0) for tree in nodes]
            reached = [free(tree[near], few, room) for tree, near in zip(nodes, nearest, strict=True)]
            ways = []
            for joint in np.flatnonzero(reached[0] & reached[1]):
                halves = [traced(t, p, n[joint]) for t, p, n in zip(nodes, parents, nearest, strict=True)]
                ways.append(np.array([*halves[0][::-1], few[joint], *halves[1]]))
            if ways:
                return pulled(min(ways, key=space.length), room, space)[1:-1]
            for k in (0, 1):
                nodes[k] = np.concatenate([nodes[k], few[reached[k]]])
                parents[k] += nearest[k][reached[k]].tolist()
        if growth >= ALONE and min(map(len, nodes)) == 1:  # nothing near or far is reached from there
            return None
    return None


def traced(nodes: Array, parents: Sequence[int], node: int) -> list[Array]:
    """Postures from a node of a tree to its root."""
    way = []
    while node >= 0:
        way.append(nodes[node])
        node = parents[node]
    return way


def pulled(way: Array, room: Room, space: Space) -> Array:
    """(v, n) the free way (w, n), v <= w, without way-points that are not needed, the others pulled straight."""
    for _ in range(PULLS):
        for k in range(len(way) - 2, 0, -1):
            before, here, after = way[k - 1 : k + 2]
            come, go = space.travel(before, here), space.travel(here, after)
            if come + go <= (1.0 + 1e-9) * space.travel(before, after):  # no way is shorter
                continue
            straight = before + come / (come + go) * (after - before)
            moved = here + np.array([1.0, 0.8, 0.4, 0.2])[:, None] * (straight - here)
            good = (
                room.allows(moved)
                & free(np.tile(before, (4, 1)), moved, room)
                & free(moved, np.tile(after, (4, 1)), room)
            )
            if good[0]:
                way = np.delete(way, k, axis=0)
            elif good.any():
                way[k] = moved[np.argmax(good)]
    return way


def approaches(postures: Array, senses: Array, room: Room, space: Space, generator: np.random.Generator) -> Array:
    """(m, n) way-points from which each joint moves in its sense, (m, n) of +1 and -1, to postures (m, n); NaN of a
    posture to which none leads."""
    m, n = postures.shape
    steps = np.concatenate([np.full((1, m, n), APPROACH), generator.uniform(0.2, 3.0, (TRIES, m, n)) * APPROACH])
    starts = (postures - senses * space.units * steps).reshape(-1, n)
    within = np.all((starts >= space.lower) & (starts <= space.upper), axis=1)
    good = np.zeros(len(starts), dtype=bool)
    good[within] = free(starts[within], np.tile(postures, (TRIES + 1, 1))[within], room)
    first = np.argmax(good.reshape(-1, m), axis=0)
    found = starts.reshape(-1, m, n)[first, np.arange(m)]
    found[~np.any(good.reshape(-1, m), axis=0)] = np.nan
    return found


class Route(NamedTuple):
    """The order of a plan's postures (m, n), and the moves between them.

    rows : (m,) of the plan, in the order of measurement;  vias : of each the (v, n) way-points on the way to it
    unreached : rows of the plan to which no free way was found from most of the others
    """

    rows: NDArray[np.intp]
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
) -> Route:
    """The shortest order of postures (m, n) with free moves, with way-points where there is no other.

    entries : (m, n) from which each is approached, as the last way-point; None: from anywhere
    keep_order : the postures stay in their order
    """
    m, n = postures.shape
    generator, straight = np.random.default_rng(seed), np.empty((0, n))
    aims = postures if entries is None else entries
    ways, given_up = dict[tuple[int, int], Array | None](), set[tuple[int, int]]()
    cost = np.empty((0, 0)) if keep_order else space.travel(postures[:, None], aims)
    cost = np.maximum(cost, cost.T)
    forbidden = cost.sum()  # worse than any order

    def know(pair: tuple[int, int], way: Array | None) -> None:
        ways[pair] = way
        if entries is None:
            ways[pair[::-1]] = None if way is None else way[::-1]
        if not keep_order:
            whole = np.array([postures[pair[0]], *(straight if way is None else way), aims[pair[1]]])
            length = space.length(whole)
            if way is None:
                length = forbidden if pair in given_up else DETOUR * length + 0.1
            cost[pair] = cost[pair[::-1]] = length

    def look(pairs: list[tuple[int, int]]) -> None:
        i, k = np.array(pairs, dtype=int).reshape(-1, 2).T
        for pair, good in zip(pairs, free(postures[i], aims[k], room), strict=True):
            know(pair, straight if good else None)

    while True:
        path = np.arange(m) if keep_order else shortest_path(cost)
        if entries is not None and path[0] > path[-1]:  # which way round it is gone matters
            path = path[::-1]
        pairs = [(int(i), int(k)) for i, k in pairwise(path)]
        if new := [pair for pair in pairs if pair not in ways]:
            look(new)
            # what collides once does so again and again: its neighbours, before the next path asks for them one by one
            for i in () if keep_order else {row for pair in new if ways[pair] is None for row in pair}:
                near = [(i, k) for k in np.argsort(cost[i], kind="stable").tolist() if k != i and (i, k) not in ways]
                look(near[:NEIGHBOURS])
            continue
        if not (hard := [pair for pair in pairs if ways[pair] is None and pair not in given_up]):
            break
        for pair in hard:  # there is no order without them
            way = detour(postures[pair[0]], aims[pair[1]], room, space, generator)
            given_up |= {pair, pair[::-1]} if way is None else set()
            know(pair, way)
    breaks = [k + 1 for k, pair in enumerate(pairs) if ways[pair] is None]
    apart = sorted({*path.tolist()} - {*max(np.split(path, breaks), key=len).tolist()})
    if apart and keep_order:  # by way of other postures there may be one to some of them, and to all
        other = route(postures, room, space, entries=entries, seed=seed)
        if not (apart := other.unreached):
            for pair in (pair for pair in pairs if ways[pair] is None):
                whole = np.array([*along(other, postures, *pair), aims[pair[1]]])
                ways[pair] = pulled(whole, room, space)[1:-1]
    found = [straight, *(ways[pair] for pair in pairs)]
    vias = [straight if way is None else way for way in found]
    if entries is not None:
        vias = [np.vstack([way, entries[row]]) for way, row in zip(vias, path, strict=True)]
    return Route(path, vias, apart)


def along(found: Route, postures: Array, start: int, end: int) -> Array:
    """(v, n) from one posture to another along a route, back if need be."""
    ways = [np.vstack([way, postures[row]]) for way, row in zip(found.vias, found.rows, strict=True)]
    whole, at = np.concatenate(ways), np.cumsum([len(way) for way in ways]) - 1
    first, last = (int(at[np.flatnonzero(found.rows == row)[0]]) for row in (start, end))
    return whole[first : last + 1] if first <= last else whole[last : first + 1][::-1]
