"""Many starts climb together on gradients alone, and exchange what they found: for models of many parameters."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from doe.plan.constrained_ascent import ascent
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.fedorov import ListBatch, initial
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array

TOGETHER = 2_000  # runs of all starts of a batch, at most: their arrays stay in the processor's cache


@dataclass(frozen=True)
class Gradient:
    """L-BFGS from random postures; later batches from exchanges among the postures of the best plans so far.

    count : starts;  batch : starts that climb together, half as many under constraints, where each takes longer
    pool : postures to exchange, of as many plans as have them
    """

    count: int = 15
    batch: int = 10
    pool: int = 300
    name: str = "gradient"

    def starts_for(self, problem: DesignProblem) -> int:
        """Fewer under constraints."""
        return min(self.count, 2 * self._together(problem)) if problem.constraints else self.count

    def _together(self, problem: DesignProblem) -> int:
        return max(1, self.batch // 2) if problem.constraints else self.batch

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One offer per start."""
        climb, left, best = ascent(problem), budget.starts, list[Array]()
        elite = max(2, self.pool // runs)
        while True:
            count = max(1, min(self._together(problem), left, TOGETHER // runs))
            left -= count
            started = random_postures(problem, count * runs, generator).reshape(count, runs, -1)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            first = not best
            if not first or problem.constraints:  # penalties climb slowly from poor plans
                pool = np.concatenate([*best, *(started if first else started[:1])])
                started = exchanged(problem, pool, (count, runs), generator, budget)
            plans = climb(started, stop=budget.ended)
            for plan in plans:
                yield Offer(plan, 1, independent=first)
            best = sorted([*best, *plans], key=lambda plan: -problem.objective(plan))[:elite]


def exchanged(
    problem: DesignProblem, pool: Array, shape: tuple[int, int], generator: np.random.Generator, budget: Budget
) -> Array:
    """(s, m, n) plans of the pool's postures that no exchange with the pool improves."""
    postures = np.unique(pool, axis=0)
    offered = problem.scaled_jacobians(postures)
    search = ListBatch(problem, offered, initial(problem, len(offered), shape, generator))
    search.improve(generator, budget)
    return np.asarray(postures[search.chosen])
