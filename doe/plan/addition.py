"""A plan and the posture that adds most to it: what is known never shrinks by measuring once more.

The information of m + 1 runs is that of m runs plus B^T B of the one added, which is positive semidefinite. So no
criterion of the whole information, no standard deviation and no error of the tip can become worse
(doe/README.md, "Exact plans").
"""

from __future__ import annotations

import numpy as np

from doe.criteria.criterion import surrogate, values_after_adding
from doe.plan.replicate_spacing import with_room
from doe.problem.postures import listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from identification.arrays import Array

PLACES = 2000  # random postures, of which half have each joint at a limit with probability one half
AROUND = 64  # random postures around the best
STEPS = 0.3 * 0.3 ** np.arange(8)  # standard deviations of their distances, in half the range of each joint


def with_additions(problem: DesignProblem, plan: Array, count: int, generator: np.random.Generator) -> Array | None:
    """(m + count, n) the plan (m, n) and, one by one, the postures that add most; None where none more is allowed."""
    longer = np.array(plan)
    if problem.choices is not None:
        places = listed_candidates(problem, problem.choices).postures
    else:  # random allowed postures, many of them at limits
        anywhere = random_postures(problem, PLACES, generator)
        half = anywhere[: PLACES // 2]
        nearer = np.where(half < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
        places = np.concatenate([anywhere, np.where(generator.random(half.shape) < 0.5, nearer, half)])
    for _ in range(count):
        posture = _best(problem, longer, places)
        if posture is None:
            return None
        for step in STEPS if problem.choices is None else ():
            moves = step * generator.standard_normal((AROUND, problem.joints))
            near = problem.clip(posture + moves * 0.5 * (problem.upper - problem.lower))
            best = _best(problem, longer, np.concatenate([posture[None], near]))
            posture = posture if best is None else best
        longer = np.concatenate([longer, posture[None]])
    return longer


def _best(problem: DesignProblem, plan: Array, places: Array) -> Array | None:
    """(n,) the place that the plan gains most by; None where none is allowed beside the plan's postures."""
    places = with_room(problem, places, np.concatenate([plan, problem.kept]))
    if not len(places):
        return None
    total = len(plan) + 1 + problem.prior.runs
    share = (total - 1.0) / total
    offered = problem.scaled_jacobians(places)[None] / np.sqrt(total)
    values = values_after_adding(surrogate(problem.criterion), share * problem.information(plan)[None], offered)[0]
    return np.asarray(places[int(np.argmax(values))])
