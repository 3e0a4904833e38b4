"""Exact solvers: one method per file, and `solve`, the only door to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from itertools import chain
from time import perf_counter
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.bound import Bound
from doe.bounds.planar_theorem import closed_form_bound
from doe.design import Design, given_plan, score
from doe.plan.plan import Plan
from doe.problem.candidates import listed
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.driver import Search, check_runs, feasible_value, finish, run_search
from doe.solvers.exchange import Exchange
from doe.solvers.exchange_ipopt import ExchangeIpopt
from doe.solvers.fedorov import Fedorov
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic, NearlyAnalytic
from doe.solvers.random import Random
from doe.solvers.relaxation_rounding import RelaxRound
from doe.solvers.solver import Budget, Offer, Solver
from identification.errors import InputError, JobError, nearest
from identification.information import identifiability
from identification.progress import Progress, silent
from identification.status import Status
from identification.threads import single_thread

__all__ = [
    "SOLVERS",
    "Analytic",
    "Exchange",
    "ExchangeIpopt",
    "Fedorov",
    "Ipopt",
    "Offer",
    "Random",
    "RelaxRound",
    "Solver",
    "library",
    "named",
    "score_plan",
    "solve",
]

SOLVERS: dict[str, Solver] = {
    "analytic": Analytic(),
    "exchange": Exchange(),
    "exchange_ipopt": ExchangeIpopt(),
    "fedorov": Fedorov(),
    "ipopt": Ipopt(),
    "random": Random(),
    "relaxation_rounding": RelaxRound(),
    "best_of_random": Random(count=1000, name="best_of_random"),
}


BEATEN = 1e-8  # relative excess over a bound that is not rounding
NEUTRAL = "under one payload, temperature, time and approach no posture tells apart"
MANY, PATIENCE = 100, 30.0  # runs above which a search has a time budget of its own [s]


def library() -> Mapping[str, Solver]:
    """Name -> solver of every one known: ours, and those of installed packages (entry-point group `armcal.solvers`).

    An entry point names a settings object, or a class that makes one without arguments. Raises `InputError` for one
    that cannot be loaded.
    """
    return MappingProxyType({**_installed(), **SOLVERS})


@cache
def _installed() -> dict[str, Solver]:
    from importlib.metadata import entry_points

    found: dict[str, Solver] = {}
    for point in entry_points(group="armcal.solvers"):
        where = f"entry point armcal.solvers: {point.name} = {point.value}"
        try:
            made = point.load()
            solver = made() if isinstance(made, type) else made
        except (ImportError, AttributeError, TypeError) as error:
            raise InputError(f"{where}: {error}") from None
        if not callable(getattr(solver, "offers", None)):
            raise InputError(f"{where}, allowed: a solver with offers()")
        found[point.name] = solver
    return found


def named(name: str) -> Solver:
    """The solver of a name as in `--solver`. Raises `InputError` with the nearest name for an unknown one."""
    if name not in library():
        raise InputError(f"solver: unknown name {name!r}, {nearest(name, library())}")
    return library()[name]


def solve(
    problem: DesignProblem,
    runs: int,
    solver: Solver | str | None = None,
    *,
    seed: int = 0,
    starts: int | None = None,
    seconds: float | None = None,
    bound: Bound | None = None,
    progress: Progress = silent,
    throw: bool = True,
) -> Design:
    """The best plan of `runs` measurements that the solver finds, with its certificate.

    solver : settings object, or name; left out: a plan from theory if that attains the bound, else exchange + IPOPT
    seed : the same seed gives the same plan, unless the time limit binds
    starts, seconds : budget; left out: the solver's own number of starts, fewer when many of them agree; no time limit
        up to 100 runs, 30 s for more
    bound : upper bound of the criterion; left out: the best that is known, see `known_bound`
    throw : raise `JobError` where no plan identifies all parameters; False: return the last one, value -inf

    Ctrl-C returns the best plan so far, status `interrupted`. Raises `InputError` for too few runs, an unknown name.
    """
    began = perf_counter()
    chosen = chosen_solver(problem, solver)
    check_runs(problem, runs)
    if throw:
        check_columns(problem)
    random_postures(problem, 1, np.random.default_rng(seed))  # says so where the constraints exclude everything
    with single_thread():
        known = bound or known_bound(problem, runs)
        if solver is None and known is not None and problem.choices is None:
            theory = _search(problem, runs, Analytic(), seed, 1, None, known, silent)
            if theory.status is Status.bound_reached:
                return _told(finish(problem, theory, Analytic(), known, began, seed, throw=False), throw)
        if runs > MANY and starts is None and seconds is None:
            seconds = PATIENCE
        deadline = None if seconds is None else began + seconds
        search = _search(problem, runs, chosen, seed, starts, deadline, known, progress, begin=solver is None)
        design = finish(problem, search, chosen, known, began, seed, throw=False)
        return _told(design if bound is not None else with_true_bound(design), throw)


def check_columns(problem: DesignProblem) -> None:
    """Raises `JobError` where a parameter moves the tip at no posture: no search can help."""
    lost = problem.without_effect
    if lost:
        raise JobError(f"design: no plan identifies all {problem.parameters} parameters; {NEUTRAL}: {'; '.join(lost)}")


def with_true_bound(design: Design) -> Design:
    """The design itself, unless it is better than its bound: then one that its own postures helped to find, or none.

    A numerical bound rests on the largest sensitivity that a search found. A better design proves that the search
    missed a posture, and one of the design's own has a greater sensitivity (the criterion is concave).
    """
    bound = design.bound
    if bound is None or design.value <= bound.value + BEATEN * max(1.0, abs(bound.value)):
        return design
    from doe.bounds.column_generation import continuous_bound

    try:
        again = continuous_bound(design.problem, runs=len(design.plan), also=design.plan.postures)
    except JobError:
        return replace(design, bound=None)
    return replace(design, bound=again if again.value >= design.value - BEATEN * max(1.0, abs(again.value)) else None)


def chosen_solver(problem: DesignProblem, solver: Solver | str | None) -> Solver:
    """The solver asked for, or the best for the problem. Raises `InputError` where it does not fit the problem."""
    if isinstance(solver, str):
        solver = named(solver)
    if solver is None:
        return SOLVERS["exchange_ipopt" if problem.choices is None else "fedorov"]
    if problem.choices is not None and not isinstance(solver, Fedorov):
        raise InputError(f"solver: {solver.name} cannot choose from a list of postures, allowed: fedorov")
    return solver


def _told(design: Design, throw: bool) -> Design:
    """The design, if it is allowed and tells all parameters; else a `JobError` that says what no plan could do."""
    problem = design.problem
    tells_all = bool(np.isfinite(design.value))
    if tells_all and np.isfinite(feasible_value(problem, design.plan.postures)):
        return design
    if not throw:
        return design if tells_all else replace(design, status=Status.not_identifiable)
    if tells_all:
        apart = f"postures {problem.spacing} apart"
        raise JobError(f"design: no plan within the constraints and with {apart} was found by {design.solver}")
    p = problem.parameters
    message = f"design: no plan that identifies all {p} parameters was found by {design.solver}"
    if problem.choices is not None:
        many = listed(problem, problem.choices).postures
        if identifiability(problem.scaled_jacobians(many), problem.model.parameters.names, np.ones(p)).combinations:
            message = f"design: the {len(many)} candidates cannot identify all {p} parameters, whatever the plan"
        raise JobError(message)
    many = np.random.default_rng(0).uniform(problem.lower, problem.upper, (4 * p, problem.joints))
    lost = identifiability(problem.scaled_jacobians(many), problem.model.parameters.names, np.ones(p)).combinations
    if lost:
        message += f"; {NEUTRAL}: {'; '.join(lost)}"
    raise JobError(message)


def _search(
    problem: DesignProblem,
    runs: int,
    solver: Solver,
    seed: int,
    starts: int | None,
    deadline: float | None,
    bound: Bound | None,
    progress: Progress,
    *,
    begin: bool = False,
) -> Search:
    budget = Budget(starts or solver.starts_for(problem), deadline, may_agree=starts is None)
    generator = np.random.default_rng(seed)
    offers = solver.offers(problem, runs, generator, budget)
    if begin and runs > MANY and problem.choices is None:
        offers = chain(NearlyAnalytic().offers(problem, runs, generator, budget), offers)
    return run_search(problem, offers, budget, bound, progress)


def known_bound(problem: DesignProblem, runs: int) -> Bound | None:
    """The best upper bound that is known: the closed form; without one, or where constraints loosen it, the continuous.

    None where the continuous problem cannot be solved; the bound over a list of choices is the relaxation's. Without a
    joint to choose, every plan is worth the same.
    """
    closed = closed_form_bound(problem)
    if closed is not None and not problem.constraints and problem.choices is None:
        return closed
    from doe.bounds.column_generation import column_generation, continuous_bound  # scipy: 0.3 s to import

    if not problem.searched_joints:
        return Bound(problem.objective(np.tile(problem.lower, (runs, 1))), "continuous", rigorous=True)
    found: Bound | None
    try:
        if problem.choices is None:
            found = continuous_bound(problem, runs=runs)
        else:
            found = column_generation(problem, listed(problem, problem.choices), runs=runs).bound
    except JobError:
        return closed
    if closed is None or found is None:
        return found or closed
    return min(closed, found, key=lambda bound: bound.value)


def score_plan(problem: DesignProblem, plan: Plan | ArrayLike) -> Design:
    """Any plan, judged against the best bound that is known. Raises `InputError` for one that does not fit."""
    given = given_plan(problem, plan)
    return score(problem, given, known_bound(problem, len(given)))
