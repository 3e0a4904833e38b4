"""Column generation: optimal weights on few postures, priced against very many, or against all of the joint box.

    repeat:  weights   solve the small problem on a working set of postures   (`doe.bounds.weights`)
             price     find postures with tr(G F(q)) above tr(G M)            (a stage)
             purge     drop postures that need not carry weight

Pricing goes from cheap stages to thorough ones; the loop ends when the last finds no posture that improves the design.
The certificate at the end is of the plan that is reported, proven by `doe.bounds.branch_and_bound` where the model
allows.

`relax`: optimal weights over candidate postures, by column generation or as one convex program. The value and the bound
are recomputed from the weights, whoever computed them; a solver's own numbers are not used.

The best bound that is known for a problem: the certificate of one number of runs bounds all others too (doe/README.md,
"Exact plans"), tight where it was made and loose by about the square of the change of log m elsewhere.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from time import perf_counter

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from doe.bounds.branch_and_bound import TrigonometricPolynomial, maximum, trigonometric_jacobian
from doe.bounds.certificate import ApproximateDesign, Bound
from doe.bounds.planar_theorem import closed_form_bound
from doe.bounds.weights import EXACT, optimal_weights, solve_program, sparsest
from doe.plan.accuracy import check_distinct
from doe.plan.ascent import PlanAscent
from doe.problem.constraints import Derivatives
from doe.problem.problem import (
    DesignProblem,
    PriorInformation,
    Stop,
    grid,
    information_of_each,
    listed_candidates,
    never,
    put_inside,
    random_postures,
    some_of,
)
from identification import Array, InputError, JobError, newton_ascent

# (p, p) gradient, tr(G M), and (k, n) postures in the working set -> postures to add (j, n), best first, and the
# largest sensitivity of all that was visited
Stage = Callable[[Array, float, Array], tuple[Array, float]]

SAME = 1e-7  # [rad] postures nearer than this are one
# candidates up to which a solver's one big program works; beyond, Clarabel returns errors and SCS takes gigabytes
LARGEST = {"clarabel": 20_000, "scs": 100_000}


# -- design spaces -----------------------------------------------------------------------------------------------------
class CandidateSet:
    """A finite set of postures (N, n), visited chunk by chunk.

    prior : per new run
    """

    def __init__(self, problem: DesignProblem, postures: Array, prior: PriorInformation) -> None:
        self.problem, self.postures, self.prior = problem, postures, prior

    def sensitivities(self, gradient: Array, give_up: Stop = never) -> Array:
        """(N,) tr(G F); inf, which is no less than the largest, where `give_up`, asked after every chunk, said so."""
        # up to 8192 candidates, whose Jacobians stay in the processor's cache
        size = int(np.clip(250_000 // (self.problem.model.dimension * self.problem.parameters), 1024, 8192))
        values = []
        for start in range(0, len(self.postures), size):
            jacobians = self.problem.scaled_jacobians(self.postures[start : start + size])
            across = jacobians.transpose(1, 2, 0)  # (d, p, k) as `vectorize` has it
            values.append(self.prior.mixed(np.sum((gradient @ across) * across, axis=(0, 1)), gradient))
            if give_up():
                return np.full(len(self.postures), np.inf)
        return np.concatenate(values)

    def price(self, gradient: Array, level: float, _: Array) -> tuple[Array, float]:
        """A pass over all of it: postures to add (j, n), the best of each of many parts of the set, which keeps them
        apart, and the largest g."""
        g = self.sensitivities(gradient)
        size = max(16, -(-len(g) // 256))
        rows = np.array([start + int(np.argmax(g[start : start + size])) for start in range(0, len(g), size)])
        rows, largest = rows[np.argsort(-g[rows], kind="stable")[: 3 * self.problem.parameters]], float(g.max())
        return self.postures[rows[g[rows] > level + 0.1 * max(largest - level, 0.0)]], largest


@dataclass(frozen=True)
class ContinuousSet:
    """All postures within the limits (and constraints) of a problem, and those of the largest sensitivity: multistart
    Newton ascent of d(q) = tr(G F(q)), all starts together, on exact first and second derivatives.

    Constraints are kept by a logarithmic barrier, lowered step by step, so that a climb can follow a wall. What it ends
    at is a numerical maximum; branch and bound makes it a theorem where the model allows.
    also : (k, n) starts beside random ones
    """

    problem: DesignProblem
    prior: PriorInformation
    also: Array | None = None

    @cached_property
    def _derivatives(self) -> Derivatives:
        return self.problem.jacobian_derivatives(range(self.problem.joints))

    def sensitivities(self, postures: Array, gradient: Array) -> Array:
        """(m,) tr(G F(q))."""
        return self.prior.sensitivities(self.problem.scaled_jacobians(postures), gradient)

    def slopes(self, postures: Array, gradient: Array) -> tuple[Array, Array]:
        """(m, n) gradient and (m, n, n) Hessian of tr(G F(q)) with respect to the joint angles."""
        jacobians, first = self._derivatives.first(postures)
        weighted, flat = jacobians @ gradient, first.reshape(*first.shape[:2], -1)
        slope = 2.0 * np.einsum("mx,max->ma", weighted.reshape(len(first), -1), flat)
        hessian = (first @ gradient).reshape(flat.shape) @ np.swapaxes(flat, 1, 2)
        hessian += self._derivatives.bend(postures, weighted)
        return slope / (1.0 + self.prior.runs), 2.0 * hessian / (1.0 + self.prior.runs)

    def drawn(self, count: int, generator: Generator) -> Array:
        """(k, n) feasible postures: anywhere; with each joint at a limit, in the middle of its range or anywhere; and
        of such ones that break constraints some that are moved onto these walls.

        Maxima are narrow where walls meet limits: postures anywhere do not come near them.
        """
        problem, shape = self.problem, (count, self.problem.joints)
        low, high = (np.broadcast_to(limit, shape) for limit in (problem.lower, problem.upper))
        places = np.stack([low, high, 0.5 * (low + high), generator.uniform(low, high)])
        on_faces = np.choose(generator.integers(0, 4, shape), places)
        allowed, anywhere = problem.feasible(on_faces), random_postures(problem, count // 4, generator)
        at_walls = put_inside(problem, on_faces[~allowed][: count // 10])
        return np.concatenate([anywhere, at_walls[problem.feasible(at_walls)], on_faces[allowed]])

    @cached_property
    def starts(self) -> Array:
        """(k, n) of the cheap search."""
        also = [] if self.also is None else [np.atleast_2d(self.also)]
        count = 2000 if self.problem.many_parameters else 8000  # of many a bound is rough
        return np.concatenate([*also, self.drawn(count, np.random.default_rng(0))])

    def best(
        self, gradient: Array, near: Array, generator: Generator | None = None, stop: Stop = never
    ) -> tuple[Array, Array]:
        """Local maxima (k, n) of tr(G F(q)) and their values (k,), best first.

        Starts are `near` (j, n) and the best of `starts`; with a generator, a search as thorough as is affordable: the
        best of many fresh postures, and others whatever their value, for a high maximum may be narrow.
        `stop` ends the climb on its way.
        """
        pool, climbers = (self.starts, 64) if generator is None else (self.drawn(30_000, generator), 256)
        others = pool[:0] if generator is None else generator.choice(pool, 64)
        promising = pool[np.argsort(-self.sensitivities(pool, gradient))[:climbers]]
        postures = self.climb(np.concatenate([near, promising, others]), gradient, stop)
        values = self.sensitivities(postures, gradient)
        order = np.argsort(-values)
        order = order[distinct(self.problem.comparable(postures[order]))]
        return postures[order], values[order]

    def price(
        self, gradient: Array, level: float, near: Array, generator: Generator | None = None, stop: Stop = never
    ) -> tuple[Array, float]:
        """The best of them that are above the level, and the largest value."""
        postures, values = self.best(gradient, near, generator, stop)
        # a posture this near to a better one differs in value by a small part of the gap: one of the two is enough
        reach = 0.2 * np.sqrt(max(values[0] / level - 1.0, 0.0))  # [rad], the root of the relative gap
        apart = distinct(self.problem.comparable(postures), reach)[: 10 * self.problem.parameters]
        return postures[apart[values[apart] > level]], float(values[0])

    def climb(self, postures: Array, gradient: Array, stop: Stop = never) -> Array:
        """Every posture moved uphill to a local maximum within limits and constraints, of tr(G F(q)) + barrier * sum of
        log margins."""
        problem, walls, q = self.problem, self.problem.walls, self.problem.clip(postures)
        kind, barrier = np.arange(len(q)) % 2, np.zeros(len(q))

        def height(postures: Array, rows: NDArray[np.intp]) -> Array:
            margins = walls.values(postures)
            inside = np.all(margins > 0.0, axis=1)
            logarithms = np.log(np.where(inside[:, None], margins, 1.0)).sum(axis=1)
            return np.where(inside, self.sensitivities(postures, gradient) + barrier[rows] * logarithms, -np.inf)

        def slopes(postures: Array, rows: NDArray[np.intp]) -> tuple[Array, Array]:
            slope, hessian = self.slopes(postures, gradient)
            margins, first = walls.first(postures)
            relative, each = first / margins[:, None], barrier[rows, None]
            bend = walls.bend(postures, 1.0 / margins) - relative @ np.swapaxes(relative, 1, 2)
            return slope + each * relative.sum(axis=2), hessian + each[..., None] * bend

        # heights of the barrier, relative to the largest sensitivity: a low one first keeps a start near its own walls,
        # where the narrow maxima are, a high one lets it leave a dead end; every second start climbs with the other
        heights = np.array([(1e-3, 1e-6, 1e-9), (1e-5, 1e-7, 1e-9)]) if problem.constraints else np.zeros((2, 1))
        limits = problem.lower, problem.upper
        for pair in float(np.abs(self.sensitivities(q, gradient)).max(initial=0.0)) * heights.T:
            barrier = pair[kind]
            q = newton_ascent(q, height, slopes, limits, problem.joint_units, 1e-3 * barrier, stop)
            if problem.constraints:
                # most starts share a maximum; of those within 1e-6 rad that came by the same barriers one climbs on
                apart = distinct(np.column_stack([problem.comparable(q), kind.astype(float)]), 1e-6)
                q, kind = q[apart], kind[apart]
        return q


def distinct(postures: Array, tolerance: float = SAME) -> NDArray[np.intp]:
    """Indices of postures of which no earlier one is within `tolerance` [rad] in every joint."""
    first = np.ones(len(postures), dtype=bool)
    for k, posture in enumerate(postures):
        if first[k]:
            first[k + 1 :] &= np.abs(postures[k + 1 :] - posture).max(axis=1) > tolerance
    return np.flatnonzero(first)


# -- optimal designs over them -----------------------------------------------------------------------------------------
def column_generation(
    problem: DesignProblem, candidates: Array, *, runs: int | None = None, tolerance: float = 1e-9, stop: Stop = never
) -> ApproximateDesign:
    """Optimal weights over a finite candidate set (N, n) of any size.

    tolerance : gap max g - tr(G M), relative to tr(G M), at which to stop
    runs : number of new runs, needed where the problem keeps measured postures
    stop : asked before every pricing; the bound is then that of the weights so far, after a pass over all candidates,
        unless that takes longer than the search did, and than 2 s
    Raises JobError where the candidates do not identify all parameters.
    """
    began, prior = perf_counter(), problem.prior.per_new_run(runs)
    rough = tolerance >= 1e-2 and problem.criterion.name != "E"  # for hundreds of parameters
    # E-optimal weights come from a semidefinite program, which is less accurate than Newton's method
    goal = 2.0 * tolerance if rough else max(tolerance, 1e-6) if problem.criterion.name == "E" else tolerance
    sample, start, everything = 20_000, candidates, CandidateSet(problem, candidates, prior)
    stages: list[Stage] = [everything.price]
    if len(candidates) > 4 * sample:  # some of very many are priced first
        goal = max(goal, 1e-6) if problem.many_parameters else goal  # a pass takes seconds
        start = some_of(candidates, sample)
        stages = [CandidateSet(problem, start, prior).price, everything.price]
    # rough weights are of many candidates at once: four million entries of their Jacobians, 2000 candidates at least
    most = max(2000, 4_000_000 // (problem.model.dimension * problem.parameters)) if rough else 6 * problem.parameters
    design, _ = generate_columns(problem, prior, some_of(start, most), stages, goal, tolerance, stop)
    now = perf_counter()
    end = now + max(2.0, now - began)
    g = everything.sensitivities(design.gradient, lambda: perf_counter() > end and stop())
    solved, which = goal if rough else 10.0 * goal, {"candidates": len(candidates), "rigorous": True}
    return design.certified(float(g.max()), solved, cut=stop(), seconds=perf_counter() - began, **which)


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
    stop : asked before every pricing; the bound is then that of the weights so far, after a thorough search
    """
    began, prior, many = perf_counter(), problem.prior.per_new_run(runs), problem.many_parameters
    tolerance = max(tolerance, 1e-6) if problem.criterion.name == "E" else tolerance
    everything, generator = ContinuousSet(problem, prior, also), np.random.default_rng(0)
    stages: list[Stage] = [partial(everything.price, generator=generator, stop=stop)]
    if not many:
        start = some_of(everything.starts, 6 * problem.parameters)
        stages = [partial(everything.price, stop=stop), *stages]
    elif also is None:  # a long plan that was climbed on gradients: nearly the support of the best weights
        anywhere = random_postures(problem, 3 * problem.parameters, np.random.default_rng(0))
        start = PlanAscent(problem, runs or len(anywhere))(anywhere, stop=stop)
    else:
        start = also
    rigorous, goal = False, max(tolerance, proof)
    jacobians = trigonometric_jacobian(problem) if proof > 0.0 and not problem.constraints and not stop() else None
    for _ in range(20):  # attempts, each with a posture that the multistart has missed
        design, gap = generate_columns(problem, prior, start, stages, tolerance, tolerance, stop)
        thorough = generator if stop() and not many else None
        largest = max(design.level + gap, everything.best(design.gradient, design.plan.postures, thorough)[1][0])
        if jacobians is None or stop():
            break
        factor, constant = 1.0 / (1.0 + prior.runs), float(prior.mixed(0.0, design.gradient))
        polynomial = TrigonometricPolynomial.of_sensitivity(jacobians, design.gradient, factor, constant)
        close, tried = goal * abs(design.level), design.plan.postures
        top = maximum(polynomial, problem.lower, problem.upper, tried=tried, tolerance=close, stop=stop)
        largest, rigorous = max(largest, top.value), top.proven
        if not top.proven or top.value <= design.level + close:
            largest = top.upper if top.proven else largest
            break
        start = np.concatenate([tried, top.posture[None]])
    return design.certified(float(largest), 10.0 * goal, cut=stop(), seconds=perf_counter() - began, rigorous=rigorous)


def generate_columns(
    problem: DesignProblem,
    prior: PriorInformation,
    start: Array,
    stages: Sequence[Stage],
    goal: float,
    tolerance: float,
    stop: Stop = never,
) -> tuple[ApproximateDesign, float]:
    """Optimal weights, and the gap (absolute) that the last stage found; -inf where `stop` came first.

    goal : gap (relative) at which to stop;  tolerance : of the gap, for which weights are as accurate as needed
    Raises `JobError` where the postures to start from (k, n) do not identify all parameters.
    """
    criterion, comparable = problem.criterion, problem.comparable
    accuracy = EXACT if tolerance <= 1e-6 else tolerance * (1e-4 if tolerance < 1e-2 else 1.0)
    postures, jacobians = start, problem.scaled_jacobians(start)
    weights = np.full(len(jacobians), 1.0 / len(jacobians))
    equal = prior.mixture(jacobians, weights)
    if not np.isfinite(criterion.value(equal)):
        check_distinct(problem, "approximate design")
        raise JobError(
            "approximate design: the information matrix is singular on these postures, the parameters cannot all "
            "be identified; drop an effect or allow more postures"
        )
    gradient, gap, smallest = criterion.gradient(equal), -np.inf, np.inf  # equal weights prove a bound too
    for _ in range(200):
        if stop():  # weights take seconds where parameters are many
            gap = -np.inf
            break
        weights, gradient = optimal_weights(jacobians, criterion, prior, accuracy, stop)
        level = float(np.sum(gradient * prior.mixture(jacobians, weights)))
        for price in stages:
            offers, largest = price(gradient, level, postures)
            gap = largest - level
            new = [np.abs(comparable(postures) - offer).max(axis=1).min() > SAME for offer in comparable(offers)]
            if gap > goal * abs(level) and any(new):  # else rounding leaves the gap
                break
        else:
            break
        # dropping postures although the gap has not shrunk can go in circles, never dropping any takes for ever
        if len(postures) > 30 * problem.parameters or gap < 0.9 * smallest:
            # an interior point leaves every posture a little, as much as it is accurate: that is no weight
            weights = sparsest(jacobians, np.where(weights > 10.0 * min(accuracy, 1e-6), weights, 0.0))
            postures, jacobians, weights = postures[weights > 0.0], jacobians[weights > 0.0], weights[weights > 0.0]
        smallest, offers = min(smallest, gap), offers[new]
        offers = offers[distinct(comparable(offers))]
        postures = np.concatenate([postures, offers])
        jacobians = np.concatenate([jacobians, problem.scaled_jacobians(offers)])
        weights = np.concatenate([weights, np.zeros(len(offers))])
    dual = gradient if criterion.name == "E" else None
    return ApproximateDesign.heaviest_first(problem, prior, postures, sparsest(jacobians, weights), dual), gap


# -- the door ----------------------------------------------------------------------------------------------------------
def relax(
    problem: DesignProblem,
    candidates: int | ArrayLike,
    solver: str = "column_generation",
    *,
    runs: int | None = None,
    stop: Stop = never,
) -> ApproximateDesign:
    """Optimal weights over candidate postures, with a certificate recomputed from the weights.

    candidates : levels per joint of a grid from limit to limit, or (N, n) postures [rad]
    solver : `column_generation`, or independent of it, for not too many candidates (`LARGEST`), `clarabel` or `scs`
    runs : number of new runs, needed where the problem keeps measured postures
    stop : asked now and then by column_generation; the bound holds where it ended the search early
    Raises InputError for an unknown solver, too many candidates for it, no feasible candidate; JobError where the
    solver returns no weights.
    """
    InputError.check_names("solver: unknown name", [solver], (*LARGEST, "column_generation"))
    if isinstance(candidates, int | np.integer):
        chosen = grid(problem, int(candidates))
    else:
        chosen = listed_candidates(problem, np.asarray(candidates, dtype=float))
    try:
        if solver == "column_generation":
            return column_generation(problem, chosen, runs=runs, tolerance=0.01 if problem.missing else 1e-9, stop=stop)
        larger = "solver column_generation works at this size"
        if len(chosen) > LARGEST[solver]:
            allowed = f"up to {LARGEST[solver]}, where one big program still works"
            raise InputError(f"candidates: {len(chosen)} for solver {solver}, allowed: {allowed}; {larger}")
        began, prior = perf_counter(), problem.prior.per_new_run(runs)
        each = prior.information(information_of_each(problem.scaled_jacobians(chosen)))
        weights, ended, dual = solve_program(each, problem.criterion, solver)
        if weights is None:
            raise JobError(f"{solver}: status {ended} on {len(chosen)} candidates, no weights; {larger}")
        carried = np.where(weights > 1e-7, weights, 0.0)  # interior points give every posture a little
        design = ApproximateDesign.heaviest_first(problem, prior, chosen, carried, dual)
        largest = float(CandidateSet(problem, chosen, prior).sensitivities(design.gradient).max())
        which = {"candidates": len(chosen), "rigorous": True, "solver": solver, "solver_status": ended}
        # convention: solved to 1e-3, of D an efficiency of .999 at least
        return design.certified(largest, 1e-3, cut=False, seconds=perf_counter() - began, **which)
    except np.linalg.LinAlgError:
        singular = "the candidates' information is singular to rounding; wider joint limits or fewer effects may help"
        raise JobError(f"{solver}: {singular}") from None


# -- the best bound that is known --------------------------------------------------------------------------------------
def best_known_bound(problem: DesignProblem, runs: int, stop: Stop = never) -> Bound | None:
    """The closed form if it applies and is tight, otherwise the lower of it and the numerical bound.

    None where the continuous problem cannot be solved; the bound over a list of choices is the relaxation's. Without a
    joint to choose, every plan has the same value. Where `stop` ends the search early the bound holds all the same.
    """
    closed = closed_form_bound(problem)
    if closed is not None and not problem.constraints and problem.choices is None:
        return closed
    if not problem.searched_joints:
        return Bound(problem.objective(np.tile(problem.lower, (runs, 1))), "continuous", rigorous=True)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            numerical = best_design(problem, runs, stop=stop).bound
    except (JobError, np.linalg.LinAlgError):  # the latter: information that is singular to rounding
        return closed
    return min((bound for bound in (closed, numerical) if bound is not None), key=lambda b: b.value, default=None)


def best_design(
    problem: DesignProblem, runs: int, *, also: Array | None = None, stop: Stop = never
) -> ApproximateDesign:
    """Over the choices, exact, within a percent with a prior over many effects, within 0.001 where many parameters are
    measured by one number a run; or over all postures within limits and constraints, of many parameters within the
    limits alone, which holds too. Where the choices are `sampled` the weights are on them and the bound is over all: a
    tangent holds for every design, given the largest sensitivity, here of a multistart.

    also : (k, n) postures that a search over all must start from;  stop : asked now and then
    """
    many, rough = problem.many_parameters, 1e-3  # relative gap: some seconds instead of half a minute
    if problem.choices is None:
        free, gap = (replace(problem, constraints=()), rough) if many else (problem, 1e-8)
        design = continuous_design(free, runs=runs, tolerance=gap, proof=gap, also=also, stop=stop)
        return replace(design, unconstrained=bool(problem.constraints) and many)
    one_number = rough if many and problem.model.dimension == 1 else 1e-9  # a run: weights hardly settle
    gap = 1e-2 if problem.missing else one_number  # with a prior weights are spread over as many postures
    candidates = listed_candidates(problem, problem.choices)
    listed = column_generation(problem, candidates, runs=runs, tolerance=gap, stop=stop)
    if not problem.sampled or listed.bound is None or stop():
        return listed
    starts = np.concatenate([listed.plan.postures[:16], *([] if also is None else [also])])  # those of most weight
    everything = ContinuousSet(replace(problem, choices=None, sampled=False), listed.prior)
    largest = max(listed.largest, float(everything.best(listed.gradient, starts, stop=stop)[1][0]))
    return listed if stop() else replace(listed, largest=largest, candidates=None, rigorous=False)


def bound_that_holds(
    problem: DesignProblem, bound: Bound | None, postures: Array, value: float, stop: Stop = never
) -> Bound | None:
    """The bound, unless a plan (m, n) with this value beats it: then one that its postures helped to find, or None.

    A numerical bound rests on the largest sensitivity that a search found. A better plan proves that the search missed
    a posture, and one of the plan's own has a greater sensitivity (the criterion is concave).
    """

    def beaten(by: Bound) -> bool:
        return value > by.value + 1e-8 * max(1.0, abs(by.value))  # more than rounding

    if bound is None or not beaten(bound):
        return bound
    try:
        again = best_design(problem, len(postures), also=postures, stop=stop).bound
    except JobError:
        return None
    return None if again is None or beaten(again) else again


def bounds_of_runs(problem: DesignProblem, runs: Sequence[int], stop: Stop = never) -> dict[int, Bound | None]:
    """Number of runs -> bound, None where none was found; looser ones where `stop` ended the search early.

    Designs are made for numbers of runs whose ratios are below the root of two; each bounds all others too.
    """
    if problem.prior.empty and problem.searched_joints:
        return dict.fromkeys(runs, best_known_bound(problem, runs[0], stop))
    if problem.criterion.name == "E" or not problem.searched_joints:  # gradients of its own dual program
        return {m: best_known_bound(problem, m, stop) for m in runs}
    made: list[ApproximateDesign] = []
    steps = 1 + int(np.ceil(2.0 * np.log2(max(runs) / min(runs))))
    try:
        for m in np.unique(np.round(np.geomspace(min(runs), max(runs), steps))).astype(int)[::-1].tolist():
            if made and stop():
                break
            made.append(best_design(problem, m, also=made[-1].plan.postures if made else None, stop=stop))
    except (JobError, np.linalg.LinAlgError):
        return dict.fromkeys(runs)
    tightest = {m: min(made, key=lambda one: one.upper_at(m)) for m in runs}
    return {m: None if d.bound is None else replace(d.bound, value=d.upper_at(m)) for m, d in tightest.items()}
