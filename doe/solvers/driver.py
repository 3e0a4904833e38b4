"""The search loop that all solvers share: it takes plans from them and no numbers.

The solver offers plans; the driver clips them to the joint limits, recomputes the criterion from the stored problem,
keeps the best, and ends when the bound is reached, the budget is used up or the user presses Ctrl-C.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from doe.bounds.bound import Bound
from doe.bounds.equivalence import REACHED
from doe.design import Design
from doe.plan.plan import Plan
from doe.plan.replicate_spacing import separated, spread_free_joints, too_near
from doe.problem.problem import DesignProblem
from doe.solvers.solver import Budget, Offer, Solver
from identification.arrays import Array
from identification.errors import JobError
from identification.progress import Progress
from identification.status import Status

AGREEMENT = 10  # independent local searches that end at the best value
AGREES = 1e-7  # difference of criterion values that counts as none


@dataclass(frozen=True)
class SearchResult:
    """Result of a search: the best plan (m, n), its value, how the search ended, starts used."""

    postures: Array | None
    value: float
    status: Status
    starts: int


def run_search(
    problem: DesignProblem,
    offers: Iterator[Offer],
    budget: Budget,
    bound: Bound | None,
    progress: Progress,
    accepted: Callable[[Array], bool] = lambda _: True,
) -> SearchResult:
    """Takes offers until there is a reason to stop; after the first only those that are `accepted`."""
    best, value, starts, agreeing, status = None, -np.inf, 0, 0, None
    try:
        for offer in offers:
            postures = separated(problem, problem.clip(offer.postures))
            offered = feasible_value(problem, postures)
            starts += offer.starts
            if best is None or (offered > value and accepted(postures)):
                agreeing = 0 if offered > value + AGREES else agreeing
                best, value = postures, offered
            agreeing += offer.independent and abs(offered - value) <= AGREES
            progress(budget.used(starts), budget.starts, f"best {value:.7g}")
            status = reason_to_stop(problem, value, bound, starts, agreeing, budget)
            if status is not None:
                break
    except KeyboardInterrupt:
        status = Status.interrupted
    if best is None and status is not Status.interrupted:
        status = Status.solver_failed
    return SearchResult(best, value, status or Status.starts_finished, starts)


def feasible_value(problem: DesignProblem, postures: Array) -> float:
    """Criterion value of a plan; -inf if a posture violates a constraint or is a repeat that is not allowed."""
    return problem.objective(postures) if allowed(problem, postures) else -np.inf


def allowed(problem: DesignProblem, postures: Array) -> bool:
    """True if no posture of a plan violates a constraint or is a repeat that is not allowed."""
    return bool(problem.feasible(postures).all()) and not len(too_near(problem, postures))


def reason_to_stop(
    problem: DesignProblem, value: float, bound: Bound | None, starts: int, agreeing: int, budget: Budget
) -> Status | None:
    """The status with which the search ends, or None if it goes on."""
    if bound is not None and problem.criterion.efficiency(value, bound.value, problem.parameters) >= REACHED:
        return Status.bound_reached
    if starts >= budget.starts:
        return Status.starts_finished
    if budget.may_agree and agreeing >= AGREEMENT:
        return Status.agreed
    return Status.time_limit if budget.out_of_time else None


def design_of(
    problem: DesignProblem, result: SearchResult, solver: Solver, bound: Bound | None, began: float, seed: int
) -> Design:
    """The search's result as a design with a bound; joints that play no part are spread over their limits.

    Raises `JobError` where the solver offered no plan at all.
    """
    if result.postures is None:
        if result.status is Status.interrupted:
            raise KeyboardInterrupt
        none = f"design: no plan that identifies all {problem.parameters} parameters was found by {solver.name}"
        raise JobError(getattr(solver, "without_plan", none))
    generator = np.random.default_rng([seed, len(result.postures)])
    postures = result.postures
    if np.isfinite(result.value):  # else the plan is refused, and no room for it may be left
        postures = spread_free_joints(problem, postures, generator)
    plan = Plan(problem.clip(postures), joint_types=problem.model.joint_types, fit=problem.fit)
    return Design(problem, plan, bound, result.status, solver.name, result.starts, perf_counter() - began)
