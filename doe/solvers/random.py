"""Random postures, and the best of many random plans: common practice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.solver import Budget, Offer


@dataclass(frozen=True)
class Random:
    """Plans uniform within the joint limits, the best of `count`. One: a random plan."""

    count: int = 1
    name: str = "random"

    def starts_for(self, problem: DesignProblem) -> int:
        """Number of random plans."""
        return self.count

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One random plan per start."""
        while True:
            yield Offer(random_postures(problem, runs, generator), 1)
