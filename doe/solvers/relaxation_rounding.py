"""Relaxation and rounding: optimal weights by column generation, rounded to whole runs, then polished."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from doe.plan.rounding import rounded_plan
from doe.problem.problem import DesignProblem
from doe.solvers.exchange import TOGETHER, Exchange
from doe.solvers.ipopt import Climber, Ipopt, polishes
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array

HALF = 0.5  # of the time, at most, for the relaxation


@dataclass(frozen=True)
class RelaxRound:
    """Start 1 is the rounded optimum of the relaxation, the others have some runs drawn anew; exchange, then IPOPT.

    count : starts;  redrawn : fraction of the runs
    """

    count: int = 20
    redrawn: float = 0.25
    exchange: Exchange = field(default_factory=Exchange)
    ipopt: Ipopt = field(default_factory=lambda: Ipopt(warm=True))
    name: str = "relaxation_rounding"

    def starts_for(self, problem: DesignProblem) -> int:
        """The same for every problem."""
        return self.count

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """The rounded plan as it is, then one offer per start."""
        from doe.bounds.column_generation import continuous_design  # deferred: it needs scipy.linalg

        first = rounded_plan(continuous_design(problem, runs=runs, proof=0.0, stop=budget.part(HALF).ended).plan, runs)
        yield Offer(first)
        started = self._begin(problem, first, min(budget.starts, max(1, TOGETHER // runs)), generator)
        improved = self.exchange.improve(problem, started, generator, budget)[0]
        if not polishes(problem, runs):
            yield Offer(improved[0], budget.starts)
            return
        climb = Climber(problem, runs, self.ipopt, budget)
        for plan in improved:
            yield Offer(climb(plan), 1)
            climb.pass_on_interrupt()

    def _begin(self, problem: DesignProblem, first: Array, count: int, generator: np.random.Generator) -> Array:
        plans = self.exchange.begin(problem, count, len(first), generator)
        kept = generator.random(plans.shape[:2]) > self.redrawn
        kept[0] = True
        return np.where(kept[..., None], first, plans)
