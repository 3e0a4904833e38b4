"""`solve`, the only entry point to the exact solvers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import chain
from time import perf_counter

import numpy as np

from doe.bounds.best_known import best_known_bound, bound_that_holds
from doe.bounds.bound import Bound
from doe.bounds.planar_theorem import applies
from doe.design import Design
from doe.plan.ascent import climbs
from doe.plan.constrained_ascent import ascent
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.driver import SearchResult, design_of, feasible_value, run_search
from doe.solvers.fedorov import Fedorov
from doe.solvers.planar_theory import Analytic, nearly_analytic
from doe.solvers.random import Random
from doe.solvers.registry import SOLVERS, solver_named
from doe.solvers.solvability import check_solvable, judged_identifiable
from doe.solvers.solver import LONG_PLAN, Budget, Offer, Solver, time_limit
from identification.arrays import Array
from identification.errors import InputError
from identification.progress import Progress, silent
from identification.status import Status
from identification.threads import single_thread

HALF = 0.5  # of the time: for what comes first, the search or the bound


def solve(
    problem: DesignProblem,
    runs: int,
    solver: Solver | str | None = None,
    *,
    seed: int = 0,
    starts: int | None = None,
    seconds: float | None = None,
    bound: Bound | None = None,
    begin: Array | None = None,
    accepted: Callable[[Array], bool] = lambda _: True,
    progress: Progress = silent,
    throw: bool = True,
) -> Design:
    """The best plan of `runs` measurements that the solver finds, with its certificate.

    solver : settings object, or name; left out: a plan from theory if that attains the bound, else exchange + IPOPT
    seed : the same seed gives the same plan, unless the time limit binds
    starts, seconds : budget; left out: the solver's own number of starts, fewer when many of them agree; no time limit
        up to 100 runs, 30 s for more. The bound is part of it: whichever of search and bound comes first ends at half
    bound : upper bound of the criterion; left out: the best that is known, see `doe.bounds.best_known`
    begin : (m, n) a plan to begin with;  accepted : which plans may take its place
    throw : raise `JobError` where no plan identifies all parameters; False: return the last one, value -inf

    Ctrl-C returns the best plan so far, status `interrupted`. Raises `InputError` for too few runs, an unknown name.
    """
    began = perf_counter()
    chosen = chosen_solver(problem, solver)
    check_solvable(problem, runs, seed, begin, every_parameter=throw)
    with single_thread():
        whole = Budget.of(starts, chosen.starts_for(problem), time_limit(runs, starts, seconds), began)
        # such a bound takes seconds, which are no part of the search's time; that of a theorem takes none
        first, late = whole.part(HALF), bound is None and climbs(problem) and not applies(problem)
        known = None if late else bound or best_known_bound(problem, runs, first.ended)
        result = from_theory(problem, runs, known, seed, accepted, whole) if solver is None else None
        chosen = chosen if result is None else Analytic()
        if result is None:
            budget = first if late else whole
            offers = offers_of(problem, runs, chosen, budget, seed, theory_first=solver is None)
            offers = offers if begin is None else chain(climbing_from(problem, begin, budget), offers)
            result = run_search(problem, offers, budget, known, progress, accepted)
            result, chosen = spread_out(problem, runs, seed, result, chosen)
        known = best_known_bound(problem, runs, whole.ended) if late else known
        design = design_of(problem, result, chosen, known, began, seed)
        if bound is None:
            held = bound_that_holds(problem, known, design.plan.postures, design.value, whole.ended)
            design = replace(design, bound=held)
    return judged_identifiable(design, throw=throw)


def chosen_solver(problem: DesignProblem, solver: Solver | str | None) -> Solver:
    """The solver asked for, or the best for the problem. Raises `InputError` where it does not fit the problem."""
    if isinstance(solver, str):
        solver = solver_named(solver)
    if solver is None:
        return SOLVERS[
            "fedorov" if problem.choices is not None else "gradient" if climbs(problem) else "exchange_ipopt"
        ]
    if problem.choices is not None and not isinstance(solver, Fedorov):
        raise InputError(f"solver: {solver.name} cannot choose from a list of postures, allowed: fedorov")
    return solver


def from_theory(
    problem: DesignProblem,
    runs: int,
    known: Bound | None,
    seed: int,
    accepted: Callable[[Array], bool],
    whole: Budget,
) -> SearchResult | None:
    """A plan from theory that attains the bound and is accepted, None without one."""
    if known is None or problem.choices is not None:
        return None
    budget = replace(whole, starts=1, may_agree=False)
    offers = Analytic().offers(problem, runs, np.random.default_rng(seed), budget)
    result = run_search(problem, offers, budget, known, silent)
    reached = result.status is Status.bound_reached and result.postures is not None
    return result if reached and accepted(np.asarray(result.postures)) else None


def spread_out(
    problem: DesignProblem, runs: int, seed: int, result: SearchResult, solver: Solver
) -> tuple[SearchResult, Solver]:
    """What a search found, and its solver; a random plan where all that it found of very many runs came too near each
    other: good postures are few, and time ends before they are moved apart."""
    if runs <= LONG_PLAN or problem.choices is not None or result.postures is None or np.isfinite(result.value):
        return result, solver
    spread = random_postures(problem, runs, np.random.default_rng([seed, runs]))
    value = feasible_value(problem, spread)
    return (replace(result, postures=spread, value=value), Random()) if np.isfinite(value) else (result, solver)


def climbing_from(problem: DesignProblem, plan: Array, budget: Budget) -> Iterator[Offer]:
    """A plan as it is and, where postures may be chosen freely, climbed from there."""
    yield Offer(plan)
    if problem.choices is None and problem.searched_joints:
        yield Offer(ascent(problem)(plan[None], stop=budget.ended)[0])


def offers_of(
    problem: DesignProblem, runs: int, solver: Solver, budget: Budget, seed: int, *, theory_first: bool
) -> Iterator[Offer]:
    """The solver's plans; those of many runs after a plan that is nearly one of theory, where that is asked for."""
    generator = np.random.default_rng(seed)
    offers = solver.offers(problem, runs, generator, budget)
    if theory_first and runs > LONG_PLAN and problem.choices is None:
        return chain(nearly_analytic(problem, runs, generator, budget), offers)
    return offers
