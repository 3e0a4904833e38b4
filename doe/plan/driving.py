"""A plan as it is driven: in an order, with way-points, each posture approached as is asked for.

A posture to which no free way leads is replaced by the best, by the criterion, of random ones to which one does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator

from doe.plan.moves import APPROACH, Room, approaches, route
from doe.plan.plan import shortest_path
from doe.plan.spacing import values_with, with_room
from doe.problem.clearance import ROUNDING, SIGHT, Clearance
from doe.problem.constraints import KINDS, Constraint
from doe.problem.model import joint_units, turns
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem, Stop, never
from identification import Array, Plan

MOVING = 0.5  # share of the clearance that is kept while the arm moves
WALL = 10.0  # [mm] that the arm may pass a wall by while it moves: many postures are on one
WOUND = 1.01 * 2.0 * np.pi  # [rad] limits that leave more are of several turns
ATTEMPTS = 5  # to replace what no way leads to
MANY = 100  # runs above which a plan keeps its order if no other is asked for


class Drive(NamedTuple):
    """A plan of measurements in their order, and how they are driven through.

    plan : the measurements;  moves : the same with way-points, None: they were not asked for, and nothing is in the way
    data : by the keys of files (identification/files/README.md, "JSON keys"), none where no order was asked for
    lines : what is to be said
    """

    plan: Plan
    moves: Plan | None
    data: dict[str, Any]
    lines: list[str]


def drive(
    problem: DesignProblem,
    plan: Plan,
    order: str | None = None,
    approach: str = "any",
    signs: Sequence[int] = (),
    seed: int = 0,
    stop: Stop = never,
) -> Drive:
    """The moves of a plan whose problem may know of bodies, and postures in the place of those that no way leads to.

    order : `given`, `random` or `travel`, None: `travel`, where bodies are known, else as given
    approach : `any`, or the sense of the last motion of each joint: `positive`, `negative`, `alternate`
    signs : (n) of each joint as the controller counts it, empty: as the model does
    stop : asked now and then; where it ends the search, moves may be left that are not free

    Where postures are left that no free way leads to, or none from the side that is asked for, it says which.
    """
    solid, generator = clearance_of(problem.constraints) is not None, np.random.default_rng(seed)
    if not solid and approach == "any" and order is None:
        return Drive(plan, None, {}, [])
    order, rows = order or ("travel" if solid and len(plan) <= MANY else "given"), np.arange(len(plan))
    room, given = room_of(problem.model, problem.constraints, 0.02), plan.postures
    turn = one_turn(problem, room, given) if solid else np.asarray
    postures = given = turn(given)[generator.permutation(rows) if order == "random" else rows]
    senses = np.ones((len(plan), 1)) * np.array(signs or np.ones(problem.joints))
    senses[(rows % 2 == 1) if approach == "alternate" else approach == "negative"] *= -1.0
    for attempt in range(1, ATTEMPTS + 1):
        entries = None if approach == "any" else approaches(postures, senses, room, generator)
        sideways = [] if entries is None else np.flatnonzero(np.isnan(entries[:, 0])).tolist()
        last = attempt == ATTEMPTS or stop()
        if last or not sideways:  # what is left then is approached from anywhere
            run_rows, steps, unreached = route(postures, room, entries, order != "travel", seed, stop)
        if last or not (lost := sideways or unreached):
            break
        postures = replaced(problem, postures, lost, room, turn, generator)
    via = np.concatenate([np.arange(len(way)) < len(way) - 1 for way in steps])
    measured, whole = (replace(plan, postures=q) for q in (postures[run_rows], np.concatenate(steps)))
    many = len(plan) > MANY and order != "travel"
    around = rows if many else shortest_path(room.travel(postures[:, None], postures))
    ways = (plan.postures, whole.postures, measured.postures, postures[around])
    before, after, *shortest = np.degrees([room.length(way) for way in ways]).tolist()
    saved = 1.0 - after / before if before > 0.0 else 0.0
    data: dict[str, Any] = {"travel_deg": {"order": order, "before": before, "after": after, "saved": saved}}
    change = f"{abs(saved):.0%} {'more' if saved < 0.0 else 'saved'}"
    lines = [f"order {order}: joint travel {before:.0f} -> {after:.0f} deg of the joint that moves farthest ({change})"]
    if not solid and approach == "any":
        return Drive(measured, None, data, lines)
    runs, changed = np.where(via, 0, np.cumsum(~via)).tolist(), int(np.any(postures != given, axis=1).sum())
    vias, no_approach = int(via.sum()), (np.flatnonzero(np.isin(run_rows, sideways)) + 1).tolist()
    not_free = (unproven(problem.constraints, whole.postures) or []) if unreached or stop() else []
    data["moves"] = {
        "vias": vias,
        "replaced": changed,
        "shortest_deg": min(shortest),
        "approach": approach,
        "no_approach": no_approach,
        "not_free": not_free,
        "rows": [
            {"kind": "measure" if run else "via", "run": run or None, "joints": row}
            for run, row in zip(runs, whole.displayed.tolist(), strict=True)
        ],
    }
    times, counted = after / (min(shortest) or after or 1.0), f"{vias} way-point{'s' * (vias != 1)}"
    lines.append(f"Moves: {counted}, {times:.2f} times the travel of the shortest order with nothing in the way.")
    if approach != "any":
        how = "both ways in turn" if approach == "alternate" else f"in {approach} direction"
        lines.append(f"every joint comes to each posture {how}; plan and bound leave room for it at the limits")
    if no_approach:
        named = f"run{'s' * (len(no_approach) != 1)} {', '.join(map(str, no_approach))}"
        lines.append(f"but not to {named}: no free way was found there from that side")
    if changed:
        were = "1 of the postures was" if changed == 1 else f"{changed} of the postures were"
        lines.append(f"{were} replaced: no free way led there from the others")
    return Drive(measured, replace(whole, via=via), data, [*lines, *in_sentences(not_free)])


def unproven(constraints: Sequence[Constraint], postures: Array) -> list[dict[str, Any]] | None:
    """Key `not_free`: moves between postures (m, n) that are not proven to be free: the row, from 1, that each leads
    to, the bodies that come nearest to what is kept, and how near; None where nothing is known of any body."""
    if (clearance := clearance_of(constraints)) is None:
        return None
    room = room_of(clearance.model, constraints)
    kept = np.where([SIGHT in pair for pair in clearance.pairs], -np.inf, MOVING * clearance.asked)
    moves, shares = list[dict[str, Any]](), np.linspace(0.0, 1.0, 300)[:, None]
    for row in np.flatnonzero(~room.free(postures[:-1], postures[1:])).tolist():
        apart = clearance.distance(postures[row] + shares * (postures[row + 1] - postures[row]))
        at, k = divmod(int(np.argmin(apart - kept)), len(kept))
        moves.append({"row": row + 2, "bodies": [*clearance.pairs[k]], "distance_mm": float(apart[at, k])})
    return moves


def in_sentences(moves: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is to be said of moves that are `unproven`."""
    lines = [f"Moves: {len(moves)} may collide on the way:"] if moves else []
    return lines + [
        f"  to row {each['row']}: {' and '.join(each['bodies'])} come to {each['distance_mm']:.0f} mm" for each in moves
    ]


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


def replaced(
    problem: DesignProblem,
    postures: Array,
    lost: Sequence[int],
    room: Room,
    turn: Callable[[Array], Array],
    generator: Generator,
) -> Array:
    """(m, n) postures, in the place of lost rows the best of some that have a free move to one of those near them."""
    postures, kept = postures.copy(), np.delete(np.arange(len(postures)), lost)
    for row in lost:
        others, listed = np.delete(postures, row, axis=0), problem.choices
        drawn = random_postures(problem, 200, generator) if listed is None else generator.permutation(listed)[:200]
        drawn = with_room(problem, turn(drawn), np.concatenate([others, problem.kept]))
        for posture in drawn[np.argsort(-values_with(problem, others, drawn), kind="stable")] if len(drawn) else drawn:
            nearest = postures[kept[np.argsort(room.travel(posture, postures[kept]))[:10]]]
            if not len(kept) or room.free(np.broadcast_to(posture, nearest.shape), nearest).any():
                postures[row], kept = posture, np.append(kept, row)
                break
    return postures


def clearance_of(constraints: Sequence[Constraint]) -> Clearance | None:
    """What is known of bodies; None: nothing of any."""
    return next((each for each in constraints if isinstance(each, Clearance)), None)


def room_of(model: Any, constraints: Sequence[Constraint], spare: float = 0.0) -> Room:
    """What the moves of an arm with these constraints keep free; where nothing is known of any body, nothing.

    spare : share of the clearance, and of the distance of walls, that is kept besides

    Of the clearance that postures keep it is half, beyond which a body may be where it is not thought to be; and the
    walls of the arm file to 10 mm, since many postures are on one. A line of sight may be blocked between measurements.
    """
    place, clearance = (model.lower, model.upper, joint_units(model)), clearance_of(constraints)
    if clearance is None:
        return Room(lambda q: np.empty((len(q), 0)), np.empty((0, len(model.lower))), *place)
    walls, solid = [each for each in constraints if each.kind in KINDS], [SIGHT not in pair for pair in clearance.pairs]
    kept, wall = (MOVING + spare) * clearance.asked[solid] - ROUNDING, (1.0 - spare) * WALL

    def margin(postures: Array) -> Array:
        beside = [each.margin(postures) + wall for each in walls]
        return np.concatenate([clearance.distance(postures)[:, solid] - kept, *beside], axis=1)

    # links of walls are nowhere farther from the axis of any joint than the stretched arm is long
    longest = np.where(turns(model), model.reach, 1.0)
    count = margin(np.zeros((1, len(longest)))).shape[1] - sum(solid)
    return Room(margin, np.concatenate([clearance.levers()[solid], np.tile(longest, (count, 1))]), *place)


def with_approach(problem: DesignProblem, approach: str) -> DesignProblem:
    """The problem with postures that leave room within the limits to come from where they are approached."""
    away = (approach != "any") * APPROACH * problem.joint_units
    return replace(problem, lower=problem.lower + away, upper=problem.upper - away)
