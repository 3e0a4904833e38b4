"""Default solver: coordinate exchange, best plans polished by IPOPT."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from doe.problem.problem import DesignProblem
from doe.solvers.exchange import TOGETHER, Exchange
from doe.solvers.ipopt import Climber, Ipopt, polishes
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array

SAME = 1e-7  # exchange plans of the same value are taken for the same plan up to symmetry, and polished once


@dataclass(frozen=True)
class ExchangeIpopt:
    """Exchange in batches; the best plans of each batch are polished by IPOPT.

    Every second batch starts from the best plans so far with some runs drawn anew: near a good plan there are better
    ones more often than at random.

    polished : plans per batch;  elite : how many of the best plans are varied;  redrawn : fraction of their runs
    """

    exchange: Exchange = field(default_factory=Exchange)
    ipopt: Ipopt = field(default_factory=lambda: Ipopt(warm=True))
    polished: int = 5
    elite: int = 10
    redrawn: float = 0.25
    name: str = "exchange_ipopt"

    def starts_for(self, problem: DesignProblem) -> int:
        """Starts of the exchange."""
        return self.exchange.starts_for(problem)

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """For each batch the best plan unchanged, then the polished ones."""
        if not polishes(problem, runs):
            yield from self.exchange.offers(problem, runs, generator, budget)
            return
        climb = Climber(problem, runs, self.ipopt, budget)
        seen: list[float] = []
        best: list[tuple[float, Array]] = []
        left, vary = budget.starts, False
        while True:
            count = max(1, min(self.exchange.batch, left, TOGETHER // runs))
            started = self.exchange.begin(problem, count, runs, generator)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            if vary:
                started = self._varied(started, [plan for _, plan in best], generator)
            plans, values = self.exchange.improve(problem, started, generator, budget)
            yield Offer(plans[0], 1)
            for k in self._new(values, seen):
                polished = climb(plans[k])
                best = self._elite(best, problem.objective(polished), polished)
                yield Offer(polished, independent=not vary)
                climb.pass_on_interrupt()
            yield Offer(plans[0], count - 1)
            left, vary = left - count, not vary and bool(best)

    def _varied(self, plans: Array, best: list[Array], generator: np.random.Generator) -> Array:
        """(s, m, n) best plans, a random one each, with a fraction of their runs replaced by those of `plans`."""
        kept = generator.random(plans.shape[:2]) > self.redrawn
        return np.where(kept[..., None], np.array(best)[generator.integers(len(best), size=len(plans))], plans)

    def _elite(self, best: list[tuple[float, Array]], value: float, plan: Array) -> list[tuple[float, Array]]:
        """The best plans so far, best first, without repeated values."""
        if not np.isfinite(value) or any(abs(value - other) <= SAME for other, _ in best):
            return best
        return sorted([*best, (value, plan)], key=lambda pair: -pair[0])[: self.elite]

    def _new(self, values: Array, seen: list[float]) -> list[int]:
        """Rows of the best plans that no earlier one equals."""
        chosen: list[int] = []
        for k, value in enumerate(values):
            if len(chosen) < self.polished and np.isfinite(value) and all(abs(value - v) > SAME for v in seen):
                seen.append(float(value))
                chosen.append(k)
        return chosen
