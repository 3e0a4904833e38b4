"""A plan as it is driven: in an order, with way-points, each posture approached as is asked for.

A posture to which no free way leads is replaced by the best, by the criterion, of random ones to which one does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from doe.plan.moves import APPROACH, Room, Route, approaches, route
from doe.plan.plan import shortest_path
from doe.plan.spacing import values_with
from doe.problem.clearance import ROUNDING, SIGHT, Clearance
from doe.problem.constraints import KINDS, Constraint
from doe.problem.model import joint_units, turns
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem, Stop, never
from identification import Array, Plan

# of the last motion of each joint: room for it below a posture, and above
SENSES = {"any": (False, False), "positive": (True, False), "negative": (False, True), "alternate": (True, True)}
MOVING = 0.5  # share of the clearance that is kept while the arm moves
WALL = 10.0  # [mm] that the arm may pass a wall by while it moves: many postures are on one
WOUND = 1.01 * 2.0 * np.pi  # [rad] limits that leave more are of several turns
ATTEMPTS = 5  # to replace what no way leads to
MANY = 100  # runs above which a plan keeps its order if no other is asked for


class Drive(NamedTuple):
    """A plan of measurements in their order, and how they are driven through.

    plan : the measurements;  moves : the same with way-points, None: they were not asked for, and nothing is in the
        way, or time ended before free ones were found
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
    approach : of `SENSES`;  signs : (n) of each joint as the controller counts it, empty: as the model does
    stop : asked now and then; where it ends the search, the plan has its order and no moves

    Where postures are left that no free way leads to, or none from the side that is asked for, it says which.
    """
    solid, generator = clearance_of(problem.constraints) is not None, np.random.default_rng(seed)
    if not solid and approach == "any" and order is None:
        return Drive(plan, None, {}, [])
    order = order or ("travel" if solid and len(plan) <= MANY else "given")
    room = room_of(problem.model, problem.constraints, 0.02)
    kept_margin = room.margin

    def margin(postures: Array) -> Array:
        if stop():
            raise TimeoutError
        return kept_margin(postures)

    turn, room = one_turn(problem, room, generator) if solid else np.asarray, room._replace(margin=margin)
    given, rows = turn(plan.postures), np.arange(len(plan))
    postures = given = given[np.random.default_rng(seed).permutation(rows)] if order == "random" else given
    senses = np.ones((len(plan), 1)) * np.array(signs or np.ones(problem.joints))
    senses[(rows % 2 == 1) if approach == "alternate" else approach == "negative"] *= -1.0
    cut, sideways = False, []
    many = len(plan) > MANY and order != "travel"
    around = rows if many else shortest_path(room.travel(postures[:, None], postures))
    try:
        for attempt in range(ATTEMPTS):
            entries = None if approach == "any" else approaches(postures, senses, room, generator)
            sideways = [] if entries is None else np.flatnonzero(np.isnan(entries[:, 0])).tolist()
            lost = sideways if attempt + 1 < ATTEMPTS else []  # what is left is approached from anywhere
            if not lost:
                path = route(postures, room, entries, keep_order=order != "travel", seed=seed)
                lost = path.unreached
            if not lost or attempt + 1 == ATTEMPTS:
                break
            postures = another(problem, postures, lost, room, turn, generator)
    except TimeoutError:
        rows = around if order == "travel" else rows
        cut, path = True, Route(rows, [postures[[row]] for row in rows], [])
    via = np.concatenate([np.arange(len(way)) < len(way) - 1 for way in path.ways])
    measured, whole = (replace(plan, postures=q) for q in (postures[path.rows], np.concatenate(path.ways)))
    ways = (plan.postures, whole.postures, measured.postures, postures[around])
    before, after, *shortest = np.degrees([room.length(way) for way in ways]).tolist()
    saved = 1.0 - after / before if before > 0.0 else 0.0
    data: dict[str, Any] = {"travel_deg": {"order": order, "before": before, "after": after, "saved": saved}}
    if cut:
        data["moves"] = None
    if cut or (not solid and approach == "any"):
        return Drive(measured, None, data, in_words(data, []))
    runs = np.where(via, 0, np.cumsum(~via)).tolist()
    data["moves"] = {
        "vias": int(via.sum()),
        "replaced": int(np.any(postures != given, axis=1).sum()),
        "shortest_deg": min(shortest),
        "approach": approach,
        "no_approach": (np.flatnonzero(np.isin(path.rows, sideways)) + 1).tolist(),
        "not_free": (unproven(problem.constraints, whole.postures) or []) if path.unreached else [],
        "rows": [
            {"kind": "measure" if run else "via", "run": run or None, "joints": row}
            for run, row in zip(runs, whole.displayed.tolist(), strict=True)
        ],
    }
    wound = np.flatnonzero(turns(problem.model) & (problem.upper - problem.lower > WOUND)) + 1
    return Drive(measured, replace(whole, via=via), data, in_words(data, wound.tolist()))


def in_words(data: Mapping[str, Any], wound: Sequence[int]) -> list[str]:
    """What is to be said of the order, and of the moves.

    wound : joints from 1 with limits of more than one turn
    """
    order, before, after, saved = data["travel_deg"].values()
    change = f"{abs(saved):.0%} {'more' if saved < 0.0 else 'saved'}"
    lines = [f"order {order}: joint travel {before:.0f} -> {after:.0f} deg of the joint that moves farthest ({change})"]
    if "moves" not in data:
        return lines
    if (moves := data["moves"]) is None:
        late = "Moves: no way from posture to posture was proven free in time; straight moves may collide: armcal score"
        shorter = "names them. Narrower joint limits, as the cell has them, make the search shorter."
        return [*lines, f"{late} {shorter}"]
    vias, replaced, shortest, approach, sideways, not_free, _ = moves.values()
    times, counted = after / shortest if shortest > 0.0 else 1.0, f"{vias} way-point{'s' * (vias != 1)}"
    lines.append(f"Moves: {counted}, {times:.2f} times the travel of the shortest order with nothing in the way.")
    if approach != "any":
        how = "both ways in turn" if approach == "alternate" else f"in {approach} direction"
        lines.append(f"every joint comes to each posture {how}; plan and bound leave room for it at the limits")
    if sideways:
        runs = f"run{'s' * (len(sideways) != 1)} {', '.join(map(str, sideways))}"
        lines.append(f"but not to {runs}: no free way was found there from that side")
    if replaced:
        were = "1 of the postures was" if replaced == 1 else f"{replaced} of the postures were"
        lines.append(f"{were} replaced: no free way led there from the others")
    if wound and (replaced or not_free):
        limits = f"[joint_limits_deg] of one turn for joint{'s' * (len(wound) != 1)} {', '.join(map(str, wound))}"
        lines.append(
            "No free way leads into all turns of the joints: of the others the plan says little. "
            f"{limits}, as armcal init writes them, give a plan of where the arm gets."
        )
    return lines + in_sentences(not_free)


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


def one_turn(problem: DesignProblem, room: Room, generator: np.random.Generator) -> Callable[[Array], Array]:
    """What turns joints of postures (m, n) by whole turns, where limits leave room for more than one, and neither the
    criterion nor a list of postures tells the difference: into one turn each, which ends where the arm is least often
    free. Straight moves are shorter then, and more of them are free."""
    lower, upper, whole = problem.lower, problem.upper, 2.0 * np.pi
    first, listed = lower.copy(), problem.choices is not None and not problem.sampled
    wound = turns(problem.model) & (upper - lower > WOUND) & (not listed)
    drawn = random_postures(problem, max(problem.fewest_runs, 50), generator)
    for j in np.flatnonzero(wound):
        turned = np.eye(problem.joints)[j] * np.where(drawn[:, j] + whole <= upper[j], whole, -whole)[:, None] + drawn
        same = (turned[:, j] >= lower[j]) & problem.feasible(turned)
        wound[j] = abs(problem.objective(drawn[same]) - problem.objective(turned[same])) < 1e-6
        ends = np.linspace(lower[j], upper[j] - whole, 13)
        at_ends = np.tile(drawn, (len(ends), 1, 1))
        at_ends[:, :, j] = ends[:, None]
        freely = np.all(room.margin(at_ends.reshape(-1, problem.joints)) >= 0.0, axis=1).reshape(len(ends), -1)
        middle = np.abs(ends - 0.5 * (lower[j] + upper[j] - whole)) / (upper[j] - lower[j])
        first[j] = ends[np.argmin(freely.mean(axis=1) + 1e-3 * middle)]
    return lambda postures: np.where(wound, first + (postures - first) % whole, postures)


def another(
    problem: DesignProblem,
    postures: Array,
    lost: Sequence[int],
    room: Room,
    turn: Callable[[Array], Array],
    generator: np.random.Generator,
) -> Array:
    """(m, n) postures, in the place of lost rows the best of those that have a free move to one of the nearest others:
    the same with joints turned by whole turns, and random ones."""
    postures, kept = postures.copy(), np.delete(np.arange(len(postures)), lost)
    listed, together = problem.choices, 20
    whole = np.array([*product((0.0, 1.0, -1.0), repeat=problem.joints)]) * 2.0 * np.pi * turns(problem.model)
    for row in lost:
        drawn = turn(random_postures(problem, 200, generator)) if listed is None else generator.permutation(listed)
        turned = np.unique(postures[row] + whole, axis=0) if listed is None or problem.sampled else drawn[:0]
        drawn, others = np.concatenate([turned, drawn[:200]]), np.delete(postures, row, axis=0)
        allowed = np.all((drawn >= problem.lower) & (drawn <= problem.upper), axis=1)
        allowed &= room.travel(drawn[:, None], others).min(axis=1, initial=np.inf) >= problem.minimum_distance
        allowed[allowed] = problem.feasible(drawn[allowed])
        best = drawn[allowed]
        best = best[np.argsort(-values_with(problem, others, best), kind="stable")] if len(best) else best
        for some in np.split(best, range(together, len(best), together)):
            near = np.argsort(room.travel(some[:, None], postures[kept]), axis=1)[:, :10]
            ways = room.free(np.repeat(some, near.shape[1], axis=0), postures[kept][near.ravel()])
            led_to = ways.reshape(near.shape).any(axis=1) | (len(kept) == 0)
            if led_to.any():
                postures[row], kept = some[led_to.argmax()], np.append(kept, row)
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


def with_approach(problem: DesignProblem, approach: str, signs: Sequence[int] = ()) -> DesignProblem:
    """The problem with postures that leave room within the limits to come from where they are approached.

    signs : (n) of each joint as the controller counts it, as for `drive`
    """
    if approach == "any":
        return problem
    below, above = SENSES[approach]
    turned = np.array(signs or np.ones(problem.joints)) < 0.0
    away = APPROACH * problem.joint_units
    lower = problem.lower + np.where(turned, above, below) * away
    return replace(problem, lower=lower, upper=problem.upper - np.where(turned, below, above) * away)
