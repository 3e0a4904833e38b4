"""Coordinate exchange on a coarse grid per joint, for many starts at once.

R. K. Meyer, C. J. Nachtsheim, Technometrics 37 (1995); here the best single-joint change over all joints is taken.

One sweep visits every run in random order. The run is taken out of the plan, and put back at the best of all postures
that differ from it in one joint, on the grid; a start ends when a sweep changes nothing. The starts of a batch advance
together, so that numpy works on arrays of starts x candidates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import surrogate, values_after_adding
from doe.plan.ascent import WIDE
from doe.plan.replicate_spacing import distance_to_keep
from doe.problem.feasible import random_grid
from doe.problem.problem import DesignProblem, information_of_each
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array
from identification.information import information_matrix

IMPROVEMENT = 1e-9  # smaller gains of a single exchange are rounding
SWEEPS = 60
TOGETHER = 20_000  # runs of all starts of a batch, at most: keeps memory and time of a batch small


@dataclass(frozen=True)
class Exchange:
    """Coordinate exchange from random grid postures.

    levels : grid values per joint, its limits included;  batch : starts that advance together
    """

    levels: int = 9
    batch: int = 50
    name: str = "exchange"

    def starts_for(self, problem: DesignProblem) -> int:
        """Thirty per pair of joints, as local optima grow with them; fewer for many parameters, as each costs p^3."""
        wanted = max(2 * self.batch, 30 * len(problem.searched_joints) ** 2)
        return max(10, round(wanted * min(1.0, (WIDE / problem.parameters) ** 2)))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """The plans of each batch, best first."""
        left = budget.starts
        while True:
            count = max(1, min(self.batch, left, TOGETHER // runs))
            left -= count
            first = self.begin(problem, count, runs, generator)
            yield Offer(first[0])  # something to return if the user stops during the first batch
            for plan in self.improve(problem, first, generator, budget)[0]:
                yield Offer(plan, 1, independent=True)

    def improve(
        self, problem: DesignProblem, plans: Array, generator: np.random.Generator, budget: Budget
    ) -> tuple[Array, Array]:
        """Plans (s, m, n) that no single exchange improves, and their values (s,), best first."""
        search = GridBatch(problem, self.grid(problem), plans)
        search.improve(generator, budget)
        values = np.asarray(problem.criterion.value(search.information))
        order = np.argsort(-values, kind="stable")
        return search.plans[order], values[order]

    def begin(self, problem: DesignProblem, count: int, runs: int, generator: np.random.Generator) -> Array:
        """(count, m, n) random plans on the grid."""
        postures = random_grid(problem, self.grid(problem), count * runs, generator)
        return postures.reshape(count, runs, problem.joints)

    def grid(self, problem: DesignProblem) -> Array:
        """(n, L) values of every joint, limits included."""
        return np.linspace(problem.lower, problem.upper, self.levels, axis=1)


class Batch:
    """Starts that advance together, whatever postures a run is exchanged for.

    jacobians : (s, m, d, p), scaled;  information : (s, p, p);  values : (s,) criterion, or its surrogate
    running : starts that still improve
    """

    def __init__(self, problem: DesignProblem, jacobians: Array) -> None:
        self.problem, self.jacobians, self.runs = problem, jacobians, jacobians.shape[1]
        self.criterion = surrogate(problem.criterion)
        self.total = self.runs + problem.prior.runs
        self.running = np.arange(len(jacobians))
        self.information, self.values = self._information(self.running)

    def improve(self, generator: np.random.Generator, budget: Budget) -> None:
        """Sweeps until none changes anything, or time is up."""
        for _ in range(SWEEPS):
            if not self.running.size or budget.out_of_time:
                break
            self.sweep(generator, budget)

    def sweep(self, generator: np.random.Generator, budget: Budget) -> None:
        """Every run of every running start once, as long as there is time."""
        before = self.values[self.running]
        for run in generator.permutation(self.runs):
            if budget.out_of_time:
                break
            self.exchange(int(run))
        information, values = self._information(self.running)  # computed afresh: no rounding piles up
        self.information[self.running], self.values[self.running] = information, values
        self.running = self.running[~(values <= before + IMPROVEMENT) | np.isneginf(before)]

    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best reachable posture."""
        raise NotImplementedError

    def _information(self, starts: NDArray[np.intp]) -> tuple[Array, Array]:
        """(s, p, p) information matrices, and (s,) their values."""
        information = self.problem.prior.information(information_matrix(self.jacobians[starts]), self.runs)
        return information, np.array(self.criterion.value(information))


class GridBatch(Batch):
    """Plans (s, m, n) whose runs are exchanged for postures on a grid (n, L) that differ in one joint."""

    def __init__(self, problem: DesignProblem, grid: Array, plans: Array) -> None:
        super().__init__(problem, problem.scaled_jacobians(plans))
        self.grid, self.plans = grid, plans
        self.distance = distance_to_keep(problem, self.runs)
        if not problem.searched_joints:
            self.running = self.running[:0]

    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best reachable posture."""
        old = self.jacobians[self.running, run]
        without = self.information[self.running] - information_of_each(old) / self.total
        postures = self.neighbors(self.plans[self.running, run])
        jacobians = self.problem.scaled_jacobians(postures)
        offered = np.concatenate([old[:, None], jacobians], axis=1) / np.sqrt(self.total)
        values = values_after_adding(self.criterion, without, offered)
        values[:, 1:][~self._allowed(postures, run)] = -np.inf
        starts = np.flatnonzero(values[:, 1:].max(axis=1) > values[:, 0] + IMPROVEMENT)
        best, at = np.argmax(values[starts, 1:], axis=1), self.running[starts]
        self.plans[at, run] = postures[starts, best]
        self.jacobians[at, run] = jacobians[starts, best]
        self.information[at] = without[starts] + information_of_each(self.jacobians[at, run]) / self.total

    def _allowed(self, postures: Array, run: int) -> NDArray[np.bool_]:
        """(s, c) True where a posture satisfies the constraints and repeats no other run of its plan."""
        allowed = self.problem.feasible(postures)
        if self.distance > 0.0:
            others = np.delete(self.plans[self.running], run, axis=1)
            kept = np.broadcast_to(self.problem.kept, (len(others), *self.problem.kept.shape))
            others = self.problem.comparable(np.concatenate([others, kept], axis=1))
            offered = self.problem.comparable(postures)
            for other in np.moveaxis(others, 1, 0):
                allowed &= np.abs(offered - other[:, None]).max(axis=-1) >= self.distance
        return allowed

    def neighbors(self, postures: Array) -> Array:
        """(s, c, n) postures that differ from those given (s, n) in one joint, on the grid."""
        levels = self.grid.shape[1]
        joints = self.problem.searched_joints
        moved = np.repeat(postures[:, None], len(joints) * levels, axis=1)
        for k, joint in enumerate(joints):
            moved[:, k * levels : (k + 1) * levels, joint] = self.grid[joint]
        return moved
