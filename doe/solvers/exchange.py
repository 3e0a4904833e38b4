"""Exchange, for many starts at once: each run in turn is taken out of the plan and replaced by the best posture.

`Exchange` offers all postures that differ from the run's in one joint, on a coarse grid per joint: coordinate exchange
(R. K. Meyer, C. J. Nachtsheim, Technometrics 37, 1995), here with the best single-joint change over all joints.
`Fedorov` offers a whole list (R. D. Cook, C. J. Nachtsheim, Technometrics 22 (1980), after V. V. Fedorov, "Theory of
Optimal Experiments", 1972). One sweep visits every run in random order; a start ends when a sweep changes nothing. The
starts of a batch advance together, so that numpy works on arrays of starts x candidates.

Exchange finds the pattern, a climb the last digits: with one (IPOPT, L-BFGS) the two are put together. Near a good plan
there are better ones more often than at random, so each then also starts from the best plans so far, or from the
optimal weights, with some runs drawn again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from doe.criteria import information_matrix
from doe.plan.ascent import PlanAscent
from doe.plan.plan import apportion
from doe.plan.spacing import distance_to_keep
from doe.problem.postures import fill, listed_candidates, random_postures
from doe.problem.problem import MANY, DesignProblem, information_of_each
from doe.solvers.ipopt import Climber, Ipopt, variables
from doe.solvers.solver import Budget, Offer
from identification import Array, InputError

IMPROVEMENT = 1e-9  # smaller gains of a single exchange are rounding


@dataclass(frozen=True)
class Exchange:
    """Coordinate exchange from random grid postures; with `climb` the best plans of each batch are polished by IPOPT,
    and every second batch varies the best.

    levels : grid values per joint, its limits included;  batch : starts that advance together
    rounded : begin with the rounded optimum of the relaxation, and vary that
    polished : plans per batch;  elite : how many of the best plans are varied;  redrawn : fraction of their runs
    """

    levels: int = 9
    batch: int = 50
    climb: Ipopt | None = None
    rounded: bool = False
    polished: int = 5
    elite: int = 10
    redrawn: float = 0.25
    name: str = "exchange"

    def starts_for(self, problem: DesignProblem) -> int:
        """Thirty per pair of joints, as local optima grow with them; fewer for many parameters, as each costs p^3."""
        wanted = max(2 * self.batch, 30 * len(problem.searched_joints) ** 2)
        return 20 if self.rounded else max(10, round(wanted * min(1.0, (MANY / problem.parameters) ** 2)))

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """The plans of each batch, best first; the polished ones of each where there is a climb."""
        climb, best, left, vary = None, list[tuple[float, Array]](), budget.starts, False
        seen = list[float]()
        # of more variables IPOPT takes longer to improve what exchange found than it takes to search on
        if self.climb and variables(problem, runs) <= 1500:
            climb = Climber(problem, runs, self.climb, budget)
        if self.rounded:
            from doe.bounds.column_generation import continuous_design  # deferred: it needs scipy.linalg

            weights = continuous_design(problem, runs=runs, proof=0.0, stop=budget.part(0.5).ended)
            carried = weights.plan.shares > 0.0
            numbers = apportion(weights.plan.shares[carried] / weights.plan.shares[carried].sum(), runs)
            first = np.repeat(weights.plan.postures[carried], numbers, axis=0)
            yield Offer(first)
            best, vary = [(problem.objective(first), first)], True
        while True:
            started = self.begin(problem, left, runs, generator)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            if vary:
                elite = np.array([plan for _, plan in best])
                chosen = elite[generator.integers(len(best), size=len(started))]
                kept = generator.random(started.shape[:2]) > self.redrawn
                started = np.where(kept[..., None], chosen, started)
                started[:1] = best[0][1] if self.rounded else started[:1]
            plans, values = self.improve(problem, started, generator, budget)
            if climb is None:
                yield from (Offer(plan, 1, independent=not vary) for plan in plans)
            else:
                yield Offer(plans[0], 1)
                rows: list[int] = []
                for k, value in enumerate(values.tolist()):
                    if len(rows) < self.polished and np.isfinite(value) and _unlike(value, seen):
                        seen.append(value)
                        rows.append(k)
                for plan in plans[rows]:
                    climbed = climb(plan)
                    if np.isfinite(value := problem.objective(climbed)) and _unlike(value, [one for one, _ in best]):
                        best = sorted([*best, (value, climbed)], key=lambda pair: -pair[0])[: self.elite]
                    yield Offer(climbed, independent=not vary)
                    climb.pass_on_interrupt()
                yield Offer(plans[0], len(started) - 1)
                vary = self.rounded or (not vary and bool(best))
            left -= len(started)

    def begin(self, problem: DesignProblem, left: int, runs: int, generator: Generator) -> Array:
        """(s, m, n) random plans on the grid: a batch, or as many starts as are left; joints that play no part stay in
        the middle."""
        # runs of all starts, at most: keeps memory and time of a batch small
        count, grid = max(1, min(self.batch, left, 20_000 // runs)), self.grid(problem)

        def on_grid(size: int) -> Array:
            postures = np.tile((problem.lower + problem.upper) / 2.0, (size, 1))
            for joint in problem.searched_joints:
                postures[:, joint] = grid[joint, generator.integers(grid.shape[1], size=size)]
            return postures

        return fill(problem, count * runs, on_grid, generator).reshape(count, runs, problem.joints)

    def improve(
        self, problem: DesignProblem, plans: Array, generator: Generator, budget: Budget
    ) -> tuple[Array, Array]:
        """Plans (s, m, n) that no single exchange improves, and their values (s,), best first."""
        nothing = np.empty((0, problem.joints)), np.zeros(plans.shape[:2], dtype=np.intp)
        return Batch(problem, plans, self.grid(problem), *nothing).improved(generator, budget)

    def grid(self, problem: DesignProblem) -> Array:
        """(n, L) values of every joint, limits included."""
        return np.linspace(problem.lower, problem.upper, self.levels, axis=1)


def _unlike(value: float, others: list[float]) -> bool:
    return all(abs(value - other) > 1e-7 for other in others)  # else the same plan up to symmetry, polished once


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
        return max(2, round(self.batch * min(1.0, (100 / problem.parameters) ** 2)))

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """One offer per start. Raises `InputError` without choices, or with fewer of them than runs."""
        if problem.choices is None:
            raise InputError("solver: fedorov needs a list of postures, found none, allowed: with --candidates")
        postures = listed_candidates(problem, problem.choices)
        if problem.minimum_distance > 0.0:
            postures = np.unique(postures, axis=0)
            if len(postures) < runs:
                allowed = f"up to {len(postures)}, the different postures to choose from"
                raise InputError(f"runs: found {runs}, allowed: {allowed}")
        count = 1 if problem.deviations else self.batch
        while True:
            yield from (
                Offer(p, 1, independent=True) for p in exchanged(problem, postures, (count, runs), generator, budget)
            )


def exchanged(
    problem: DesignProblem, postures: Array, shape: tuple[int, int], generator: Generator, budget: Budget
) -> Array:
    """(s, m, n) plans of listed postures (N, n), all different, that no exchange with the list improves, best first;
    from random ones."""
    if problem.minimum_distance == 0.0:
        chosen = generator.integers(len(postures), size=shape)
    else:
        chosen = np.array([generator.choice(len(postures), shape[1], replace=False) for _ in range(shape[0])])
    return Batch(problem, postures[chosen], np.empty((0, 0)), postures, chosen).improved(generator, budget)[0]


class Batch:
    """Starts (s, m, n) that advance together; runs are exchanged for postures on a grid (n, L) that differ in one
    joint, or for any of a list (N, n), of which `chosen` (s, m) are the rows.

    jacobians : (s, m, d, p), scaled so that M is the sum of B^T B and the prior's share;  information : (s, p, p)
    values : (s,) criterion, or its surrogate;  running : starts that still improve
    """

    def __init__(
        self, problem: DesignProblem, plans: Array, grid: Array, listed: Array, chosen: NDArray[np.intp]
    ) -> None:
        self.problem, self.plans, self.grid, self.listed, self.chosen = problem, plans, grid, listed, chosen
        self.criterion, self.running = problem.criterion.surrogate, np.arange(len(plans))
        self.total = plans.shape[1] + problem.prior.runs
        self.distance = distance_to_keep(problem, plans.shape[1])
        self.offered = self._jacobians(listed)
        self.jacobians = self.offered[chosen] if len(listed) else self._jacobians(plans)
        self.information, self.values = self._information(self.running)
        if not len(listed) and not problem.searched_joints:
            self.running = self.running[:0]

    def _jacobians(self, postures: Array) -> Array:
        return self.problem.scaled_jacobians(postures) / np.sqrt(self.total)

    def _information(self, starts: NDArray[np.intp]) -> tuple[Array, Array]:
        """(s, p, p) information matrices, and (s,) their values."""
        information = information_matrix(self.jacobians[starts]) + self.problem.prior.total / self.total
        return information, np.array(self.criterion.value(information))

    def improved(self, generator: Generator, budget: Budget) -> tuple[Array, Array]:
        """The plans after sweeps until none changes anything, or time is up, and values (s,) of them, best first."""
        for _ in range(60):
            if not self.running.size or budget.out_of_time:
                break
            before = self.values[self.running]
            for run in generator.permutation(self.plans.shape[1]).tolist():
                if budget.ended():
                    break
                for starts in self.running[:, None] if len(self.listed) else self.running[None]:
                    self._exchange(starts, run)
            information, values = self._information(self.running)  # computed afresh: no rounding piles up
            self.information[self.running], self.values[self.running] = information, values
            self.running = self.running[~(values <= before + IMPROVEMENT) | np.isneginf(before)]
        values = np.asarray(self.problem.criterion.value(self.information))
        order = np.argsort(-values, kind="stable")
        return self.plans[order], values[order]

    def _exchange(self, starts: NDArray[np.intp], run: int) -> None:
        """Move one run of some starts to the best posture on offer."""
        old = self.jacobians[starts, run]
        without = self.information[starts] - information_of_each(old)
        if len(self.listed):
            postures, jacobians, now = self.listed[None], self.offered[None], self.chosen[starts, run]
            allowed = np.ones((1, len(self.listed)), dtype=bool)
            if self.problem.minimum_distance > 0.0:
                allowed[0, self.chosen[starts[0]]] = False
        else:  # the posture itself comes last
            postures = self._neighbors(self.plans[starts, run])
            allowed, now = self._allowed(starts, postures, run), np.full(len(starts), postures.shape[1])
            jacobians = np.concatenate([self._jacobians(postures), old[:, None]], axis=1)
        values = self.criterion.values_after_adding(without, jacobians)
        now = values[np.arange(len(starts)), now]
        values = np.where(allowed, values[:, : allowed.shape[1]], -np.inf)
        rows = np.flatnonzero(values.max(axis=1) > now + IMPROVEMENT)
        best, at = np.argmax(values[rows], axis=1), starts[rows]
        self.chosen[at, run], self.plans[at, run] = best, postures[rows, best]
        self.jacobians[at, run] = jacobians[rows, best]
        self.information[at] = without[rows] + information_of_each(jacobians[rows, best])

    def _neighbors(self, postures: Array) -> Array:
        """(s, c, n) postures that differ from those given (s, n) in one joint, on the grid."""
        levels, joints = self.grid.shape[1], self.problem.searched_joints
        moved = np.repeat(postures[:, None], len(joints) * levels, axis=1)
        for k, joint in enumerate(joints):
            moved[:, k * levels : (k + 1) * levels, joint] = self.grid[joint]
        return moved

    def _allowed(self, starts: NDArray[np.intp], postures: Array, run: int) -> NDArray[np.bool_]:
        """(s, c) True where a posture satisfies the constraints and repeats no other run of its plan."""
        allowed = self.problem.feasible(postures)
        if self.distance > 0.0:
            others = np.delete(self.plans[starts], run, axis=1)
            kept = np.broadcast_to(self.problem.kept, (len(others), *self.problem.kept.shape))
            others = self.problem.comparable(np.concatenate([others, kept], axis=1))
            offered = self.problem.comparable(postures)
            for other in np.moveaxis(others, 1, 0):
                allowed &= np.abs(offered - other[:, None]).max(axis=-1) >= self.distance
        return allowed


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
        return min(self.count, 2 * max(1, self.batch // 2)) if problem.constraints else self.count

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """One offer per start."""
        climb, left, best = PlanAscent(problem), budget.starts, list[Array]()
        together = max(1, self.batch // 2) if problem.constraints else self.batch
        while True:
            # runs of all starts that climb between two exchanges, at most
            count, first = max(1, min(together, left, 2_000 // runs)), not best
            left -= count
            started = random_postures(problem, count * runs, generator).reshape(count, runs, -1)
            yield Offer(started[0])  # something to return if the user stops during the first batch
            if not first or problem.constraints:  # penalties climb slowly from poor plans
                pool = np.unique(np.concatenate([*best, *(started if first else started[:1])]), axis=0)
                started = exchanged(problem, pool, (count, runs), generator, budget)
            for plan in started:
                climbed = climb(plan, stop=budget.ended)
                yield Offer(climbed, 1, independent=first)
                best.append(climbed)
            best = sorted(best, key=lambda plan: -problem.objective(plan))[: max(2, self.pool // runs)]
