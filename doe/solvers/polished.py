"""Exchange for the pattern, a climb for precision: solvers that put the two together.

Near a good plan there are better ones more often than at random, so each of them also starts from the best plans so
far, or from the optimal weights, with some runs drawn again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from doe.plan.ascent import PlanAscent
from doe.plan.rounding import rounded_plan
from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.exchange import Exchange, ListBatch
from doe.solvers.ipopt import Climber, Ipopt, polishes
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array

SAME = 1e-7  # exchange plans of the same value are taken for the same plan up to symmetry, and polished once
HALF = 0.5  # of the time, at most, for the relaxation
TOGETHER = 2_000  # runs of all starts that climb between two exchanges, at most


@dataclass(frozen=True)
class ExchangeIpopt:
    """Exchange in batches; the best plans of each batch are polished by IPOPT. Every second batch varies the best.

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
        seen, best = list[float](), list[tuple[float, Array]]()
        left, vary = budget.starts, False
        while True:
            started = self.exchange.begin(problem, left, runs, generator)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            if vary:
                elite = np.array([plan for _, plan in best])
                started = varied(
                    started, elite[generator.integers(len(best), size=len(started))], generator, self.redrawn
                )
            plans, values = self.exchange.improve(problem, started, generator, budget)
            yield Offer(plans[0], 1)
            for plan in plans[self._unlike(values, seen)]:
                climbed = climb(plan)
                if np.isfinite(value := problem.objective(climbed)) and unlike(value, [other for other, _ in best]):
                    best = sorted([*best, (value, climbed)], key=lambda pair: -pair[0])[: self.elite]
                yield Offer(climbed, independent=not vary)
                climb.pass_on_interrupt()
            yield Offer(plans[0], len(started) - 1)
            left, vary = left - len(started), not vary and bool(best)

    def _unlike(self, values: Array, seen: list[float]) -> list[int]:
        """Rows of the best plans that no earlier one equals, whose values are added to those seen."""
        rows: list[int] = []
        for k, value in enumerate(values.tolist()):
            if len(rows) < self.polished and np.isfinite(value) and unlike(value, seen):
                seen.append(value)
                rows.append(k)
        return rows


@dataclass(frozen=True)
class RelaxRound:
    """Start 1 is the rounded optimum of the relaxation, the others have some runs drawn again; exchange, then IPOPT.

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

        weights = continuous_design(problem, runs=runs, proof=0.0, stop=budget.part(HALF).ended)
        first = rounded_plan(weights.plan, runs)
        yield Offer(first)
        started = varied(self.exchange.begin(problem, budget.starts, runs, generator), first, generator, self.redrawn)
        started[0] = first
        improved = self.exchange.improve(problem, started, generator, budget)[0]
        if not polishes(problem, runs):
            yield Offer(improved[0], budget.starts)
            return
        climb = Climber(problem, runs, self.ipopt, budget)
        for plan in improved:
            yield Offer(climb(plan), 1)
            climb.pass_on_interrupt()


@dataclass(frozen=True)
class Gradient:
    """L-BFGS from random postures; later batches from exchanges among the postures of the best plans so far: for models
    of many parameters.

    count : starts;  batch : starts between two exchanges, half as many under constraints, where each takes longer
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
        climb, left, best = PlanAscent(problem), budget.starts, list[Array]()
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
            for plan in started:
                climbed = climb(plan, stop=budget.ended)
                yield Offer(climbed, 1, independent=first)
                best.append(climbed)
            best = sorted(best, key=lambda plan: -problem.objective(plan))[:elite]


def varied(plans: Array, best: Array, generator: np.random.Generator, redrawn: float) -> Array:
    """(s, m, n) the best plans (s, m, n), or the best one (m, n), with a fraction of their runs taken from `plans`."""
    kept = generator.random(plans.shape[:2]) > redrawn
    return np.where(kept[..., None], best, plans)


def unlike(value: float, others: list[float]) -> bool:
    """True for a criterion value that none of the others equals."""
    return all(abs(value - other) > SAME for other in others)


def exchanged(
    problem: DesignProblem, pool: Array, shape: tuple[int, int], generator: np.random.Generator, budget: Budget
) -> Array:
    """(s, m, n) plans of the pool's postures that no exchange with the pool improves."""
    postures = np.unique(pool, axis=0)
    search = ListBatch.started(problem, problem.scaled_jacobians(postures), shape, generator)
    search.improve(generator, budget)
    return np.asarray(postures[search.chosen])
