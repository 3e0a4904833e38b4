"""Random postures that satisfy the constraints, however few there are; and the diagnosis where there are none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from doe.problem.constraints import infeasible
from doe.problem.problem import DesignProblem
from identification.arrays import Array

BATCH = 4096
TRIES = 8  # batches without a single feasible posture before they are searched for
CLIMBS = 60  # rounds of that search


def random_postures(problem: DesignProblem, count: int, generator: np.random.Generator) -> Array:
    """(count, n) uniform over the feasible set within the joint limits; near its known points where it is tiny.

    Raises `InputError` naming the constraints that exclude everything.
    """

    def anywhere(size: int) -> Array:
        return generator.uniform(problem.lower, problem.upper, (size, problem.joints))

    if not problem.constraints:
        return anywhere(count)
    return fill(problem, count, anywhere, generator)


def random_grid(problem: DesignProblem, grid: Array, count: int, generator: np.random.Generator) -> Array:
    """(count, n) random feasible postures on the grid (n, L); joints that play no part stay in the middle."""

    def on_grid(size: int) -> Array:
        postures = np.tile((problem.lower + problem.upper) / 2.0, (size, 1))
        for joint in problem.searched_joints:
            postures[:, joint] = grid[joint, generator.integers(grid.shape[1], size=size)]
        return postures

    return fill(problem, count, on_grid, generator) if problem.constraints else on_grid(count)


def fill(problem: DesignProblem, count: int, draw: Callable[[int], Array], generator: np.random.Generator) -> Array:
    """(count, n) feasible postures of those that `draw(size)` makes, or near them where they are too rare."""
    found, seen = np.empty((0, problem.joints)), []
    for _ in range(TRIES):
        drawn = draw(max(BATCH, count))
        seen.append(drawn)
        found = np.concatenate([found, drawn[problem.feasible(drawn)]])
        if len(found) >= count:
            return found[:count]
    if not len(found):
        found = climb(problem, np.concatenate(seen), generator)
    extra = vary(problem, found[generator.integers(len(found), size=count)], generator)
    return np.concatenate([found, extra])[:count] if len(found) < count else found[:count]


def shortfall(problem: DesignProblem, postures: Array) -> Array:
    """(m,) sum over the constraints of how far a posture is from satisfying them; 0 where it does."""
    return sum((np.maximum(-c.margin(postures), 0.0).sum(axis=1) for c in problem.constraints), np.zeros(len(postures)))


def climb(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Feasible postures found by random steps that reduce the shortfall, from the least infeasible of many."""
    miss = shortfall(problem, postures)
    best = postures[np.argsort(miss)[:64]]
    miss = np.sort(miss)[:64]
    for k in range(CLIMBS):
        _step(problem, best, miss, generator.standard_normal((16, *best.shape)) * 0.2 * 0.85**k)
    feasible = best[problem.feasible(best)]
    if not len(feasible):
        raise infeasible(tuple(problem.constraints), np.concatenate([postures, best]))
    return feasible


def _step(problem: DesignProblem, best: Array, miss: Array, steps: Array) -> None:
    """Moves each posture (j, n) of `best` by the step (s, j, n), in widths of the limits, that helps most, in place."""
    trials = problem.clip(best + steps * (problem.upper - problem.lower))
    values = shortfall(problem, trials.reshape(-1, problem.joints)).reshape(len(steps), -1)
    better = values.min(axis=0) < miss
    best[better] = trials[np.argmin(values, axis=0), np.arange(len(best))][better]
    miss[better] = values.min(axis=0)[better]


def vary(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Each posture moved at random as far as it stays feasible: steps are shortened until it does."""
    width = problem.upper - problem.lower
    steps = generator.standard_normal(postures.shape) * width * 0.2
    moved = np.array(postures)
    waiting = np.arange(len(postures))
    for k in range(12):
        trial = problem.clip(postures[waiting] + steps[waiting] * 0.5**k)
        fits = problem.feasible(trial)
        moved[waiting[fits]] = trial[fits]
        waiting = waiting[~fits]
    return moved
