"""The solvers by name, ours and those of installed packages; and `solve`, the only entry point to them.

A solver offers plans and no numbers. The loop clips them to the joint limits, keeps postures apart, recomputes the
criterion from the stored problem, keeps the best, and ends when the bound is reached, the budget is used up or the user
presses Ctrl-C.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from time import perf_counter
from typing import Any

import numpy as np
from numpy.random import Generator
from threadpoolctl import threadpool_limits

from doe.bounds.certificate import ApproximateDesign, Bound
from doe.bounds.column_generation import best_known_bound, bound_that_holds, continuous_design
from doe.bounds.planar_theorem import applies, closed_form_bound, optimal_plans
from doe.design import Design
from doe.plan.accuracy import check_distinct, indistinct
from doe.plan.ascent import PlanAscent
from doe.plan.spacing import allowed_value, places_of_free_joint, separated, spread_free_joints, with_additions
from doe.problem.problem import DesignProblem, listed_candidates, random_postures
from doe.solvers.exchange import Exchange
from doe.solvers.ipopt import Ipopt
from doe.solvers.solver import LONG_PLAN, LONG_PLAN_SECONDS, Budget, Offer, Solver
from identification import Array, InputError, JobError, Plan, Progress, Status, additions, require

AGREEMENT = 10  # independent local searches that end at the best value


# -- solvers by name ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Random:
    """Plans uniform within the joint limits, the best of `count`. One: common practice, to compare with."""

    count: int = 1
    name: str = "random"

    def starts_for(self, problem: DesignProblem) -> int:
        """Number of random plans."""
        return self.count

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """One random plan per start."""
        while True:
            yield Offer(random_postures(problem, runs, generator), 1)


@dataclass(frozen=True)
class Analytic(Random):
    """Random plans that attain the closed-form bound; none where the limits or the number of runs do not allow any."""

    name: str = "analytic"

    def offers(self, problem: DesignProblem, runs: int, generator: Generator, budget: Budget) -> Iterator[Offer]:
        """One plan per start. Raises `JobError` where there is none."""
        plan = None
        for plan in optimal_plans(problem, runs, generator):
            yield Offer(plan, 1)
        if plan is None:
            none = "has no plan for this criterion, these limits and this number of runs"
            raise JobError(f"solver: analytic {none}, allowed: leave --solver out")


SOLVERS: dict[str, Solver] = {
    "analytic": Analytic(),
    "exchange": Exchange(),
    "ipopt": Ipopt(),
    "random": Random(),
    "best_of_random": Random(count=1000, name="best_of_random"),
}


@cache
def available_solvers() -> Mapping[str, Solver]:
    """Name -> solver of every one known: ours, and those of installed packages (entry-point group `armcal.solvers`).

    An entry point names a settings object, or a class that makes one without arguments. Raises `InputError` for one
    that cannot be loaded.
    """
    loaded: dict[str, Solver] = {}
    for name, where, made in additions("armcal.solvers"):
        try:
            solver = made() if isinstance(made, type) else made
        except Exception as error:  # noqa: BLE001 - other people's code
            raise InputError(f"{where}: {error}, allowed: a class that needs no arguments") from None
        require(callable(getattr(solver, "offers", None)), f"{where}, allowed: a solver with offers()")
        loaded[name] = solver
    return loaded | SOLVERS


# -- the search --------------------------------------------------------------------------------------------------------
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
    progress: Progress = Progress(),
) -> Design:
    """The best plan of `runs` measurements that the solver finds, with its certificate.

    solver : settings object, or name; left out: a plan from theory if that attains the bound, else exchange
    seed : the same seed gives the same plan, unless the time limit binds
    starts, seconds : budget; left out: the solver's own number of starts, fewer when many of them agree; no time limit
        up to 100 runs, 30 s for more. The bound is included: whichever of search and bound comes first gets half of it
    bound : upper bound of the criterion; left out: the best that is known, see `doe.bounds.column_generation`
    begin : (m, n) a plan to begin with;  accepted : which plans may take its place

    Ctrl-C returns the best plan so far, status `interrupted`. Raises `InputError` for too few runs, an unknown name,
    and `JobError` where no plan identifies all parameters.
    """
    began = perf_counter()
    if not isinstance(problem, DesignProblem):
        raise InputError(f"problem: found {type(problem).__name__}, allowed: a DesignProblem, as DesignProblem.of(arm)")
    if isinstance(solver, str):
        InputError.check_names("solver: unknown name", [solver], available_solvers())
        solver = available_solvers()[solver]
    chosen = SOLVERS["exchange"] if solver is None else solver
    if problem.choices is not None and not isinstance(chosen, Exchange):
        raise InputError(f"solver: {chosen.name} cannot choose from a list of postures, allowed: exchange")
    check_runs(problem, runs)
    check_distinct(problem, "design")
    if begin is None or not problem.feasible(begin).any():
        random_postures(problem, 1, np.random.default_rng(seed))  # raises where the constraints exclude everything
    best, best_value, best_name, done, agreeing = None, -np.inf, chosen.name, 0, 0
    reached = 1.0 - 1e-7  # efficiency from which searching on cannot matter
    status, p, same = Status.starts_finished, problem.parameters, 1e-7  # of criterion values
    with threadpool_limits(limits=1, user_api="blas"):  # matrices are small: more threads only wait for each other
        usual = LONG_PLAN_SECONDS if runs > LONG_PLAN and starts is None else np.inf
        deadline = began + (usual if seconds is None else seconds)

        def tell() -> None:
            first = not np.isfinite(best_value)
            # starts, or time, whichever has more behind it
            used = max(done, min(1.0, (perf_counter() - began) / max(deadline - began, 1e-9)) * whole.starts)
            progress(used, whole.starts, "the first plan" if first else f"best {best_value:.7g}")

        whole = Budget(starts or chosen.starts_for(problem), deadline, tell)
        # a bound for many parameters takes seconds, which are no part of the search's time; a theorem takes none;
        # half the time is for what comes first, the search or the bound
        first = replace(whole, deadline=0.5 * (perf_counter() + deadline))
        late = bound is None and problem.many_parameters and not applies(problem)
        best_bound = None if late else bound or best_known_bound(problem, runs, first.ended)
        budget = first if late else whole
        try:
            for name, offer in _offers(problem, runs, chosen, solver is None, seed, begin, budget):
                if np.shape(offer.postures) != (runs, problem.joints):
                    found = f"offers postures of shape {np.shape(offer.postures)}"
                    raise JobError(f"solver: {name} {found}, allowed: ({runs}, {problem.joints})")
                clipped, dice = problem.clip(offer.postures), np.random.default_rng([seed, runs])
                postures = separated(problem, spread_free_joints(problem, clipped, dice))
                value = allowed_value(problem, postures)
                done += offer.starts
                if best is None or (value > best_value and accepted(postures)):
                    agreeing = 0 if value > best_value + same else agreeing
                    best, best_value, best_name = postures, value, name
                agreeing += offer.independent and abs(value - best_value) <= same
                tell()
                if best_bound is not None and problem.criterion.efficiency(best_value, best_bound.value, p) >= reached:
                    status = Status.bound_reached
                elif done >= budget.starts:
                    status = Status.starts_finished
                elif starts is None and agreeing >= AGREEMENT:
                    status = Status.agreed
                elif budget.ended():
                    status = Status.time_limit
                else:
                    continue
                break
        except KeyboardInterrupt:
            if best is None:
                raise
            status, whole = Status.interrupted, replace(whole, deadline=began)  # the user waits: no time for the bound
        if best is None:
            raise JobError(f"design: no plan that identifies all {p} parameters was found by {chosen.name}")
        try:
            best_bound = best_known_bound(problem, runs, whole.ended) if late else best_bound
            if bound is None:
                best_bound = bound_that_holds(problem, best_bound, best, problem.objective(best), whole.ended)
        except KeyboardInterrupt:  # the plan is there
            status, best_bound = Status.interrupted, None
        plan = Plan(best, joint_types=problem.model.joint_types, fit=problem.fit)
        design = Design(problem, plan, best_bound, status, best_name, done, perf_counter() - began)
        if design.certified_optimal and status is not Status.interrupted:  # by a bound that came after the search, say
            design = replace(design, status=Status.bound_reached)
    if not np.isfinite(design.value):
        if problem.choices is not None and not problem.sampled:
            listed = listed_candidates(problem, problem.choices)
            some = f"the {len(listed)} candidates cannot identify all {p} parameters, whatever the plan"
            if indistinct(problem, listed):
                raise JobError(f"design: {some}")
        raise JobError(f"design: no plan that identifies all {p} parameters was found by {design.solver}")
    if not np.isfinite(best_value):
        apart = f"postures {problem.spacing} apart was found by {design.solver}"
        apart += "; armcal design --repeats allows equal ones" * (problem.minimum_distance > 0.0)
        raise JobError(f"design: no plan within the constraints and with {apart}")
    return design


def _offers(
    problem: DesignProblem,
    runs: int,
    solver: Solver,
    theory_first: bool,
    seed: int,
    begin: Array | None,
    budget: Budget,
) -> Iterator[tuple[str, Offer]]:
    """Plans, each with the name of the solver that offers it: the plan to begin with, as it is and climbed from there;
    where `theory_first` one from theory and, of many runs, one that is nearly so, and a random one with its climb, as
    exchange may not come to an end; then the solver's."""
    free, generator = problem.choices is None, np.random.default_rng(seed)
    begins = [] if begin is None else [(solver.name, begin)]
    if theory_first and free:
        optimal = optimal_plans(problem, runs, np.random.default_rng(seed))
        yield from (("analytic", Offer(plan, 1)) for plan in islice(optimal, 1))
        if runs > LONG_PLAN:
            # a plan from theory of a few runs less, and the postures that add most to it
            for fewer in range(runs - 1, max(runs - 64, problem.fewest_runs) - 1, -1):
                some = next(optimal_plans(problem, fewer, generator, 12), None)
                if some is not None and (plan := with_additions(problem, some, runs - fewer, generator)) is not None:
                    yield solver.name, Offer(plan, 1)
                if some is not None or budget.ended():
                    break
            # where good postures are few, time may end before those of better plans are moved apart
            begins.append(("random", random_postures(problem, runs, np.random.default_rng([seed, runs]))))
    for name, plan in begins:
        yield name, Offer(plan)
        if free and problem.searched_joints:
            yield solver.name, Offer(PlanAscent(problem)(plan, stop=budget.ended))
    yield from ((solver.name, offer) for offer in solver.offers(problem, runs, generator, budget))


# -- refusals ----------------------------------------------------------------------------------------------------------
def check_runs(problem: DesignProblem, runs: int) -> None:
    """Raises `InputError` for fewer equations than unknowns, and for an invalid number of runs.

    No more postures fit into the joint limits at the minimum distance than boxes of half the distance's side around
    them: one axis holds width / distance + 1.
    """
    if isinstance(runs, bool) or not isinstance(runs, int | np.integer):
        raise InputError(f"runs: {runs!r:.40}, allowed: a whole number")
    fewest, what = problem.fewest_runs, f"{runs} with {problem.parameters} parameters to identify"
    require(runs >= fewest, f"runs: {what}, allowed: at least {fewest}")
    if problem.choices is None and problem.minimum_distance > 0.0:
        width = problem.comparable(problem.upper - problem.lower)[list(problem.searched_joints)]
        each = np.floor(width / problem.minimum_distance * (1.0 + 1e-9)) + 1.0
        most = places_of_free_joint(problem) * float(np.prod(each))
        postures = f"{runs + len(problem.kept)} postures {problem.spacing} apart"
        require(runs + len(problem.kept) <= most, f"runs: {postures}, allowed: at most {most:.0f} in the limits")


# -- independent answers -----------------------------------------------------------------------------------------------
def cross_check(
    problem: DesignProblem, relaxed: ApproximateDesign, runs: int, *, seed: int = 0, seconds: float = 60.0
) -> list[dict[str, Any]]:
    """Independent answers to one design problem side by side, which share the Jacobian and nothing else.

    Rows `method`, `space`, attained `value`, upper `bound` and `table_1_max_residual` of the (weighted) plan: of the
    relaxation, the optimum over all postures, an exact plan, and the closed form where it applies; bounds and attained
    values bracket the truth.

    With a prior over many effects, whose continuous optimum takes hours, without that.
    seconds : for both, the first half for the exact plan, which a bound reached ends sooner
    """
    end = perf_counter() + seconds
    # where the weights took all the time the exact plan has that of its first start
    exact = solve(problem, runs, "exchange", seed=seed, seconds=max(0.5 * seconds, 0.01))
    designs: list[tuple[str, str, ApproximateDesign | Design]] = [("relaxation", "candidates", relaxed)]
    if not problem.deviations:
        try:
            everywhere = continuous_design(problem, runs=runs, stop=lambda: perf_counter() > end)
            designs.append(("column generation", "all postures", everywhere))
        except JobError:
            pass
    designs.append(("exact plan", f"{len(exact.plan)} runs", exact))
    rows: list[dict[str, Any]] = [
        {
            "method": f"{name}, {design.solver}"
            + (f", cut at {design.seconds:.0f} s" if design.status is Status.time_limit else "")
            + (", bound cut" if design.bound is not None and design.bound.cut else ""),
            "space": space,
            "value": design.value,
            "bound": None if design.bound is None else design.bound.value,
            "table_1_max_residual": Design(problem, design.plan).table_1_max_residual,
        }
        for name, space, design in designs
    ]
    if (theorem := closed_form_bound(problem)) is not None:
        closed = {"method": "closed form", "space": "all postures", "value": theorem.value, "bound": theorem.value}
        rows.append(closed | {"table_1_max_residual": None})
    return rows
