"""The solvers by name: ours, and those of installed packages; and random plans, common practice to compare with.

`solve`, the only entry point to the exact solvers, and the search loop that all of them share.

A solver offers plans and no numbers. The loop clips them to the joint limits, keeps postures apart, recomputes the
criterion from the stored problem, keeps the best, and ends when the bound is reached, the budget is used up or the user
presses Ctrl-C.

Is a problem solvable at all? Refusals before a search, and the reason after one that found nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from time import perf_counter
from types import MappingProxyType

import numpy as np

from doe.bounds.best_known import best_known_bound, bound_that_holds
from doe.bounds.certificate import REACHED, Bound
from doe.bounds.planar_theorem import applies
from doe.design import Design
from doe.plan.accuracy import plan_jacobians
from doe.plan.ascent import PlanAscent
from doe.plan.plan import Plan
from doe.plan.spacing import allowed_value, replicates_allowed, separated, spread_free_joints
from doe.problem.postures import listed_candidates, random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.exchange import Exchange, ExchangeIpopt, Fedorov, Gradient, RelaxRound
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic, nearly_optimal, optimal_plans
from doe.solvers.solver import LONG_PLAN, Budget, Offer, Solver, time_limit
from identification import (
    Array,
    InputError,
    JobError,
    Progress,
    Status,
    additions,
    identifiability,
    nearest,
    silent,
    single_thread,
)


# -- solvers by name ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Random:
    """Plans uniform within the joint limits, the best of `count`. One: a random plan."""

    count: int = 1
    name: str = "random"

    def starts_for(self, problem: DesignProblem) -> int:
        """Number of random plans."""
        return self.count

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One random plan per start."""
        while True:
            yield Offer(random_postures(problem, runs, generator), 1)


SOLVERS: dict[str, Solver] = {
    "analytic": Analytic(),
    "exchange": Exchange(),
    "exchange_ipopt": ExchangeIpopt(),
    "fedorov": Fedorov(),
    "gradient": Gradient(),
    "ipopt": Ipopt(),
    "random": Random(),
    "relaxation_rounding": RelaxRound(),
    "best_of_random": Random(count=1000, name="best_of_random"),
}


def available_solvers() -> Mapping[str, Solver]:
    """Name -> solver of every one known: ours, and those of installed packages (entry-point group `armcal.solvers`).

    An entry point names a settings object, or a class that makes one without arguments. Raises `InputError` for one
    that cannot be loaded.
    """
    return MappingProxyType({**installed_solvers(), **SOLVERS})


@cache
def installed_solvers() -> dict[str, Solver]:
    """Name -> solver of the entry points, loaded once."""
    loaded: dict[str, Solver] = {}
    for name, where, made in additions("armcal.solvers"):
        try:
            solver = made() if isinstance(made, type) else made
        except Exception as error:  # noqa: BLE001 - other people's code
            raise InputError(f"{where}: {error}, allowed: a class that needs no arguments") from None
        if not callable(getattr(solver, "offers", None)):
            raise InputError(f"{where}, allowed: a solver with offers()")
        loaded[name] = solver
    return loaded


def solver_named(name: str) -> Solver:
    """The solver of a name as in `--solver`. Raises `InputError` with the nearest name for an unknown one."""
    if name not in available_solvers():
        raise InputError(f"solver: unknown name {name!r}, {nearest(name, available_solvers())}")
    return available_solvers()[name]


# -- the search --------------------------------------------------------------------------------------------------------
AGREEMENT = 10  # independent local searches that end at the best value
AGREES = 1e-7  # difference of criterion values that counts as none


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
    check_runs(problem, runs)
    if throw and (names := problem.without_effect):
        raise JobError(f"design: no plan identifies all {problem.parameters} parameters; {NEUTRAL}: {'; '.join(names)}")
    if begin is None or not problem.feasible(begin).any():
        random_postures(problem, 1, np.random.default_rng(seed))  # raises where the constraints exclude everything
    with single_thread():
        limit = time_limit(runs, starts, seconds)
        deadline = None if limit is None else began + limit
        whole = Budget(starts or chosen.starts_for(problem), deadline, may_agree=starts is None, began=began)
        # a bound for many parameters takes seconds, which are no part of the search's time; a theorem takes none;
        # half the time is for what comes first, the search or the bound
        first, late = whole.part(0.5), bound is None and problem.many_parameters and not applies(problem)
        best_bound = None if late else bound or best_known_bound(problem, runs, first.ended)
        budget = first if late else whole
        offers = named_offers(problem, runs, chosen, budget, seed, begin, theory_first=solver is None)
        search = PlanSearch(problem, best_bound, accepted)
        search.run(offers, budget, progress)
        if search.postures is None and search.status is Status.interrupted:
            raise KeyboardInterrupt
        if search.postures is None:
            none = f"no plan that identifies all {problem.parameters} parameters was found by {chosen.name}"
            raise JobError(f"design: {none}")
        best_bound = best_known_bound(problem, runs, whole.ended) if late else best_bound
        postures = search.postures
        if np.isfinite(search.value):  # else the plan is refused, and no room for it may be left
            postures = spread_free_joints(problem, postures, np.random.default_rng([seed, runs]))
        plan = Plan(problem.clip(postures), joint_types=problem.model.joint_types, fit=problem.fit)
        name = search.solver or chosen.name
        design = Design(problem, plan, best_bound, search.status, name, search.starts, perf_counter() - began)
        if bound is None:
            held = bound_that_holds(problem, best_bound, design.plan.postures, design.value, whole.ended)
            design = replace(design, bound=held)
    return judged_identifiable(design, throw=throw)


def chosen_solver(problem: DesignProblem, solver: Solver | str | None) -> Solver:
    """The solver asked for, or the best for the problem. Raises `InputError` where it does not fit the problem."""
    if isinstance(solver, str):
        solver = solver_named(solver)
    if solver is None:
        listed, many = problem.choices is not None, problem.many_parameters
        return SOLVERS["fedorov" if listed else "gradient" if many else "exchange_ipopt"]
    if problem.choices is not None and not isinstance(solver, Fedorov):
        raise InputError(f"solver: {solver.name} cannot choose from a list of postures, allowed: fedorov")
    return solver


def named_offers(
    problem: DesignProblem,
    runs: int,
    solver: Solver,
    budget: Budget,
    seed: int,
    begin: Array | None,
    *,
    theory_first: bool,
) -> Iterator[tuple[str, Offer]]:
    """Plans, each with the name of the solver that offers it: the plan to begin with, as it is and climbed from there;
    where `theory_first` one from theory and, of many runs, one that is nearly so; then the solver's."""
    free, generator = problem.choices is None, np.random.default_rng(seed)
    if begin is not None:
        yield solver.name, Offer(begin)
        if free and problem.searched_joints:
            yield solver.name, Offer(PlanAscent(problem)(begin, stop=budget.ended))
    if theory_first and free:
        optimal = optimal_plans(problem, runs, np.random.default_rng(seed), stop=budget.ended)
        yield from (("analytic", Offer(plan, 1)) for plan in islice(optimal, 1))
        if runs > LONG_PLAN:
            yield from ((solver.name, offer) for offer in nearly_optimal(problem, runs, generator, budget))
            # good postures are few: time may end before those of better plans are moved apart
            yield "random", Offer(random_postures(problem, runs, np.random.default_rng([seed, runs])))
    yield from ((solver.name, offer) for offer in solver.offers(problem, runs, generator, budget))


@dataclass
class PlanSearch:
    """The best plan so far (m, n), its value and solver, starts used, and how the search ended.

    After the first plan only those that are `accepted` take its place.
    """

    problem: DesignProblem
    bound: Bound | None
    accepted: Callable[[Array], bool]
    postures: Array | None = None
    value: float = -np.inf
    solver: str = ""
    starts: int = 0
    status: Status = Status.solver_failed

    def run(self, offers: Iterator[tuple[str, Offer]], budget: Budget, progress: Progress) -> None:
        """Takes offers until there is a reason to stop."""
        agreeing, ended = 0, None
        try:
            for name, offer in offers:
                postures = separated(self.problem, self.problem.clip(offer.postures))
                value = allowed_value(self.problem, postures)
                self.starts += offer.starts
                if self.postures is None or (value > self.value and self.accepted(postures)):
                    agreeing = 0 if value > self.value + AGREES else agreeing
                    self.postures, self.value, self.solver = postures, value, name
                agreeing += offer.independent and abs(value - self.value) <= AGREES
                progress(budget.used(self.starts), budget.starts, f"best {self.value:.7g}")
                if (ended := self._reason_to_stop(budget, agreeing)) is not None:
                    break
        except KeyboardInterrupt:
            ended = Status.interrupted
        if self.postures is not None or ended is not None:
            self.status = ended or Status.starts_finished

    def _reason_to_stop(self, budget: Budget, agreeing: int) -> Status | None:
        criterion, p = self.problem.criterion, self.problem.parameters
        if self.bound is not None and criterion.efficiency(self.value, self.bound.value, p) >= REACHED:
            return Status.bound_reached
        if self.starts >= budget.starts:
            return Status.starts_finished
        if budget.may_agree and agreeing >= AGREEMENT:
            return Status.agreed
        return Status.time_limit if budget.out_of_time else None


# -- refusals ----------------------------------------------------------------------------------------------------------
NEUTRAL = "under one payload, temperature, time and approach no posture distinguishes"


def check_runs(problem: DesignProblem, runs: int) -> None:
    """Raises `InputError` for fewer equations than unknowns, and for an invalid number of runs.

    No more postures fit into the joint limits at the minimum distance than boxes of half the distance's side around
    them: one axis holds width / distance + 1.
    """
    if isinstance(runs, bool) or not isinstance(runs, int | np.integer):
        raise InputError(f"runs: {runs!r:.40}, allowed: a whole number")
    if runs < problem.fewest_runs:
        raise InputError(
            f"runs: {runs} with {problem.parameters} parameters to identify, allowed: at least {problem.fewest_runs}"
        )
    if (alike := replicates_allowed(problem)) < runs:
        width = problem.comparable(problem.upper - problem.lower)[list(problem.searched_joints)]
        most = alike * float(np.prod(np.floor(width / problem.minimum_distance * (1.0 + 1e-9)) + 1.0))
        if runs + len(problem.kept) > most:
            postures = f"{runs + len(problem.kept)} postures {problem.spacing} apart"
            raise InputError(f"runs: {postures}, allowed: at most {most:.0f} in the limits")


def judged_identifiable(design: Design, *, throw: bool) -> Design:
    """The design, with status `not_identifiable` where the plan does not identify all parameters.

    throw : raise `JobError` with the reason instead, and where the plan is not allowed
    """
    problem, identified = design.problem, bool(np.isfinite(design.value))
    if throw and not identified:
        message = f"design: no plan that identifies all {problem.parameters} parameters was found by {design.solver}"
        if problem.choices is None:
            size = (4 * problem.parameters, problem.joints)
            many = np.random.default_rng(0).uniform(problem.lower, problem.upper, size)
        else:
            many = listed_candidates(problem, problem.choices).postures
        jacobians, names = plan_jacobians(problem, many), problem.model.parameters.names
        aliases = identifiability(jacobians, names, np.ones(problem.parameters)).combinations
        if not aliases:
            raise JobError(message)
        if problem.choices is not None:
            candidates = f"the {len(many)} candidates cannot identify all {problem.parameters} parameters"
            raise JobError(f"design: {candidates}, whatever the plan")
        raise JobError(f"{message}; {NEUTRAL}: {'; '.join(aliases)}")
    if throw and not np.isfinite(allowed_value(problem, design.plan.postures)):
        apart = f"postures {problem.spacing} apart"
        raise JobError(f"design: no plan within the constraints and with {apart} was found by {design.solver}")
    return design if identified else replace(design, status=Status.not_identifiable)
