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
    feasible, seen = np.empty((0, problem.joints)), []
    for _ in range(TRIES):
        drawn = draw(max(BATCH, count))
        seen.append(drawn)
        feasible = np.concatenate([feasible, drawn[problem.feasible(drawn)]])
        if len(feasible) >= count:
            return feasible[:count]
    if not len(feasible):
        feasible = led_inside(problem, np.concatenate(seen), generator)
    near = vary(problem, feasible[generator.integers(len(feasible), size=count)], generator)
    return np.concatenate([feasible, near])[:count]


def led_inside(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Feasible postures near the least infeasible of many, by random steps that reduce by how much they are so."""

    def shortfall(postures: Array) -> Array:
        """(m,) sum over the constraints of how far a posture is from satisfying them; 0 where it does."""
        return np.sum([np.maximum(-c.margin(postures), 0.0).sum(axis=1) for c in problem.constraints], axis=0)

    best = postures[np.argsort(shortfall(postures))[:64]]
    miss, width = shortfall(best), problem.upper - problem.lower
    for k in range(CLIMBS):
        trials = problem.clip(best + generator.standard_normal((16, *best.shape)) * 0.2 * 0.85**k * width)
        values = shortfall(trials.reshape(-1, problem.joints)).reshape(len(trials), -1)
        better = values.min(axis=0) < miss
        best[better] = trials[np.argmin(values, axis=0), np.arange(len(best))][better]
        miss[better] = values.min(axis=0)[better]
    feasible = best[problem.feasible(best)]
    if not len(feasible):
        raise infeasible(tuple(problem.constraints), np.concatenate([postures, best]))
    return feasible


def vary(problem: DesignProblem, postures: Array, generator: np.random.Generator) -> Array:
    """Each posture moved at random as far as it stays feasible: steps are shortened until it does."""
    steps = generator.standard_normal(postures.shape) * (problem.upper - problem.lower) * 0.2
    moved, waiting = np.array(postures), np.arange(len(postures))
    for k in range(12):
        trial = problem.clip(postures[waiting] + steps[waiting] * 0.5**k)
        fits = problem.feasible(trial)
        moved[waiting[fits]] = trial[fits]
        waiting = waiting[~fits]
    return moved
