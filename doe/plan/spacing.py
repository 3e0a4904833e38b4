"""Different postures: repeats are moved apart, joints that play no part are spread; and the posture that adds most.

Two postures of a plan, and of those measured already, differ by the minimum distance in some joint, in
`DesignProblem.joint_units`; out of a list each is another one.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from doe.criteria import information_matrix
from doe.problem.problem import DesignProblem, half_at_limits, listed_candidates
from identification import Array

ROUNDING = 1.0 + 1e-9


def free_joints(problem: DesignProblem) -> list[int]:
    """Joints (from 0) that play no part, the one with the widest range first."""
    free = [joint for joint in range(problem.joints) if joint not in problem.searched_joints]
    ranges = problem.comparable(problem.upper - problem.lower)
    return sorted(free, key=lambda joint: -ranges[joint])


def places_of_free_joint(problem: DesignProblem) -> int:
    """How many postures that are alike in all other joints the widest free joint sets apart; 1 without one."""
    width = problem.comparable(problem.upper - problem.lower)[free_joints(problem)].max(initial=0.0)
    return max(1, int(width / max(problem.minimum_distance, 1e-9) * ROUNDING))


def allowed_value(problem: DesignProblem, postures: Array) -> float:
    """Criterion value of a plan; -inf if a posture violates a constraint or is a repeat that is not allowed."""
    allowed = problem.feasible(postures).all() and not len(too_near(problem, postures))
    return problem.objective(postures) if allowed else -np.inf


def gaps(problem: DesignProblem, postures: Array, others: Array) -> Array:
    """(m, k) largest joint difference between postures (m, n) and others (k, n)."""
    return np.abs(problem.comparable(postures)[:, None] - problem.comparable(others)).max(axis=-1, initial=0.0)


def too_near(problem: DesignProblem, postures: Array) -> NDArray[np.intp]:
    """Rows that come too near earlier rows, or postures measured already; in very long plans later rows count too."""
    if problem.choices is not None or problem.minimum_distance == 0.0:
        return np.empty(0, dtype=np.intp)
    points, distance = np.concatenate([problem.kept, postures]), problem.minimum_distance / ROUNDING
    crowded = np.arange(len(points))
    if len(points) > 200:
        from scipy.spatial import KDTree  # 0.1 s to import

        compared = problem.comparable(points)
        near = KDTree(compared).query_ball_point(compared, distance, p=np.inf, return_length=True)
        crowded = np.flatnonzero(near > 1)
    if len(crowded) <= 3000:  # else there are too many pairs to compare
        crowded = crowded[np.tril(gaps(problem, points[crowded], points[crowded]) < distance, -1).any(axis=1)]
    return crowded[crowded >= len(problem.kept)] - len(problem.kept)


def best_beside(problem: DesignProblem, plan: Array, places: Array) -> Array:
    """(j, n) those of the places (k, n) that are feasible and repeat no run of a plan (m, n), nor what was measured
    already; the one that adds most to the criterion comes first."""
    distance = min(problem.minimum_distance / ROUNDING, np.inf if problem.choices is None else 1e-300)
    places = places[(gaps(problem, places, np.concatenate([plan, problem.kept])) >= distance).all(axis=1)]
    places = places[problem.feasible(places)]
    runs = len(plan) + problem.prior.runs + 1.0
    information = (information_matrix(problem.scaled_jacobians(plan)) + problem.prior.total) / runs
    offered = problem.scaled_jacobians(places) / np.sqrt(runs)
    values = problem.criterion.smooth.values_after_adding(information[None], offered[None])[0]
    return places[np.argsort(-values, kind="stable")]


def separated(problem: DesignProblem, postures: Array) -> Array:
    """The same plan with every repeat moved to the best free posture near it; unchanged where there is none."""
    plan, crowded = np.array(postures), too_near(problem, postures)
    size = problem.minimum_distance * ROUNDING * problem.joint_units * np.eye(problem.joints)
    steps = np.concatenate([count * size for count in (-3, -2, -1, 1, 2, 3)])  # of one joint, and below of two
    two = (steps[:, None] + steps).reshape(-1, problem.joints)
    steps = np.concatenate([steps, two[np.count_nonzero(two, axis=1) == 2]])
    for row in crowded if len(crowded) <= 2000 else ():
        around = plan[row] + steps
        around = around[np.all((around >= problem.lower) & (around <= problem.upper), axis=1)]
        if len(places := best_beside(problem, np.delete(plan, row, axis=0), around)):
            plan[row] = places[0]
    return plan


def spread_free_joints(problem: DesignProblem, postures: Array, generator: Generator) -> Array:
    """The same plan with joints that play no part spread evenly over their limits in shuffled order.

    They cost nothing and help to see missing effects, instead of staying at a constant. Where even steps are below the
    minimum distance, rows that are alike in all other joints take the places of the widest in turn.
    """
    spread, m = np.array(postures), len(postures)
    for joint in free_joints(problem):
        shares = (generator.permutation(m) + 0.5) / m
        if 1 < (count := places_of_free_joint(problem)) < m and joint == free_joints(problem)[0]:
            alike = np.round(problem.comparable(postures)[:, list(problem.searched_joints)], 6)
            order = np.lexsort(alike.T) if alike.size else np.arange(m)
            shares[order] = (generator.permutation(count)[np.arange(m) % count] + 0.5) / count
        spread[:, joint] = problem.lower[joint] + shares * (problem.upper[joint] - problem.lower[joint])
    return spread


def with_additions(problem: DesignProblem, plan: Array, count: int, generator: Generator) -> Array | None:
    """(m + count, n) the plan (m, n) and, one by one, the postures that add most; None where none more is allowed."""
    longer, listed = np.array(plan), problem.choices
    # effort: random places
    places = half_at_limits(problem, 1500, generator) if listed is None else listed_candidates(problem, listed)
    for _ in range(count):
        if not len(best := best_beside(problem, longer, places)[:1]):
            return None
        # random postures around the best, at ever smaller parts of half the range of each joint
        for step in 0.3 * 0.3 ** np.arange(8) if listed is None else ():
            moves = step * generator.standard_normal((64, problem.joints))
            near = problem.clip(best + moves * 0.5 * (problem.upper - problem.lower))
            best = best_beside(problem, longer, np.concatenate([best, near]))[:1]
        longer = np.concatenate([longer, best])
    return longer
