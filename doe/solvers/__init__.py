"""Exact solvers: one method per file, and `solve`, the only door to them."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from doe.bound import Bound
from doe.closed_form import closed_form_bound
from doe.plan import Plan
from doe.problem import DesignProblem
from doe.result import Design, score
from doe.solvers.analytic import Analytic
from doe.solvers.base import Budget, Offer, Solver
from doe.solvers.driver import Search, check_runs, finish, run_search
from doe.solvers.exchange import Exchange
from doe.solvers.exchange_ipopt import ExchangeIpopt
from doe.solvers.ipopt import Ipopt
from doe.solvers.random import Random
from identification.errors import InputError, nearest
from identification.progress import Progress, silent
from identification.status import Status

__all__ = [
    "SOLVERS",
    "Analytic",
    "Exchange",
    "ExchangeIpopt",
    "Ipopt",
    "Offer",
    "Random",
    "Solver",
    "named",
    "score_plan",
    "solve",
]

SOLVERS: dict[str, Solver] = {
    "analytic": Analytic(),
    "exchange": Exchange(),
    "exchange_ipopt": ExchangeIpopt(),
    "ipopt": Ipopt(),
    "random": Random(),
    "best_of_random": Random(count=1000, name="best_of_random"),
}
DEFAULT = "exchange_ipopt"


def named(name: str) -> Solver:
    """The solver of a name as in `--solver`. Raises `InputError` with the nearest name for an unknown one."""
    if name not in SOLVERS:
        raise InputError(f"solver: unknown name {name!r}, {nearest(name, SOLVERS)}")
    return SOLVERS[name]


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
    bound : upper bound of the criterion; left out: the best that is known, see `known_bound`
    throw : raise `JobError` where no plan identifies all parameters; False: return the last one, value -inf

    Ctrl-C returns the best plan so far, status `interrupted`. Raises `InputError` for too few runs, an unknown name.
    """
    began = perf_counter()
    chosen = named(solver or DEFAULT) if isinstance(solver, str | None) else solver
    check_runs(problem, runs)
    known = bound or known_bound(problem, runs)
    if solver is None and known is not None:
        theory = _search(problem, runs, Analytic(), seed, 1, seconds, known, silent)
        if theory.status is Status.bound_reached:
            return finish(problem, theory, Analytic(), known, began, seed, throw)
    search = _search(problem, runs, chosen, seed, starts, seconds, known, progress)
    return finish(problem, search, chosen, known, began, seed, throw)


def _search(
    problem: DesignProblem,
    runs: int,
    solver: Solver,
    seed: int,
    starts: int | None,
    seconds: float | None,
    bound: Bound | None,
    progress: Progress,
) -> Search:
    deadline = None if seconds is None else perf_counter() + seconds
    budget = Budget(starts or solver.starts_for(problem), deadline, may_agree=starts is None)
    offers = solver.offers(problem, runs, np.random.default_rng(seed), budget)
    return run_search(problem, offers, budget, bound, progress)


def known_bound(problem: DesignProblem, runs: int) -> Bound | None:
    """The best upper bound that is known: the closed form where it applies."""
    return closed_form_bound(problem)


def score_plan(problem: DesignProblem, plan: Plan | ArrayLike) -> Design:
    """Any plan, judged against the best bound that is known."""
    given = plan if isinstance(plan, Plan) else Plan(np.asarray(plan, dtype=float))
    return score(problem, given, known_bound(problem, len(given)))
