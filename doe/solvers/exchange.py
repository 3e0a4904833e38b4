"""Exchange, for many starts at once: each run in turn is taken out of the plan and replaced by the best posture.

Offered are all postures that differ from the run's in one joint, on a coarse grid per joint: coordinate exchange (R. K.
Meyer, C. J. Nachtsheim, Technometrics 37, 1995), here with the best single-joint change over all joints. Or a whole
list (R. D. Cook, C. J. Nachtsheim, Technometrics 22 (1980), after V. V. Fedorov, "Theory of Optimal Experiments",
1972). One sweep visits every run in random order; a start ends when a sweep changes nothing. The starts of a batch
advance together, so that numpy works on arrays of starts x candidates.

Exchange finds the pattern, a climb on gradients the last digits. Of many parameters under constraints the postures of
climbed plans are among those that the next are begun from.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from doe.criteria import Ranking, information_matrix
from doe.plan.ascent import PlanAscent
from doe.problem.problem import DesignProblem, information_of_each, listed_candidates, random_postures
from doe.solvers.solver import Budget, Offer
from identification import Array, require

IMPROVEMENT = 1e-9  # smaller gains of a single exchange are rounding


@dataclass(frozen=True)
class Exchange:
    """Exchange from random plans. The best five of each batch are climbed, those of a list are not.

    levels : grid values per joint, its limits included;  batch : starts that advance together, five of many parameters
    climb : False: the plans that exchange ends at, to compare with
    """

    levels: int = 9
    batch: int = 50
    climb: bool = True
    name: str = "exchange"

    def starts_for(self, problem: DesignProblem) -> int:
        """Thirty per pair of joints, as local optima grow with them; of many parameters, and out of a list, each start
        is thorough, and fewer will do the more each costs."""
        if problem.choices is not None:
            return max(2, round(10 * min(1.0, (100 / problem.parameters) ** 2))) if problem.deviations else 30
        if problem.many_parameters:
            return 10 if problem.constraints else 15
        return max(2 * self.batch, 30 * len(problem.searched_joints) ** 2)

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """The plans of each batch, best first, and the climbed ones. Raises `InputError` for a list of fewer postures
        than runs."""
        choices, many, left = problem.choices, problem.many_parameters, budget.starts
        climb = PlanAscent(problem) if self.climb and choices is None else None
        # where few starts lead to the best plan, its last digits tell whether others agree
        accuracy = None if many or problem.constraints else 1e-11
        repeats = problem.minimum_distance == 0.0
        seen, climbed = list[float](), list[Array]()
        if choices is not None:
            postures = listed_candidates(problem, choices)
            postures = postures if repeats else np.unique(postures, axis=0)
            allowed = f"up to {len(postures)}, the different postures to choose from"
            require(repeats or len(postures) >= runs, f"runs: found {runs}, allowed: {allowed}")
        # one by one where there is a prior over many effects: a start takes seconds, and a time limit is to find some;
        # runs of all starts, at most: keeps memory and time of a batch small
        most = 5 if many else self.batch
        if choices is not None:
            most = 1 if problem.deviations else 10
        while True:
            count = max(1, min(most, left, 20_000 // runs))
            left -= count
            # constraints take long to look at: postures of a pool, and of plans so far, are known to be allowed
            if choices is not None or problem.constraints:
                if choices is None:
                    fresh = random_postures(problem, count * runs, generator)
                    postures = np.unique(np.concatenate([fresh, *climbed[-10:]]), axis=0)
                again = repeats or len(postures) < runs  # where hardly any posture is allowed
                chosen = np.array([generator.choice(len(postures), runs, replace=again) for _ in range(count)])
                batch = Batch(problem, postures[chosen], postures, chosen)
            else:  # on the grid, where many optimal plans are, so that a start ends exactly at one
                grid, plans = self.grid(problem), np.tile((problem.lower + problem.upper) / 2.0, (count, runs, 1))
                for joint in problem.searched_joints:  # those that play no part stay in the middle
                    plans[..., joint] = grid[joint, generator.integers(self.levels, size=(count, runs))]
                batch = Batch(problem, plans, grid)
            yield Offer(batch.plans[0])  # something to return if the user stops during the first batch
            plans, values = batch.improved(generator, budget)
            if climb is None:
                yield from (Offer(plan, 1, independent=True) for plan in plans)
                continue
            yield Offer(plans[0], 1)
            before = len(seen)
            for plan, value in zip(plans, values.tolist(), strict=True):
                # of those with one value, which are one plan up to symmetry, the first; so many of a batch
                if np.isfinite(value) and all(abs(value - other) > 1e-7 for other in seen) and len(seen) < before + 5:
                    seen.append(value)
                    climbed.append(climb(plan, accuracy, budget.ended))
                    yield Offer(climbed[-1], independent=True)
            yield Offer(plans[0], count - 1)

    def grid(self, problem: DesignProblem) -> Array:
        """(n, L) values of every joint, limits included."""
        return np.linspace(problem.lower, problem.upper, self.levels, axis=1)


class Batch:
    """Starts (s, m, n) that advance together; runs are exchanged for any posture of a list (N, n), of which `chosen`
    (s, m) are the rows, or for those that differ in one joint on a grid (n, L).

    jacobians : (s, m, d, p), scaled so that M is the sum of B^T B and the prior's share;  information : (s, p, p), of
        a list as it was before a sweep
    running : starts that still improve
    """

    def __init__(
        self, problem: DesignProblem, plans: Array, offered: Array, chosen: NDArray[np.intp] | None = None
    ) -> None:
        self.problem, self.plans, self.offered, self.chosen = problem, plans, offered, chosen
        self.criterion, self.total = problem.criterion.smooth, plans.shape[1] + problem.prior.runs
        self.running = np.arange(len(plans) if len(problem.searched_joints) else 0)
        self.listed = self._jacobians(offered) if chosen is not None else np.empty(0)
        self.jacobians = self.listed[chosen] if chosen is not None else self._jacobians(plans)
        self.information = self._information(np.arange(len(plans)))

    def _jacobians(self, postures: Array) -> Array:
        return self.problem.scaled_jacobians(postures) / np.sqrt(self.total)

    def _information(self, starts: NDArray[np.intp]) -> Array:
        return information_matrix(self.jacobians[starts]) + self.problem.prior.total / self.total

    def improved(self, generator: Generator, budget: Budget) -> tuple[Array, Array]:
        """The plans after sweeps until none changes anything, or time is up, and values (s,) of them, best first."""
        for _ in range(60):
            if not self.running.size or budget.ended():
                break
            before = self.criterion.value(self.information[self.running])
            if self.chosen is not None:
                rankings = [self.criterion.ranking(self.information[start], self.listed) for start in self.running]
            for run in generator.permutation(self.plans.shape[1]).tolist():
                if budget.ended():
                    break
                if self.chosen is None:
                    self._exchange(self.running, run)
                else:
                    for start, ranking in zip(self.running.tolist(), rankings, strict=True):
                        self._choose(self.chosen[start], start, run, ranking)
            self.information[self.running] = self._information(self.running)  # afresh: no rounding piles up
            after = self.criterion.value(self.information[self.running])
            self.running = self.running[~(after <= before + IMPROVEMENT) | np.isneginf(before)]
        values = np.asarray(self.problem.criterion.value(self.information))
        order = np.argsort(-values, kind="stable")
        return self.plans[order], values[order]

    def _choose(self, chosen: NDArray[np.intp], start: int, run: int, ranking: Ranking) -> None:
        """Move one run of a start to the best posture of the list."""
        old = self.jacobians[start, run]
        values = ranking.instead_of(old)
        least = values[chosen[run]] + IMPROVEMENT
        if self.problem.minimum_distance > 0.0:
            values[chosen] = -np.inf
        best = int(np.argmax(values))
        if values[best] > least:
            ranking.exchange(old, self.listed[best])
            chosen[run], self.plans[start, run] = best, self.offered[best]
            self.jacobians[start, run] = self.listed[best]

    def _exchange(self, starts: NDArray[np.intp], run: int) -> None:
        """Move one run of some starts to the best posture that differs in one joint."""
        old, levels, joints = self.jacobians[starts, run], self.offered.shape[1], self.problem.searched_joints
        without = self.information[starts] - information_of_each(old)
        postures = np.repeat(self.plans[starts, run][:, None], len(joints) * levels, axis=1)  # (s, c, n)
        for k, joint in enumerate(joints):
            postures[:, k * levels : (k + 1) * levels, joint] = self.offered[joint]
        jacobians = np.concatenate([self._jacobians(postures), old[:, None]], axis=1)  # the posture itself comes last
        values = self.criterion.values_after_adding(without, jacobians)
        values, least = values[:, :-1], values[:, -1] + IMPROVEMENT
        rows = np.flatnonzero(values.max(axis=1) > least)
        best, at = np.argmax(values[rows], axis=1), starts[rows]
        self.plans[at, run], self.jacobians[at, run] = postures[rows, best], jacobians[rows, best]
        self.information[at] = without[rows] + information_of_each(self.jacobians[at, run])
