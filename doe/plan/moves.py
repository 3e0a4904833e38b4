"""How a plan is driven: the order of its postures, straight moves in joint space that are free of collisions and short,
way-points where a straight move is not possible, and the side from which each posture is approached.

*Proving a move free.* Between two postures q and q' the distance of pair k of bodies changes by at most

    sum_j L_kj |q_j - q'_j|,

where L_kj is the pair's lever about joint j [mm/rad]. If the distances at the ends of a stretch are r and r', the pair
keeps at least (r + r' - sum_j L_kj |q_j - q'_j|) / 2 all along it. Where that is below zero, the stretch is halved
(F. Schwarzer, M. Saha, J.-C. Latombe, "Adaptive dynamic collision checking for single and multiple articulated robots",
IEEE Trans. Robotics 21 (2005) 338-353). The stretches of all moves are evaluated at once, level by level. A stretch
that becomes too short to halve counts as not free; no move is accepted on samples alone.

*Road map.* The postures and random way-points are the nodes. Edges are moves between neighbouring nodes, as long as
checks at a few places along them find no collision (L. Kavraki, P. Svestka, J.-C. Latombe, M. Overmars, "Probabilistic
roadmaps for path planning in high-dimensional configuration spaces", IEEE Trans. Robotics and Automation 12 (1996)
566-580). The route is the shortest open path through all postures along the map. Only its moves are proven; those that
collide leave the map, and the route is searched again (R. Bohlin, L. Kavraki, "Path planning using lazy PRM", ICRA
2000). At the end its bends are shortened. A posture that cannot be reached without collision is replaced by the best
(by the criterion) of random ones that can.

*Order of measurement.* It does not change the information, but it changes the travel time, and which drifts can stay
hidden. The shortest joint travel is an open travelling salesman path whose edges cost the time that the slowest joint
needs. From many starts, pairs of edges are exchanged as long as that shortens the path: for 30 random postures of six
joints the result is 0.6 % longer than the shortest path (at most 2 % in eight cases).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from doe.plan.spacing import best_beside
from doe.problem.clearance import ROUNDING, Clearance
from doe.problem.constraints import KINDS, Constraint, Walls
from doe.problem.model import joint_units, offers, turns
from doe.problem.problem import DesignProblem, Stop, never, random_postures
from identification import Array, Plan
from identification.document import count_of

Numbers = NDArray[np.intp]
APPROACH = float(np.radians(3.0))  # more than any backlash
NARROWEST = 0.5  # [mm] of the way of a body, below which a stretch is not halved again
MOVING = 0.5  # share of the clearance that is kept while the arm moves
WALL = 10.0  # [mm] that the arm may pass a wall by while it moves: many postures are on one
SHORTEST = "the travel of the shortest order without obstacles."
WOUND = 1.01 * 2.0 * np.pi  # [rad] limits that leave more are of several turns
ATTEMPTS = 5  # to replace what no way leads to
MANY = 100  # runs above which a plan keeps its order if no other is asked for
# what is said of plans of an arm in space whose bodies are not known
COLLISIONS = (
    "Collisions of the arm with itself and with its surroundings were not checked, since the arm file has no bodies: "
    "add [[cell.bodies]] or a URDF with collision bodies, or try each posture slowly."
)


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


def shortest_path(cost: Array) -> Numbers:
    """(m,) rows in the order of the shortest open path by the costs (m, m) of edges; never longer than that given."""
    m = len(cost)
    padded = np.pad(cost, (0, 1))  # the last row is the dummy posture that joins the ends
    starts = [np.arange(m)]
    for first in range(0, m, max(1, m // 20)):  # always on to the nearest posture not yet visited
        path = [first]
        while len(left := np.setdiff1d(np.arange(m), path)):
            path.append(int(left[np.argmin(cost[path[-1], left])]))
        starts.append(np.array(path))
    ends = []
    for start in starts:  # 2-opt: stretches are reversed as long as that shortens the tour
        tour = np.append(start, m)
        while True:
            a, b = tour, np.roll(tour, -1)
            gain = padded[a, b][:, None] + padded[a, b] - padded[np.ix_(a, a)] - padded[np.ix_(b, b)]
            i, k = np.unravel_index(np.argmax(np.triu(gain, 1)), gain.shape)
            if gain[i, k] <= 1e-12 * (1.0 + padded.max()) or i >= k:
                break
            tour[i + 1 : k + 1] = tour[i + 1 : k + 1][::-1]
        dummy = int(np.flatnonzero(tour == m)[0])
        ends.append(np.concatenate([tour[dummy + 1 :], tour[:dummy]]))
    return min(ends, key=lambda path: float(cost[path[:-1], path[1:]].sum()))


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

    The map gets random nodes as long as moves are much longer than with nothing in the way, or some posture is not
    reached, from a wider and wider space.
    """
    from scipy.sparse.csgraph import dijkstra

    spread, rounds, neighbors = 200, 4, 12  # effort: random nodes at once, how often, and moves that are tried of each
    generator, rows = np.random.default_rng(seed), np.arange(len(postures))
    entries = postures[:0] if entries is None else np.where(np.isnan(entries), postures, entries)
    aims = rows + len(entries)  # nodes that stand for the postures, where one comes from elsewhere
    nodes = np.concatenate([postures, entries])
    # (M, M) [rad] of the moves of a node and a later one, inf where there is none; which of them are proven to be free
    length, proven = np.full(2 * (len(nodes),), np.inf), np.zeros(2 * (len(nodes),), dtype=bool)
    proven[rows, aims] = True
    length[rows, aims] = room.travel(postures, nodes[aims]) + 1e-9
    ideal = room.travel(postures[:, None], nodes[aims])
    around = rows if keep_order else shortest_path(np.maximum(ideal, ideal.T))
    enough, order, missing = 1.1 * ideal[around[:-1], around[1:]].sum(), rows, rows
    old, most = 0, neighbors if keep_order else 2 * len(rows)
    for beyond in (0.0, *0.3 * 3.0 ** np.arange(rounds)):  # [rad] the postures random nodes are drawn, none at first
        if beyond:
            low = np.maximum(postures.min(axis=0) - beyond * room.units, room.lower)
            high = np.minimum(postures.max(axis=0) + beyond * room.units, room.upper)
            drawn = generator.uniform(low, high, (spread, len(low)))
            about = nodes[generator.choice(missing if len(missing) else aims, spread)]
            drawn[::2] = (about + 0.3 * generator.random((spread, 1)) * (drawn - about))[::2]
            drawn, old, most = drawn[np.all(room.margin(drawn) >= 0.0, axis=1)], len(nodes), neighbors
            nodes, wider = np.concatenate([nodes, drawn]), (0, len(drawn))
            length, proven = np.pad(length, wider, constant_values=np.inf), np.pad(proven, wider)
        # moves of new nodes to so many of the nearest, and from those that have them among their nearest, and from each
        # posture to the next, unless a few places on the way collide
        apart = room.travel(nodes[:, None], nodes) + 1e-9
        near = apart <= np.sort(apart, axis=1)[:, : most + 1].max(axis=1, initial=0.0)[:, None]
        near[rows[:-1], aims[1:]] = True
        low, high = np.nonzero(np.triu(near | near.T, 1))
        low, high = low[high >= old], high[high >= old]
        length[low, high] = np.where(room.free(nodes[low], nodes[high], levels=2), apart[low, high], np.inf)
        while True:  # the shortest route, until all of its moves are proven
            # (m, M) of the shortest ways to every node, and the nodes before it
            far, before = dijkstra(length, directed=False, indices=rows, return_predecessors=True)
            cost = far[:, aims]
            reached = np.isfinite(cost)
            if not keep_order:
                cost = np.where(reached, cost, 1.0 + 2.0 * cost[reached].sum())  # more than any order
                order = shortest_path(np.maximum(cost, cost.T))
            ways = []  # the nodes of each of the m - 1 steps
            for one, other in pairwise(order.tolist()):
                way = [int(aims[other])]
                while reached[one, other] and way[-1] != one:
                    way.append(int(before[one, way[-1]]))
                ways.append(way[::-1] if reached[one, other] else [one, way[0]])
            moves = np.array([pair for way in ways for pair in pairwise(way)], dtype=int).reshape(-1, 2)
            low, high = np.unique(np.sort(moves, axis=1), axis=0).T
            doubtful = np.isfinite(length[low, high]) & ~proven[low, high]
            if not doubtful.any() or stop():
                break
            low, high = low[doubtful], high[doubtful]
            proven[low, high] = free = room.free(nodes[low], nodes[high])
            length[low[~free], high[~free]] = np.inf
        label = reached.argmax(axis=1)
        missing = np.flatnonzero(label != np.bincount(label).argmax())
        if stop() or (not len(missing) and sum(room.length(nodes[way]) for way in ways) <= enough):
            break
        enough *= 1.15  # less and less is asked
    steps = [nodes[aims[order[:1]]]]
    for step in (nodes[way] for way in ways):  # bends go nearer to straight lines, or go, as far as moves stay free
        for share in (1.0, 0.7, 0.5):  # of the way from a bend to the straight line
            for bend in range(len(step) - 2, 0, -1):
                first, here, last = step[bend - 1 : bend + 2]
                nearer = here + share * (0.5 * (first + last) - here)
                if room.free(np.array([first, nearer]), np.array([nearer, last])).all():
                    step[bend] = nearer
                    step = np.delete(step, bend, axis=0) if share == 1.0 else step
        steps.append(step[1:])
    last = postures[order]  # behind the node that leads to it, where that is another
    steps = [step if np.array_equal(step[-1], q) else np.vstack([step, q]) for step, q in zip(steps, last, strict=True)]
    return order, steps, missing.tolist()


def senses_of(approach: str, counts: Array) -> Array:
    """(s, n) of +1 and -1: in which each joint comes to a posture, of `alternate` by turns; s is 0 of `any`."""
    ways = {"any": [], "positive": [1.0], "negative": [-1.0], "alternate": [1.0, -1.0]}[approach]
    return np.reshape(ways, (-1, 1)) * np.sign(np.diag(counts))


def with_approach(problem: DesignProblem, approach: str, counts: Array | None = None) -> DesignProblem:
    """The problem with room within the limits to come from there;  approach, counts : as of `drive`"""
    senses = senses_of(approach, np.eye(problem.joints) if counts is None else counts)
    lower, upper = (np.max(side, axis=0, initial=0.0) * APPROACH * problem.joint_units for side in (senses, -senses))
    return replace(problem, lower=problem.lower + lower, upper=problem.upper - upper)


def approaches(
    postures: Array, senses: Array, counts: Array, room: Room, generator: np.random.Generator, tries: int = 40
) -> Array:
    """(m, n) way-points from which each joint moves in its sense, (m, n) of +1 and -1, to postures (m, n), and what the
    controller shows of it with it (`counts`, as of `drive`); NaN of a posture to which none leads, of so many, a ninth
    to 3 times as far as is usual."""
    m, n = postures.shape
    steps = APPROACH * 3.0 ** np.concatenate([np.zeros((1, m, n)), generator.uniform(-2.0, 1.0, (tries, m, n))])
    moves = senses * room.units * steps  # (tries + 1, m, n)
    begun, shown = postures - moves, (moves @ counts.T) * senses * np.sign(np.diag(counts)) / room.units
    good = np.all((begun >= room.lower) & (begun <= room.upper) & (shown > 0.1 * APPROACH), axis=2)
    good[good] = room.free(begun[good], np.broadcast_to(postures, begun.shape)[good])
    return np.where(good.any(axis=0)[:, None], begun[good.argmax(axis=0), np.arange(m)], np.nan)


# -- plans -------------------------------------------------------------------------------------------------------------
class Drive(NamedTuple):
    """A plan of measurements in their order, and how they are driven through.

    plan : the measurements;  moves : the same with way-points, where these were asked for or something is in the way
    data : by the keys of files (identification/files/README.md, "JSON keys"), none where no order was asked for
    lines : what is to be said
    """

    plan: Plan
    moves: Plan
    data: dict[str, Any]
    lines: list[str]


def drive(
    problem: DesignProblem,
    plan: Plan,
    order: str | None = None,
    approach: str = "any",
    counts: Array | None = None,
    seed: int = 0,
    stop: Stop = never,
) -> Drive:
    """The moves of a plan whose problem may know of bodies, and postures in the place of those that no way leads to.

    order : `given`, `random` or `travel`, None: `travel`, where bodies are known, else as given
    approach : `any`, or the sense of the last motion of each joint: `positive`, `negative`, `alternate`
    counts : (n, n) how much of each joint is in what the controller shows of it, None: as the model counts
    stop : asked now and then; where it ends the search, moves may be left that are not free

    Where postures are left that no free way leads to, or none from the side that is asked for, it says which.
    """
    solid, generator = clearance_of(problem.constraints) is not None, np.random.default_rng(seed)
    if not solid and approach == "any" and order is None:
        return Drive(plan, plan, {}, [])
    order, rows = order or ("travel" if solid and len(plan) <= MANY else "given"), np.arange(len(plan))
    room, given = room_of(problem.model, problem.constraints, 0.97), plan.postures
    turn = one_turn(problem, room, given) if solid else np.asarray
    postures = given = turn(given)[generator.permutation(rows) if order == "random" else rows]
    counts = np.eye(problem.joints) if counts is None else counts
    senses = senses_of(approach, counts)
    for attempt in range(1, ATTEMPTS + 1):
        entries = approaches(postures, senses[rows % len(senses)], counts, room, generator) if len(senses) else None
        sideways = [] if entries is None else np.flatnonzero(np.isnan(entries[:, 0])).tolist()
        last = attempt == ATTEMPTS or stop()
        if last or not sideways:  # what is left then is approached from anywhere
            run_rows, steps, unreached = route(postures, room, entries, order != "travel", seed, stop)
        if last or not (lost := sideways or unreached):
            break
        postures, kept = postures.copy(), np.delete(rows, lost)
        for row in lost:  # the best of some that have a free move to one of those near them
            others, listed = np.delete(postures, row, axis=0), problem.choices
            drawn = random_postures(problem, 200, generator) if listed is None else generator.permutation(listed)[:200]
            for posture in best_beside(problem, others, turn(drawn)):
                nearest = postures[kept[np.argsort(room.travel(posture, postures[kept]))[:10]]]
                if not len(kept) or room.free(np.broadcast_to(posture, nearest.shape), nearest).any():
                    postures[row], kept = posture, np.append(kept, row)
                    break
    via = np.concatenate([np.arange(len(way)) < len(way) - 1 for way in steps])
    measured, whole = (replace(plan, postures=q) for q in (postures[run_rows], np.concatenate(steps)))
    if via.any():  # how joints come to a run does not follow from the runs before
        last = np.diff(whole.postures, axis=0, prepend=np.nan)[~via].round(9)
        measured = replace(measured, conditions={"directions": np.where(last == 0.0, np.nan, np.sign(last))})
    around = rows if len(plan) > MANY and order != "travel" else shortest_path(room.travel(postures[:, None], postures))
    ways = (plan.postures, whole.postures, measured.postures, postures[around])
    before, after, *shortest = np.degrees([room.length(way) for way in ways]).tolist()
    saved = 1.0 - after / before if before > 0.0 else 0.0
    data: dict[str, Any] = {"travel_deg": {"order": order, "before": before, "after": after, "saved": saved}}
    change = f"{abs(saved):.0%} {'more' if saved < 0.0 else 'saved'}"
    travel = f"{before:.0f} -> {after:.0f} {problem.degrees} ({change})"
    lines = [f"order {order}: travel of the joint that moves farthest, summed over the moves: {travel}"]
    if not solid and approach == "any":
        return Drive(measured, measured, data, lines)
    moves, vias, changed = replace(whole, via=via), int(via.sum()), int(np.any(postures != given, axis=1).sum())
    no_approach = (np.flatnonzero(np.isin(run_rows, sideways)) + 1).tolist()
    blocked = unproven(problem.constraints, whole.postures) if unreached or stop() else []
    data["moves"] = {"vias": vias, "replaced": changed, "shortest_deg": min(shortest), "approach": approach}
    data["moves"] |= {"no_approach": no_approach, "not_free": blocked, "rows": rows_of(moves)}
    times, named = after / (min(shortest) or after or 1.0), f"run{'s' * (len(no_approach) != 1)} "
    named += ", ".join(map(str, no_approach))
    how = "alternating directions (half of the runs each)" if approach == "alternate" else f"the {approach} direction"
    path = "collision-free path" if approach == "any" else "free path from that side, within the limits,"
    were = f"{count_of(changed, 'posture')} {'was' if changed == 1 else 'were'} replaced"
    said = (
        (True, f"Moves: {count_of(vias, 'way-point')}, {times:.2f} times {SHORTEST}"),
        (approach != "any", f"joints approach the postures in {how}; plan and bound leave room for this at the limits"),
        (no_approach, f"no collision-free path from that side was found to {named}"),
        (changed, f"{were}: no {path} led there"),
    )
    lines += [sentence for true, sentence in said if true] + in_sentences(blocked)
    return Drive(measured, moves, data, lines)


def rows_of(moves: Plan) -> list[dict[str, Any]]:
    """Of each row of a plan its `kind` (`measure` or `via`), the `run` that is measured there, None at a way-point, and
    the `joints` as the controller counts them [deg, mm]."""
    runs = np.where(moves.is_run, np.cumsum(moves.is_run), 0)
    return [
        {"kind": "measure" if run else "via", "run": run or None, "joints": joints}
        for run, joints in zip(runs.tolist(), moves.displayed.tolist(), strict=True)
    ]


def unproven(constraints: Sequence[Constraint], postures: Array) -> list[dict[str, Any]]:
    """Key `not_free`: moves between postures (m, n) that are not proven to be free: the row, from 1, that each leads
    to, the bodies, or the wall, that come nearest to what is kept, and how near; none where no body is known."""
    if (clearance := clearance_of(constraints)) is None:
        return []
    room, walls, shares = room_of(clearance.model, constraints), Walls(constraints), np.linspace(0.0, 1.0, 300)[:, None]
    names = [pair for each in constraints for pair in getattr(each, "pairs", each.count * [(each.kind,)])]
    asked = np.concatenate([getattr(each, "asked", np.zeros(each.count)) for each in constraints])
    moves = list[dict[str, Any]]()
    for row in np.flatnonzero(~room.free(postures[:-1], postures[1:])).tolist():
        way = postures[row] + shares * (postures[row + 1] - postures[row])
        at, k = divmod(int(np.argmin(room.margin(way))), len(names))
        apart = float(walls.values(way[at : at + 1])[0, k] + asked[k])
        moves.append({"row": row + 2, "bodies": [*names[k]], "distance_mm": apart})
    return moves


def in_sentences(moves: Sequence[Mapping[str, Any]]) -> list[str]:
    """A heading and a line for each of the moves that are `unproven`."""
    return [f"Moves: {len(moves)} may collide on the way:"] * bool(moves) + [
        f"  to row {each['row']}: {' and '.join(each['bodies'])}, smallest distance {each['distance_mm']:.0f} mm"
        for each in moves
    ]


def distance_in_words(near: Mapping[str, Any]) -> str:
    """Of two bodies, as `Clearance.too_near` has them; digits are cut, as 20.0 mm of the 20 asked look enough."""
    gap = np.floor(100.0 * near["distance_mm"]) / 100.0
    return f"{' and '.join(near['bodies'])} {f'overlap by {-gap:.2f} mm' if gap < 0.0 else f'are {gap:.2f} mm apart'}"


def said_of_collisions(
    constraints: Sequence[Constraint], model: Any, postures: Array | None = None, moves: Array | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Keys `collisions_checked`, of postures (m, n) `collisions`, and of moves along others `moves`; and what to say:
    every pair that is too close, pairs with another clearance, and what is not checked. Nothing of planar arms
    without bodies;  model : with `space` and `cell`;  postures, moves : None: there are none"""
    if (clearance := clearance_of(constraints)) is None:
        floor = offers(model, "cell") and model.cell.floor is not None
        said = COLLISIONS + " The floor of [cell] was not looked at either." * floor
        return ({"collisions_checked": False}, [said]) if getattr(model, "space", 0) == 3 else ({}, [])
    data, lines = dict[str, Any](collisions_checked=not (clearance.unseen or clearance.bare)), list[str]()
    usual, blocked = int(np.sum(clearance.asked >= clearance.usual)), list[dict[str, Any]]()
    if postures is not None:
        data["collisions"] = near = clearance.too_near(postures)
        # of data a posture may have many rows, of which the first is named
        runs = np.unique(postures, axis=0, return_index=True)[1] + 1
        first = [each for each in near if each["run"] in runs]
        stay = "pair of bodies stays" if usual == 1 else "pairs of bodies stay"
        state = f"{usual} {stay} at least {clearance.usual:g} mm apart at all {len(runs)} postures."
        if near:
            those = len({each["run"] for each in first})
            state = f"at {those} of {len(runs)} postures bodies are too close to each other:"
        lines = [f"Collisions (by covers, which stick out somewhat): {state}"] if usual or near else []
        lines += [f"  run {each['run']}: {distance_in_words(each)}" for each in first]
    if moves is not None:
        data["moves"] = {"not_free": (blocked := unproven(constraints, moves))}
    few = np.flatnonzero(clearance.asked < clearance.usual)
    narrow = [f"{' and '.join(clearance.pairs[k])} ({clearance.asked[k]:.3g} mm)" for k in few]
    unlike = (
        ("Pairs that are always close (smaller clearance)", narrow),
        ("Pairs whose covers touch at nearly all postures (not checked)", [*map(" and ".join, clearance.touching)]),
        ("Links whose meshes were not found (not checked)", clearance.unseen),
        ("Joints whose links have no bodies (not checked)", clearance.bare),
    )
    return data, [*lines, *(f"{why}: {', '.join(each)}." for why, each in unlike if each), *in_sentences(blocked)]


def one_turn(problem: DesignProblem, room: Room, postures: Array) -> Callable[[Array], Array]:
    """What turns joints of postures by whole turns, where limits leave room for more than one and neither the criterion
    nor a list tells the difference at postures (m, n): into one turn each, which ends where these would be least often
    free. Straight moves are shorter then, and more of them are free."""
    lower, upper, joints, whole = problem.lower, problem.upper, np.arange(problem.joints), 2.0 * np.pi
    start, wound = lower.copy(), turns(problem.model) & (upper - lower > WOUND)
    wound &= problem.choices is None or problem.sampled
    for j in np.flatnonzero(wound):
        ends = np.linspace(lower[j], upper[j] - whole, 13)
        at_ends = np.where(joints == j, ends[:, None, None], postures[:200]).reshape(-1, len(joints))
        free = np.all(room.margin(at_ends) >= 0.0, axis=1).reshape(len(ends), -1).mean(axis=1)
        start[j] = ends[np.argmin(free + 1e-3 * np.abs(np.linspace(-1.0, 1.0, len(ends))))]  # the middle one of equals
        turned = np.where(joints == j, start[j] + (postures - start[j]) % whole, postures)
        wound[j] = np.array_equal(problem.feasible(turned), problem.feasible(postures))
        wound[j] &= abs(problem.objective(turned) - problem.objective(postures)) < 1e-6
    return lambda q: np.where(wound, start + (q - start) % whole, q)


def clearance_of(constraints: Sequence[Constraint]) -> Clearance | None:
    """What is known of bodies; None: nothing of any."""
    return next((each for each in constraints if isinstance(each, Clearance)), None)


def slack_of(each: Constraint, constraints: Sequence[Constraint]) -> Array:
    """(k,) [mm] by how much postures on the way may fall short of one of the constraints on what is measured.

    Of the clearance half is kept, beyond which a body may be where it is not thought to be. Where bodies are known the
    walls of the arm file are kept to 10 mm, since many postures are on one, else by the ends of moves; as are limits of
    joints that are counted together. A line of sight may be blocked between measurements.
    """
    if isinstance(each, Clearance):
        return np.where(each.of_sight, np.inf, (1.0 - MOVING) * each.asked + ROUNDING)
    all_along = clearance_of(constraints) is not None and each.kind in KINDS and each.kind != "joint_limits"
    return np.full(each.count, WALL if all_along else (np.inf if each.kind == "line_of_sight" else ROUNDING))


def room_of(model: Any, constraints: Sequence[Constraint], share: float = 1.0) -> Room:
    """What the moves of an arm with these constraints keep free;  share : of `slack_of` that they may use"""
    slack, levers = [np.empty(0)], [np.empty((0, len(model.lower)))]
    # nothing is farther from the axis of any joint than the stretched arm and its farthest measured point are long
    beyond = getattr(clearance_of(constraints), "beyond", 0.0)
    longest = np.where(turns(model), getattr(model, "reach", 0.0) + beyond, 1.0)
    for each in constraints:
        slack.append(slack_of(each, constraints))
        all_along = slack[-1][:, None] > ROUNDING
        levers.append(each.levers() if isinstance(each, Clearance) else np.where(all_along, longest, 0.0))
    walls, beside, units = Walls(constraints), share * np.concatenate(slack), joint_units(model)
    return Room(lambda q: walls.values(q) + beside, np.concatenate(levers), model.lower, model.upper, units)
