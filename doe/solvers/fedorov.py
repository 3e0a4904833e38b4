"""Modified Fedorov exchange on a list of allowed postures: choose m of N, for many starts at once.

R. D. Cook, C. J. Nachtsheim, Technometrics 22 (1980), after V. V. Fedorov, "Theory of Optimal Experiments", 1972: each
run in turn is replaced by the best of all N candidates.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import values_after_adding
from doe.problem.candidates import listed_candidates
from doe.problem.problem import DesignProblem, information_of_each
from doe.solvers.exchange import IMPROVEMENT, Batch
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array
from identification.errors import InputError

MANY, FEWEST = 100, 2  # parameters from which there are fewer starts; the fewest starts
CHUNK = 20_000  # starts x candidates compared at once: stays in the processor's cache


@dataclass(frozen=True)
class Fedorov:
    """Exchange with all of `problem.choices` for every run, from random choices; each once unless repeats are allowed.

    count : starts;  batch : starts that advance together, one by one where there is a prior over many effects: a start
        takes seconds then, and a time limit is to find some at their end
    """

    count: int = 30
    batch: int = 10
    name: str = "fedorov"

    def starts_for(self, problem: DesignProblem) -> int:
        """Each start is thorough; fewer for many parameters that have a prior, as each costs the square of them."""
        if not problem.deviations:
            return self.count
        return max(FEWEST, round(self.batch * min(1.0, (MANY / problem.parameters) ** 2)))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One offer per start. Raises `InputError` without choices, or with fewer of them than runs."""
        postures, jacobians = allowed_choices(problem, runs)
        together = 1 if problem.deviations else self.batch
        while True:
            state = ListBatch(problem, jacobians, initial(problem, len(jacobians), (together, runs), generator))
            state.improve(generator, budget)
            for chosen in state.chosen[np.argsort(-state.values, kind="stable")]:
                yield Offer(postures[chosen], 1, independent=True)


def allowed_choices(problem: DesignProblem, runs: int) -> tuple[Array, Array]:
    """(N, n) choices within limits and constraints, and their scaled Jacobians (N, d, p)."""
    if problem.choices is None:
        raise InputError("solver: fedorov needs a list of postures, found none, allowed: with --candidates")
    postures = listed_candidates(problem, problem.choices).postures
    if problem.minimum_distance > 0.0:
        postures = np.unique(postures, axis=0)
        if len(postures) < runs:
            raise InputError(
                f"runs: found {runs}, allowed: up to {len(postures)}, the different postures to choose from"
            )
    return postures, problem.scaled_jacobians(postures)


def initial(
    problem: DesignProblem, total: int, shape: tuple[int, int], generator: np.random.Generator
) -> NDArray[np.intp]:
    """(s, m) random rows of the list."""
    if problem.minimum_distance > 0.0:
        return np.array([generator.choice(total, shape[1], replace=False) for _ in range(shape[0])])
    return generator.integers(total, size=shape)


class ListBatch(Batch):
    """Rows (s, m) of the list, `chosen`, whose runs are exchanged for any of the N postures; offered : (N, d, p)."""

    def __init__(self, problem: DesignProblem, offered: Array, chosen: NDArray[np.intp]) -> None:
        super().__init__(problem, offered[chosen])
        self.offered, self.chosen = offered, chosen

    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best posture of the list."""
        for start in self.running:
            self._exchange(int(start), run)

    def _exchange(self, start: int, run: int) -> None:
        old = self.chosen[start, run]
        without = self.information[start] - information_of_each(self.offered[old]) / self.total
        values = np.concatenate(
            [
                values_after_adding(self.criterion, without[None], part[None] / np.sqrt(self.total))[0]
                for part in np.array_split(self.offered, -(-len(self.offered) // CHUNK))
            ]
        )
        now = values[old]
        if self.problem.minimum_distance > 0.0:
            values[self.chosen[start]] = -np.inf
        best = int(np.argmax(values))
        if values[best] > now + IMPROVEMENT:
            self.chosen[start, run], self.jacobians[start, run] = best, self.offered[best]
            self.information[start] = without + information_of_each(self.offered[best]) / self.total
