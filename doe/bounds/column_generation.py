"""Column generation: optimal weights on few postures, priced against very many, or against all of the joint box.

    repeat:  weights   solve the small problem on a working set of postures   (weights, convex_program)
             price     find postures with tr(G F(q)) above tr(G M)            (a stage)
             purge     drop postures that need not carry weight

Cheap stages come first; the last one decides. The loop ends when no posture improves the design. The certificate at the
end is of the plan that is reported, proven by `doe.bounds.branch_and_bound` where the model allows.

`relax`: optimal weights over candidate postures, by column generation or as one convex program.

The value and the bound are recomputed from the weights, whoever computed them; a solver's own numbers are not used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.branch_and_bound import TrigonometricJacobian, maximum
from doe.bounds.certificate import (
    REMEMBERED,
    ApproximateDesign,
    CandidateJacobians,
    largest_sensitivity,
    last_pass,
)
from doe.bounds.continuous import SAME, ContinuousSet, distinct
from doe.bounds.weights import (
    POWERS,
    interior_point_weights,
    multiplicative_weights,
    proper_weights,
    solve_program,
    sparsest,
)
from doe.criteria import Criterion
from doe.plan.ascent import PlanAscent
from doe.problem.postures import Candidates, Grid, PostureList, grid, listed_candidates, random_postures, well_spread
from doe.problem.problem import DesignProblem, PriorInformation, Stop, never
from identification import Array, InputError, JobError, Status, nearest

# (p, p) gradient, tr(G M), and (k, n) postures in the working set -> postures to add (j, n), best first, and the
# largest sensitivity of all that was visited
Price = Callable[[Array, float, Array], tuple[Array, float]]

SAMPLE = 20_000  # of very many candidates, which are priced first
SHORT = 30_000  # of the best candidates, which are priced then
ROUGH = 1e-4  # gap of the weights relative to that of the postures, until the end
EXACT = 1e-14  # the same at the end: rounding
COARSE = 1e-4  # relative gap at which pricing goes on to the next, larger set
FINE = 1e-6  # the same, before the first thorough search; and from which the weights at the end are exact
WEIGHTED = 2000  # candidates that are weighted roughly at once however many parameters there are


@dataclass(frozen=True)
class Stage:
    """One pricing, used until the gap it finds is below `goal` (relative).

    back : stages to go back when it found something: a cheaper search refines what a thorough one found
    """

    price: Price
    goal: float
    back: int = 0


def column_generation(
    problem: DesignProblem,
    candidates: Candidates,
    *,
    runs: int | None = None,
    tolerance: float = 1e-9,
    stop: Stop = never,
) -> ApproximateDesign:
    """Optimal weights over a finite candidate set of any size, in the memory of one chunk of it.

    tolerance : gap max g - tr(G M), relative to tr(G M), at which to stop
    runs : number of new runs, needed where the problem keeps measured postures
    stop : asked after every pricing; the bound is then that of the weights so far, after a pass over all candidates
    Raises JobError where the candidates do not identify all parameters.
    """
    began, prior = perf_counter(), problem.prior.per_new_run(runs)
    tolerance = _attainable(problem, tolerance)
    everything = CandidatePrice(problem, candidates, prior)
    stages = [Stage(everything, tolerance)]
    if len(candidates) > 4 * SAMPLE:
        tolerance = max(tolerance, 1e-6) if problem.many_parameters else tolerance  # a pass takes seconds
        everything.short = CandidatePrice(problem, PostureList(well_spread(candidates, SAMPLE)), prior)
        cheap = Stage(lambda *request: everything.short(*request), tolerance)  # type: ignore[misc]
        stages = [cheap, Stage(everything, tolerance, back=1)]
    start = well_spread(candidates, 6 * problem.parameters)
    design, _ = generate_columns(problem, prior, start, stages, stop)
    largest = largest_sensitivity(problem, candidates, design.gradient, prior, last_pass(stop, began))
    settings = {"candidates": len(candidates), "rigorous": True, "solver": "column_generation"}
    return design.certified(largest, 10.0 * tolerance, cut=stop(), seconds=perf_counter() - began, **settings)


def rough_design(
    problem: DesignProblem,
    candidates: Candidates,
    *,
    runs: int | None = None,
    tolerance: float = 0.01,  # the bound is within as much of the optimum
    stop: Stop = never,
) -> ApproximateDesign:
    """Weights over a finite candidate set by the multiplicative algorithm, with a bound that holds whatever the gap.

    For hundreds of parameters, where the optimal weights are spread over as many postures. Very many candidates are
    weighted in parts: a sample, then the postures of it that carry weight and the best of all others.

    tolerance : relative gap of the weights on a part, half of what counts as solved
    runs : number of new runs, needed where anything is known beforehand;  stop : asked after every step
    Raises `InputError` for a criterion other than D, A and I, `JobError` where the candidates do not identify all
    parameters.
    """
    if problem.criterion.name not in POWERS:
        raise InputError(f"criterion: {problem.criterion.name} for solver multiplicative, allowed: D, A, I")
    began, prior = perf_counter(), problem.prior.per_new_run(runs)
    most = max(WEIGHTED, REMEMBERED // (problem.model.dimension * problem.parameters))
    working = well_spread(candidates, most)
    while True:
        jacobians = np.ascontiguousarray(problem.scaled_jacobians(working))
        check_identified(problem, prior, jacobians)
        weights = multiplicative_weights(jacobians, problem.criterion, prior, tolerance, stop)
        carried = np.where(weights > 1e-6 * weights.max(), weights, 0.0)  # the others are left out
        design = ApproximateDesign.heaviest_first(problem, prior, working, carried)
        price = CandidatePrice(problem, candidates, prior, last_pass(stop, began))
        offers, largest = price(design.gradient, design.level, working)
        goal = 2.0 * tolerance  # postures were left out
        if largest - design.level <= goal * abs(design.level) or stop() or len(working) == len(candidates):
            break
        working = np.unique(np.concatenate([design.plan.postures, offers]), axis=0)
    settings = {"candidates": len(candidates), "rigorous": True, "solver": "multiplicative"}
    return design.certified(largest, goal, cut=stop(), seconds=perf_counter() - began, **settings)


def continuous_design(
    problem: DesignProblem,
    *,
    runs: int | None = None,
    tolerance: float = 1e-10,
    proof: float = 1e-10,
    also: Array | None = None,
    stop: Stop = never,
) -> ApproximateDesign:
    """Optimal weights over ALL postures within limits and constraints: no grid at all.

    Works for any model. Where the sensitivity is a trigonometric polynomial and there are no constraints, the gap is
    proven by branch and bound and `bound.rigorous` is True; else the largest sensitivity is the best of a multistart.
    tolerance : relative gap at which to stop;  proof : relative gap that branch and bound must prove, 0: do not try
    also : (k, n) postures from which the multistart starts as well
    stop : asked after every pricing; the bound is then that of the weights so far, after a thorough search
    """
    began, prior = perf_counter(), problem.prior.per_new_run(runs)
    tolerance = _attainable(problem, tolerance)
    everything = ContinuousSet(problem, prior, also)
    stages = ascents(everything, tolerance, stop)
    if problem.many_parameters:
        stages = [Stage(stages[-1].price, tolerance)]
        start = also
        if start is None:  # a long plan that was climbed on gradients: nearly the support of the best weights
            anywhere = random_postures(problem, 3 * problem.parameters, np.random.default_rng(0))
            start = PlanAscent(problem, runs or len(anywhere))(anywhere, stop=stop)
    else:
        starts = PostureList(everything.starts)
        stages = [Stage(CandidatePrice(problem, starts, prior), COARSE), *stages]
        start = well_spread(starts, 6 * problem.parameters)
    design, gap = generate_columns(problem, prior, start, stages, stop)
    thorough = np.random.default_rng(0) if stop() and not problem.many_parameters else None
    best = everything.best(design.gradient, design.plan.postures, thorough)[1][0]
    largest, rigorous, goal = max(design.level + gap, float(best)), False, max(tolerance, proof)
    jacobians = TrigonometricJacobian.of(problem) if proof > 0.0 and not problem.constraints else None
    if jacobians is not None and not stop():
        stages = ascents(everything, tolerance)
        design, largest, rigorous = prove(everything, jacobians, design, largest, stages, goal, stop)
    settings = {"rigorous": rigorous, "solver": "column_generation"}
    return design.certified(largest, 10.0 * goal, cut=stop(), seconds=perf_counter() - began, **settings)


def ascents(everything: ContinuousSet, tolerance: float, stop: Stop = never) -> list[Stage]:
    """The pricing stages: a cheap multistart, then a thorough one, to a relative gap of `tolerance`."""

    def price(generator: np.random.Generator | None) -> Price:
        def best(gradient: Array, level: float, near: Array) -> tuple[Array, float]:
            postures, values = everything.best(gradient, near, generator, stop)
            # a posture this near to a better one differs in value by a small part of the gap: one of the two is enough
            reach = 0.2 * np.sqrt(max(values[0] / level - 1.0, 0.0))  # [rad], the root of the relative gap
            apart = distinct(everything.problem.comparable(postures), reach)
            return best_offers(postures[apart], values[apart], level, 10 * everything.problem.parameters, 0.0)

        return best

    climb, thorough = price(None), price(np.random.default_rng(0))
    return [
        Stage(climb, max(FINE, tolerance)),
        Stage(thorough, max(COARSE, tolerance), back=1),
        Stage(climb, tolerance),
        Stage(thorough, tolerance, back=1),
    ]


def _attainable(problem: DesignProblem, tolerance: float) -> float:
    """E-optimal weights come from a semidefinite program, which is less accurate than Newton's method."""
    return max(tolerance, 1e-6) if problem.criterion.name == "E" else tolerance


def prove(
    everything: ContinuousSet,
    jacobians: TrigonometricJacobian,
    design: ApproximateDesign,
    largest: float,
    stages: Sequence[Stage],
    tolerance: float,
    stop: Stop = never,
) -> tuple[ApproximateDesign, float, bool]:
    """Branch and bound on the sensitivity; a posture that the multistart missed starts the loop again.

    Returns the design, its largest sensitivity, and whether that is proven.
    """
    problem, prior = everything.problem, everything.prior
    for _ in range(20):  # attempts, each with a posture more that was missed
        constant = float(prior.mixed(np.zeros(()), design.gradient))
        polynomial = jacobians.sensitivity(design.gradient, prior.new_fraction, constant)
        close, supported = tolerance * abs(design.level), design.plan.postures
        top = maximum(
            polynomial, problem.lower, problem.upper, tried=supported, tolerance=close, most_boxes=8_000, stop=stop
        )  # so many boxes take about a second
        largest = max(largest, top.value)
        if not top.proven:
            return design, largest, False
        if top.value <= design.level + close:
            return design, top.upper, True
        start = np.concatenate([supported, top.posture[None]])
        design, gap = generate_columns(problem, prior, start, stages, stop)
        largest = design.level + gap
    return design, top.upper, True


# -- the loop ----------------------------------------------------------------------------------------------------------
def generate_columns(
    problem: DesignProblem,
    prior: PriorInformation,
    start: Array,
    stages: Sequence[Stage],
    stop: Stop = never,
) -> tuple[ApproximateDesign, float]:
    """Optimal weights, and the gap (absolute) that the last pricing, of the last stage unless `stop` said so, found.

    Raises `JobError` where the postures to start from (k, n) do not identify all parameters.
    """
    criterion, comparable = problem.criterion, problem.comparable
    postures, jacobians = start, problem.scaled_jacobians(start)
    check_identified(problem, prior, jacobians)
    accuracy = EXACT  # of the weights; later, far from the end, exact ones would be wasted
    if stop():  # before the first weights, which take seconds where parameters are many: equal ones prove a bound too
        weights = np.full(len(jacobians), 1.0 / len(jacobians))
        gradient = criterion.gradient(prior.mixture(jacobians, weights))
    else:
        weights, gradient = optimal_weights(jacobians, criterion, prior, accuracy)
    finest = EXACT if stages[-1].goal <= FINE else ROUGH * stages[-1].goal
    current, gap, smallest = 0, np.inf, np.inf
    for _ in range(200):
        stage, level = stages[current], float(np.sum(gradient * prior.mixture(jacobians, weights)))
        offers, largest = stage.price(gradient, level, postures)
        gap = largest - level
        if stop():
            break
        inside = [np.abs(comparable(postures) - offer).max(axis=1).min() <= SAME for offer in comparable(offers)]
        stuck = accuracy == finest and all(inside)  # a gap that rounding leaves
        if len(offers) and gap > stage.goal * abs(level) and not stuck:
            accuracy = max(ROUGH * gap / abs(level), finest)
            # dropping postures although the gap has not shrunk can go in circles, never dropping any takes for ever
            if len(postures) > 30 * problem.parameters or gap < 0.9 * smallest:
                carrying = _sparse(jacobians, weights) > 0.0
                postures, jacobians = postures[carrying], jacobians[carrying]
            postures = np.concatenate([postures, offers])
            jacobians = np.concatenate([jacobians, problem.scaled_jacobians(offers)])
            once = np.sort(distinct(comparable(postures)))
            postures, jacobians = postures[once], jacobians[once]
            smallest, current = min(smallest, gap), current - stage.back
        elif accuracy > finest:
            accuracy = finest
        elif current == len(stages) - 1:
            break
        else:
            current, smallest = current + 1, np.inf
            continue
        weights, gradient = optimal_weights(jacobians, criterion, prior, accuracy)
    dual = gradient if criterion.name == "E" else None
    return ApproximateDesign.heaviest_first(problem, prior, postures, _sparse(jacobians, weights), dual), gap


def _sparse(jacobians: Array, weights: Array) -> Array:
    """(k,) weights of the same information on as few postures as possible."""
    return sparsest(jacobians, np.where(weights > 1e-10, weights, 0.0))  # as good as none


def optimal_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, accuracy: float = EXACT
) -> tuple[Array, Array]:
    """Weights (k,) for scaled Jacobians (k, d, p), and (p, p) G there, by the method that the criterion allows."""
    if criterion.name != "E":
        return interior_point_weights(jacobians, criterion, prior, accuracy)
    weights, status, gradient = solve_program(prior.posture_information(jacobians), criterion, "clarabel")
    if weights is None or gradient is None:
        raise JobError(f"clarabel: status {status} on the restricted master of {len(jacobians)} postures")
    return proper_weights(weights), gradient  # of the dual: E has no gradient of its own


def check_identified(problem: DesignProblem, prior: PriorInformation, jacobians: Array) -> None:
    """Raises `JobError` where postures with these scaled Jacobians (k, d, p) do not identify all parameters."""
    equal = prior.mixture(jacobians, np.full(len(jacobians), 1.0 / len(jacobians)))
    if not np.isfinite(problem.criterion.value(equal)):
        raise JobError(
            "approximate design: the information matrix is singular on these postures, the parameters cannot all "
            "be identified; drop an effect or allow more postures"
        )


# -- which postures of a finite set to add -----------------------------------------------------------------------------
class CandidatePrice:
    """Price of a candidate set: every candidate is evaluated, and each of many parts of the set offers its best.

    short : price of the best candidates of the last pass, where the set is very large: its offers need no further pass
    give_up : asked after every chunk; no offers and inf, which is no less than the largest, where it said so
    """

    def __init__(
        self, problem: DesignProblem, candidates: Candidates, prior: PriorInformation, give_up: Stop = never
    ) -> None:
        self.problem, self.prior, self.give_up = problem, prior, give_up
        self.jacobians = CandidateJacobians(problem, candidates)
        # about 256 parts, of which each may offer one posture per round: keeps new postures apart
        self.part = max(16, -(-len(candidates) // 256))
        self.short: CandidatePrice | None = None

    def __call__(self, gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        """Postures to add (j, n), best first, and the largest sensitivity."""
        best: list[tuple[Array, Array]] = []
        floor = -np.inf
        for postures, g in self.jacobians.sensitivities(gradient, self.prior):
            if self.short is None:
                edges = range(0, len(g), self.part)
                rows = np.array([edge + int(np.argmax(g[edge : edge + self.part])) for edge in edges])
            else:
                rows = np.flatnonzero(g > floor)
            best.append((postures[rows], g[rows]))
            if self.short is not None and sum(len(values) for _, values in best) > 2 * SHORT:
                best = [_highest(best, SHORT)]
                floor = float(best[0][1].min())
            if self.give_up():
                return near[:0], np.inf
        if self.short is None:
            return best_offers(*_highest(best), level, 3 * self.problem.parameters)
        self.short = CandidatePrice(self.problem, PostureList(_highest(best, SHORT)[0]), self.prior)
        return self.short(gradient, level, near)


def _highest(parts: list[tuple[Array, Array]], count: int | None = None) -> tuple[Array, Array]:
    """(k, n) the postures of greatest value of all, and their values, greatest first."""
    postures, values = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(-values, kind="stable")[:count]
    return postures[order], values[order]


def best_offers(postures: Array, values: Array, level: float, count: int, fraction: float = 0.1) -> tuple[Array, float]:
    """Those of the best `count` whose value is above the level by a fraction of the largest, best first; that one."""
    largest = float(values.max())
    order = np.argsort(-values)[:count]
    order = order[values[order] > level + fraction * max(largest - level, 0.0)]
    return postures[order], largest


# -- the door ----------------------------------------------------------------------------------------------------------
# candidates up to which a solver's one big program works; beyond, Clarabel returns errors and SCS takes gigabytes
LARGEST = MappingProxyType({"clarabel": 20_000, "scs": 100_000})
OWN = MappingProxyType({"column_generation": column_generation, "multiplicative": rough_design})
STATUS = MappingProxyType(
    {
        "optimal": Status.converged,
        "optimal_inaccurate": Status.almost_solved,
        "user_limit": Status.iteration_limit,
    }
)


def relax(
    problem: DesignProblem,
    candidates: int | ArrayLike | Candidates,
    solver: str = "column_generation",
    *,
    runs: int | None = None,
    stop: Stop = never,
) -> ApproximateDesign:
    """Optimal weights over candidate postures, with a certificate recomputed from the weights.

    candidates : levels per joint of a grid from limit to limit, or (N, n) postures [rad], or `Candidates`
    solver : `clarabel`, `scs`, `multiplicative` (rough, for very many parameters) or `column_generation`, which alone
        has no limit of size
    runs : number of new runs, needed where the problem keeps measured postures
    stop : asked now and then by column_generation and multiplicative; the bound holds where it ended them early
    Raises InputError for an unknown solver, too many candidates for it, no feasible candidate; JobError where the
    solver returns no weights.
    """
    if solver not in (*LARGEST, *OWN):
        raise InputError(f"solver: unknown name {solver!r}, {nearest(solver, (*LARGEST, *OWN))}")
    if isinstance(candidates, int | np.integer):
        chosen: Candidates = grid(problem, int(candidates))
    elif isinstance(candidates, Grid | PostureList):
        chosen = candidates
    else:
        chosen = listed_candidates(problem, np.asarray(candidates, dtype=float))
    try:
        if solver in OWN:
            return OWN[solver](problem, chosen, runs=runs, stop=stop)
        if len(chosen) > LARGEST[solver]:
            allowed = f"up to {LARGEST[solver]}, where one big program still works"
            raise InputError(
                f"candidates: {len(chosen)} for solver {solver}, allowed: {allowed}; solver column_generation works at "
                "this size"
            )
        began, postures, prior = perf_counter(), chosen.take(np.arange(len(chosen))), problem.prior.per_new_run(runs)
        jacobians = problem.scaled_jacobians(postures)
        weights, solver_status, dual = solve_program(prior.posture_information(jacobians), problem.criterion, solver)
        if weights is None:
            raise JobError(
                f"{solver}: status {solver_status} on {len(chosen)} candidates, no weights; solver column_generation "
                "works at this size"
            )
        weights = proper_weights(weights)
        carried = np.where(weights > 1e-7, weights, 0.0)  # interior points give every posture a little
        design = ApproximateDesign.heaviest_first(problem, prior, postures, carried, dual)
        return replace(
            design,
            largest=largest_sensitivity(problem, chosen, design.gradient, prior),
            candidates=len(chosen),
            rigorous=True,
            status=STATUS.get(solver_status, Status.solver_failed),
            solver=solver,
            solver_status=solver_status,
            seconds=perf_counter() - began,
        )
    except np.linalg.LinAlgError:
        singular = "the candidates' information is singular to rounding; wider joint limits or fewer effects may help"
        raise JobError(f"{solver}: {singular}") from None
