"""Exchange, for many starts at once: each run in turn is taken out of the plan and replaced by the best posture.

`Exchange` offers all postures that differ from the run's in one joint, on a coarse grid per joint: coordinate exchange
(R. K. Meyer, C. J. Nachtsheim, Technometrics 37, 1995), here with the best single-joint change over all joints.
`Fedorov` offers a whole list (R. D. Cook, C. J. Nachtsheim, Technometrics 22 (1980), after V. V. Fedorov, "Theory of
Optimal Experiments", 1972). One sweep visits every run in random order; a start ends when a sweep changes nothing. The
starts of a batch advance together, so that numpy works on arrays of starts x candidates.

Exchange for the pattern, a climb for precision: solvers that put the two together.

Near a good plan there are better ones more often than at random, so each of them also starts from the best plans so
far, or from the optimal weights, with some runs drawn again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from doe.criteria.criterion import surrogate, values_after_adding
from doe.plan.ascent import PlanAscent
from doe.plan.plan import rounded_plan
from doe.plan.spacing import distance_to_keep
from doe.problem.postures import fill, listed_candidates, random_postures
from doe.problem.problem import MANY, DesignProblem, information_of_each
from doe.solvers.ipopt import Climber, Ipopt, polishes
from doe.solvers.solver import Budget, Offer
from identification import Array, InputError, information_matrix

IMPROVEMENT = 1e-9  # smaller gains of a single exchange are rounding


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
        return max(10, round(wanted * min(1.0, (MANY / problem.parameters) ** 2)))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """The plans of each batch, best first."""
        left = budget.starts
        while True:
            started = self.begin(problem, left, runs, generator)
            left -= len(started)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            for plan in self.improve(problem, started, generator, budget)[0]:
                yield Offer(plan, 1, independent=True)

    def begin(self, problem: DesignProblem, left: int, runs: int, generator: np.random.Generator) -> Array:
        """(s, m, n) random plans on the grid: a batch, or as many starts as are left; joints that play no part stay in
        the middle."""
        # runs of all starts, at most: keeps memory and time of a batch small
        count, grid = max(1, min(self.batch, left, 20_000 // runs)), self.grid(problem)

        def on_grid(size: int) -> Array:
            postures = np.tile((problem.lower + problem.upper) / 2.0, (size, 1))
            for joint in problem.searched_joints:
                postures[:, joint] = grid[joint, generator.integers(grid.shape[1], size=size)]
            return postures

        size = count * runs
        postures = fill(problem, size, on_grid, generator) if problem.constraints else on_grid(size)
        return postures.reshape(count, runs, problem.joints)

    def improve(
        self, problem: DesignProblem, plans: Array, generator: np.random.Generator, budget: Budget
    ) -> tuple[Array, Array]:
        """Plans (s, m, n) that no single exchange improves, and their values (s,), best first."""
        search = GridBatch(problem, self.grid(problem), plans)
        search.improve(generator, budget)
        values = np.asarray(problem.criterion.value(search.information))
        order = np.argsort(-values, kind="stable")
        return search.plans[order], values[order]

    def grid(self, problem: DesignProblem) -> Array:
        """(n, L) values of every joint, limits included."""
        return np.linspace(problem.lower, problem.upper, self.levels, axis=1)


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
        # fewer of a list where parameters are many
        return max(2, round(self.batch * min(1.0, (100 / problem.parameters) ** 2)))

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One offer per start. Raises `InputError` without choices, or with fewer of them than runs."""
        if problem.choices is None:
            raise InputError("solver: fedorov needs a list of postures, found none, allowed: with --candidates")
        postures = listed_candidates(problem, problem.choices).postures
        if problem.minimum_distance > 0.0:
            postures = np.unique(postures, axis=0)
            if len(postures) < runs:
                allowed = f"up to {len(postures)}, the different postures to choose from"
                raise InputError(f"runs: found {runs}, allowed: {allowed}")
        shape = (1 if problem.deviations else self.batch, runs)
        jacobians = problem.scaled_jacobians(postures)
        while True:
            search = ListBatch.started(problem, jacobians, shape, generator)
            search.improve(generator, budget)
            for chosen in search.chosen[np.argsort(-search.values, kind="stable")]:
                yield Offer(postures[chosen], 1, independent=True)


class Batch(ABC):
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
        for _ in range(60):
            if not self.running.size or budget.out_of_time:
                break
            before = self.values[self.running]
            for run in generator.permutation(self.runs).tolist():
                if budget.ended():
                    break
                self.exchange(run)
            information, values = self._information(self.running)  # computed afresh: no rounding piles up
            self.information[self.running], self.values[self.running] = information, values
            self.running = self.running[~(values <= before + IMPROVEMENT) | np.isneginf(before)]

    @abstractmethod
    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best posture on offer."""

    def _information(self, starts: NDArray[np.intp]) -> tuple[Array, Array]:
        """(s, p, p) information matrices, and (s,) their values."""
        information = self.problem.prior.information(information_matrix(self.jacobians[starts]), self.runs)
        return information, np.array(self.criterion.value(information))

    def _put(self, starts: NDArray[np.intp], run: int, without: Array, jacobians: Array) -> None:
        """Put postures with these Jacobians (s, d, p) in the place of a run; `without` (s, p, p): all but that run."""
        self.jacobians[starts, run] = jacobians
        self.information[starts] = without + information_of_each(jacobians) / self.total


class GridBatch(Batch):
    """Plans (s, m, n) whose runs are exchanged for postures on a grid (n, L) that differ in one joint."""

    def __init__(self, problem: DesignProblem, grid: Array, plans: Array) -> None:
        super().__init__(problem, problem.scaled_jacobians(plans))
        self.grid, self.plans = grid, plans
        self.distance = distance_to_keep(problem, self.runs)
        if not problem.searched_joints:
            self.running = self.running[:0]

    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best posture on offer."""
        old = self.jacobians[self.running, run]
        without = self.information[self.running] - information_of_each(old) / self.total
        postures = self._neighbors(self.plans[self.running, run])
        jacobians = self.problem.scaled_jacobians(postures)
        offered = np.concatenate([old[:, None], jacobians], axis=1) / np.sqrt(self.total)
        values = values_after_adding(self.criterion, without, offered)
        values[:, 1:][~self._allowed(postures, run)] = -np.inf
        starts = np.flatnonzero(values[:, 1:].max(axis=1) > values[:, 0] + IMPROVEMENT)
        best, at = np.argmax(values[starts, 1:], axis=1), self.running[starts]
        self.plans[at, run] = postures[starts, best]
        self._put(at, run, without[starts], jacobians[starts, best])

    def _neighbors(self, postures: Array) -> Array:
        """(s, c, n) postures that differ from those given (s, n) in one joint, on the grid."""
        levels, joints = self.grid.shape[1], self.problem.searched_joints
        moved = np.repeat(postures[:, None], len(joints) * levels, axis=1)
        for k, joint in enumerate(joints):
            moved[:, k * levels : (k + 1) * levels, joint] = self.grid[joint]
        return moved

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


class ListBatch(Batch):
    """Rows (s, m) of a list, `chosen`, whose runs are exchanged for any of its N postures; offered : (N, d, p)."""

    def __init__(self, problem: DesignProblem, offered: Array, chosen: NDArray[np.intp]) -> None:
        super().__init__(problem, offered[chosen])
        self.offered, self.chosen = offered, chosen

    @classmethod
    def started(
        cls, problem: DesignProblem, offered: Array, shape: tuple[int, int], generator: np.random.Generator
    ) -> ListBatch:
        """(s, m) random rows of the list."""
        if problem.minimum_distance == 0.0:
            return cls(problem, offered, generator.integers(len(offered), size=shape))
        rows = [generator.choice(len(offered), shape[1], replace=False) for _ in range(shape[0])]
        return cls(problem, offered, np.array(rows))

    def exchange(self, run: int) -> None:
        """Move one run of every running start to the best posture of the list."""
        parts = np.array_split(self.offered, -(-len(self.offered) // 20_000))  # what stays in cache
        for start in self.running.tolist():
            old = self.chosen[start, run]
            without = self.information[start] - information_of_each(self.offered[old]) / self.total
            scaled = (part[None] / np.sqrt(self.total) for part in parts)
            values = np.concatenate([values_after_adding(self.criterion, without[None], part)[0] for part in scaled])
            now = values[old]
            if self.problem.minimum_distance > 0.0:
                values[self.chosen[start]] = -np.inf
            best = int(np.argmax(values))
            if values[best] > now + IMPROVEMENT:
                self.chosen[start, run] = best
                self._put(np.array([start]), run, without[None], self.offered[best][None])


# -- with a climb ------------------------------------------------------------------------------------------------------
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

        weights = continuous_design(problem, runs=runs, proof=0.0, stop=budget.part(0.5).ended)  # of the time, at most
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
            # runs of all starts that climb between two exchanges, at most
            count = max(1, min(self._together(problem), left, 2_000 // runs))
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
    return all(abs(value - other) > 1e-7 for other in others)  # the same plan up to symmetry: polished once


def exchanged(
    problem: DesignProblem, pool: Array, shape: tuple[int, int], generator: np.random.Generator, budget: Budget
) -> Array:
    """(s, m, n) plans of the pool's postures that no exchange with the pool improves."""
    postures = np.unique(pool, axis=0)
    search = ListBatch.started(problem, problem.scaled_jacobians(postures), shape, generator)
    search.improve(generator, budget)
    return np.asarray(postures[search.chosen])
