"""Minimum distance between postures, spreading of joints that play no part, and the posture that adds most to a plan.

Distances are the largest difference of a joint, in `DesignProblem.joint_units`.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from doe.criteria import information_matrix
from doe.problem.postures import half_at_limits, listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from identification import Array

ROUNDING = 1.0 + 1e-9
CHUNK = 10_000_000  # pairs of rows to compare one by one


def distance_to_keep(problem: DesignProblem, runs: int) -> float:
    """[rad] by which a search keeps postures apart in its joints; 0 where spreading a free joint sets them apart."""
    return problem.minimum_distance if 1.0 == replicates_allowed(problem) < runs else 0.0


def free_joints(problem: DesignProblem) -> list[int]:
    """Joints (from 0) that play no part, the one with the widest range first."""
    free = [joint for joint in range(problem.joints) if joint not in problem.searched_joints]
    ranges = problem.comparable(problem.upper - problem.lower)
    return sorted(free, key=lambda joint: -ranges[joint])


def replicates_allowed(problem: DesignProblem) -> float:
    """How many postures that are alike in the searched joints a free joint can set apart; infinite: repeats are fine.

    A list of postures says itself which are different.
    """
    if problem.choices is not None or problem.minimum_distance == 0.0:
        return float("inf")
    width = problem.comparable(problem.upper - problem.lower)[free_joints(problem)].max(initial=0.0)
    return float(max(1.0, np.floor(width / problem.minimum_distance * ROUNDING)))


def allowed_value(problem: DesignProblem, postures: Array) -> float:
    """Criterion value of a plan; -inf if a posture violates a constraint or is a repeat that is not allowed."""
    allowed = problem.feasible(postures).all() and not len(too_near(problem, postures))
    return problem.objective(postures) if allowed else -np.inf


def gaps(postures: Array, others: Array) -> Array:
    """(m, k) largest joint difference between postures (m, n) and others (k, n), in their unit."""
    return np.abs(postures[:, None] - others).max(axis=-1, initial=0.0)


def searched_part(problem: DesignProblem, postures: Array) -> Array:
    """(m, j) the joints that a solver chooses, in the problem's `joint_units`."""
    return problem.comparable(postures)[:, list(problem.searched_joints)]


def too_near(problem: DesignProblem, postures: Array) -> NDArray[np.intp]:
    """Rows that come too near earlier rows, or postures measured already, in more places than a free joint has.

    Without a free joint that is within the minimum distance of a single one. In very long plans later rows count too.
    """
    capacity = replicates_allowed(problem)
    if capacity >= len(postures):
        return np.empty(0, dtype=np.intp)
    searched, distance = searched_part(problem, postures), problem.minimum_distance / ROUNDING
    blocked = 1 if capacity == 1.0 else 2  # places on a free joint within the distance of a measured posture
    near = blocked * (gaps(searched, searched_part(problem, problem.kept)) < distance).sum(axis=1)
    crowded = np.flatnonzero(near + neighbor_counts(searched, distance) >= capacity)
    if len(crowded) * len(postures) > CHUNK:
        return crowded
    earlier = [np.count_nonzero(gaps(searched[row, None], searched[:row]) < distance) for row in crowded.tolist()]
    return crowded[near[crowded] + np.array(earlier, dtype=int) >= capacity]


def neighbor_counts(points: Array, distance: float) -> NDArray[np.intp]:
    """(m,) number of other rows nearer than the distance in every column."""
    if points.shape[1] == 0:
        return np.full(len(points), len(points) - 1)
    return _counted(np.ascontiguousarray(points).tobytes(), points.shape[1], distance)


@lru_cache(maxsize=2)
def _counted(content: bytes, columns: int, distance: float) -> NDArray[np.intp]:
    """Remembered, since a search asks of one plan again and again; of 100,000 rows an answer takes seconds."""
    from scipy.spatial import KDTree  # 0.1 s to import

    points = np.frombuffer(content).reshape(-1, columns)
    counts = np.asarray(KDTree(points).query_ball_point(points, distance, p=np.inf, return_length=True)) - 1
    counts.setflags(write=False)
    return counts


def separated(problem: DesignProblem, postures: Array) -> Array:
    """The same plan with every repeat moved to the best free posture near it; unchanged where there is none."""
    plan, crowded = np.array(postures), too_near(problem, postures)
    sizes = problem.minimum_distance * ROUNDING * np.array([-3, -2, -1, 1, 2, 3])
    units = (problem.joint_units * np.eye(problem.joints))[list(problem.searched_joints)]
    steps = [size * unit for unit in units for size in sizes]  # of one joint, and below of two
    steps += [a + b for a, b in product(steps, steps) if np.count_nonzero(a + b) == 2] if len(crowded) else []
    for row in crowded if len(crowded) * len(plan) <= CHUNK else ():
        others = np.vstack([np.delete(plan, row, axis=0), problem.kept])
        around = plan[row] + np.array(steps)
        around = around[np.all((around >= problem.lower) & (around <= problem.upper), axis=1)]
        if len(places := with_room(problem, around, others)):
            information = information_matrix(problem.scaled_jacobians(others)) / len(others)
            jacobians = problem.scaled_jacobians(places) / np.sqrt(len(others))
            values = problem.criterion.surrogate.values_after_adding(information[None], jacobians[None])[0]
            plan[row] = places[np.argmax(values)]
    return plan


def with_room(problem: DesignProblem, places: Array, others: Array) -> Array:
    """Those of the places (k, n) that are feasible and have room for one more beside the `others` (j, n).

    Of a list each posture is another one, and each may be measured once unless repeats are allowed.
    """
    if problem.choices is not None and problem.minimum_distance > 0.0:
        return places[(gaps(places, others) > 0.0).all(axis=1)]
    near = gaps(searched_part(problem, places), searched_part(problem, others)) < problem.minimum_distance / ROUNDING
    places = places[near.sum(axis=1) < replicates_allowed(problem)]
    return places[problem.feasible(places)] if len(places) else places


def spread_free_joints(problem: DesignProblem, postures: Array, generator: Generator) -> Array:
    """The same plan with joints that play no part spread evenly over their limits in shuffled order.

    They cost nothing and help to see missing effects (identification/README.md, "Lessons"), instead of staying at a
    constant. Where even steps are below the minimum distance, the widest of them sets apart postures that are alike in
    all other joints.
    """
    spread, m = np.array(postures), len(postures)
    for joint in free_joints(problem):
        shares = (generator.permutation(m) + 0.5) / m
        spread[:, joint] = problem.lower[joint] + shares * (problem.upper[joint] - problem.lower[joint])
    if not 1.0 < replicates_allowed(problem) < m:
        return spread
    from scipy.spatial import KDTree

    # of evenly spaced values of the widest free joint the least used that no equal posture has yet
    joint, count = free_joints(problem)[0], int(replicates_allowed(problem))
    searched, kept = searched_part(problem, spread), searched_part(problem, problem.kept)
    width, distance = problem.upper[joint] - problem.lower[joint], problem.minimum_distance / ROUNDING
    places = problem.lower[joint] + (np.arange(count) + 0.5) / count * width
    by_measured = gaps(places[:, None], problem.kept[:, joint, None]) < distance * problem.joint_units[joint]
    used, chosen = np.zeros(count), np.full(m, -1)
    tree = KDTree(searched if searched.shape[1] else np.zeros((m, 1)))
    for rows in np.array_split(np.arange(m), -(-m // 256)):  # rows whose neighbors are sought at once
        wishes = generator.uniform(0.0, 0.5, (len(rows), count))
        alike = tree.query_ball_point(tree.data[rows], distance, p=np.inf)
        beside = gaps(searched[rows], kept) < distance
        for row, wish, near, measured in zip(rows.tolist(), wishes, alike, beside, strict=True):
            cost, taken = used + wish, chosen[near]
            cost[taken[taken >= 0]] = np.inf
            cost[by_measured[:, measured].any(axis=1)] = np.inf
            chosen[row] = np.argmin(cost)
            used[chosen[row]] += 1.0
    spread[:, joint] = places[chosen]
    return spread


# -- additions ---------------------------------------------------------------------------------------------------------
def with_additions(problem: DesignProblem, plan: Array, count: int, generator: Generator) -> Array | None:
    """(m + count, n) the plan (m, n) and, one by one, the postures that add most; None where none more is allowed."""
    total = len(plan) + problem.prior.runs

    def best(places: Array) -> Array | None:
        """(n,) the place that the plan gains most by; None where none is allowed beside the plan's postures."""
        places = with_room(problem, places, np.concatenate([longer, problem.kept]))
        if not len(places):
            return None
        before = total / (total + 1.0) * problem.information(longer)[None]
        offered = problem.scaled_jacobians(places)[None] / np.sqrt(total + 1.0)
        return np.asarray(places[np.argmax(problem.criterion.surrogate.values_after_adding(before, offered)[0])])

    longer, listed = np.array(plan), problem.choices
    if listed is not None:
        places = listed_candidates(problem, listed)
    else:
        anywhere = random_postures(problem, 2000, generator)
        places = half_at_limits(problem, anywhere, anywhere[:1000], generator)
    for _ in range(count):
        if (posture := best(places)) is None:
            return None
        # random postures around the best, at ever smaller parts of half the range of each joint
        for step in 0.3 * 0.3 ** np.arange(8) if listed is None else ():
            moves = step * generator.standard_normal((64, problem.joints))
            near = problem.clip(posture + moves * 0.5 * (problem.upper - problem.lower))
            better = best(np.concatenate([posture[None], near]))
            posture = posture if better is None else better
        longer, total = np.concatenate([longer, posture[None]]), total + 1.0
    return longer
