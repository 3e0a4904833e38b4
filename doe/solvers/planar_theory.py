"""D-optimal plans from theory, where the joint limits and the number of runs allow any: no search.

One group of m elements (`doe.solvers.planar_characters`), or smaller groups, each with its own phases, that make up
m. With no limits the plan of a group of m is theta_j = 2 pi i f_j / m with distinct random frequencies f_j and random
phases: any columns of the DFT matrix (doe/README.md, "Information matrix"), in shuffled order, since the plan f_j = j
hides missing effects (identification/README.md, "Lessons"). With all ranges below pi it is the two-level factorial,
2^(joints) runs or a multiple.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import ClassVar

import numpy as np

from doe.bounds.planar_theorem import applies, chain_joints
from doe.plan.replicate_spacing import beside_earlier, free_values, replicates_allowed, too_near
from doe.problem.problem import DesignProblem
from doe.solvers.exchange import Exchange
from doe.solvers.planar_characters import CharacterPlan, character_plans, halves
from doe.solvers.solver import Budget, Offer
from identification.arrays import Array

WHOLE = 2048  # runs up to which one group is tried
SMALL = 48  # runs of the plans that are put together, or as many as the factorial of all joints has
PATTERNS = 16  # different plans of one size, and times that those too near others are placed anew
ATTEMPTS = 8  # plans of one group before smaller ones are put together
NEARLY = 64  # runs by which a plan may exceed one from theory to be begun from it


@dataclass(frozen=True)
class Analytic:
    """Random plans that attain the closed-form bound; none where the limits or the number of runs do not allow any."""

    tries: int = 60
    name: str = "analytic"
    without_plan: ClassVar[str] = (
        "solver: analytic has no plan for this criterion, these limits and this number of runs, allowed: leave "
        "--solver out"
    )

    def starts_for(self, problem: DesignProblem) -> int:
        """One: any such plan is optimal."""
        return 1

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One plan per start, as long as any is found."""
        if not applies(problem) or problem.constraints:
            return
        composed = GroupedPlans(problem, runs, self.tries, generator, budget.ended)
        while (plan := composed.plan()) is not None:
            yield Offer(generator.permutation(plan), 1)


def nearly_analytic(
    problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
) -> Iterator[Offer]:
    """A plan from theory of a few runs less, the others chosen by exchange, before and after; nothing without one."""
    exchange = Exchange()
    for fewer in range(runs - 1, max(runs - NEARLY, problem.fewest_runs) - 1, -1):
        known = next(Analytic(tries=12).offers(problem, fewer, generator, budget), None)
        if known is not None:
            plan = np.vstack([known.postures, exchange.begin(problem, 1, runs - fewer, generator)[0]])
            yield Offer(plan)
            yield Offer(exchange.improve(problem, plan[None], generator, budget)[0][0], 1)
            return
        if budget.out_of_time:
            return


class GroupedPlans:
    """Plans of groups found so far for one number of runs; `stop` ends the search for more sizes of groups."""

    def __init__(
        self, problem: DesignProblem, runs: int, tries: int, generator: np.random.Generator, stop: Callable[[], bool]
    ) -> None:
        self.problem, self.joints = problem, list(chain_joints(problem))
        self.lower, self.upper = problem.lower[self.joints], problem.upper[self.joints]
        self.runs, self.tries, self.generator, self.stop = runs, tries, generator, stop
        self.whole = runs <= WHOLE  # until proven otherwise
        self.patterns: dict[int, list[CharacterPlan]] | None = None
        no_free_joint = replicates_allowed(problem) == 1.0
        self.apart = problem.minimum_distance if no_free_joint else 0.0  # [rad]

    def plan(self) -> Array | None:
        """(m, n) a random plan, None where none is found; without repeats, as far as a few attempts find one."""
        for _ in range(ATTEMPTS if self.whole else 0):
            plan = self._of_one_group()
            if plan is None:
                self.whole = False
                break
            if not len(too_near(self.problem, plan)):
                return plan
        return self._of_many()

    def _of_one_group(self) -> Array | None:
        found = next(self._character_plans(self.runs), None)
        return None if found is None else self._full(found.placed(self.lower, self.upper, self.generator))

    def _of_many(self) -> Array | None:
        if self.patterns is None:
            self.patterns = self._small_groups()
        if not self.patterns:
            return None
        sizes = composed(list(self.patterns), self.runs, self.generator)
        edges = np.cumsum([0, *sizes])
        angles = np.concatenate([self._drawn(size) for size in sizes])
        for _ in range(PATTERNS if self.apart > 0.0 else 0):
            crowded = np.unique(np.searchsorted(edges, beside_earlier(angles, self.apart), side="right")) - 1
            if not len(crowded):
                break
            for group in crowded.tolist():
                angles[edges[group] : edges[group + 1]] = self._drawn(sizes[group])
        return self._full(angles)

    def _drawn(self, size: int) -> Array:
        """(b, J) a random one of the patterns at random phases."""
        patterns = (self.patterns or {})[size]
        return patterns[self.generator.integers(len(patterns))].placed(self.lower, self.upper, self.generator)

    def _full(self, angles: Array) -> Array:
        """(m, n) postures whose other joints stay in the middle."""
        plan = np.tile(free_values(self.problem), (len(angles), 1))
        plan[:, self.joints] = angles
        return plan

    def _character_plans(self, size: int) -> Iterator[CharacterPlan]:
        return character_plans(self.upper - self.lower, size, self.tries, self.generator)

    def _small_groups(self) -> dict[int, list[CharacterPlan]]:
        """Size -> plans of groups, the smallest sizes that make up the number of runs; empty where none do."""
        found: dict[int, list[CharacterPlan]] = {}
        if halves(self.upper - self.lower) and self.runs % 2:
            return found
        for size in range(len(self.lower) + 1, min(self.runs // 2, max(SMALL, 2 ** len(self.lower))) + 1):
            if found and size % np.gcd.reduce(list(found)) == 0:
                continue  # nothing that the smaller sizes cannot make, but for the smallest multiples
            if self.stop():
                break
            some = list(islice(self._character_plans(size), PATTERNS))
            if some:
                found[size] = some
            if found and reachable_sums(list(found), self.runs)[self.runs]:
                return found
        return {}


def reachable_sums(sizes: list[int], runs: int) -> list[bool]:
    """(runs + 1) True for numbers that are sums of these sizes."""
    made = [True] + [False] * runs
    for total in range(1, runs + 1):
        made[total] = any(size <= total and made[total - size] for size in sizes)
    return made


def composed(sizes: list[int], runs: int, generator: np.random.Generator) -> list[int]:
    """Random sizes that add up to the number of runs, which they can make."""
    made, chosen, left = reachable_sums(sizes, runs), [], runs
    while left:
        fitting = [size for size in sizes if size <= left and made[left - size]]
        chosen.append(fitting[generator.integers(len(fitting))])
        left -= chosen[-1]
    return chosen
