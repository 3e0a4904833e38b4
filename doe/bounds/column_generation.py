"""Column generation: optimal weights on few postures, priced against very many, or against all of the joint box.

The loop is in `doe.bounds.restricted_master`, the searches for postures in `doe.bounds.pricing`. Here they are put
together, with the certificate at the end: on the plan that is reported, proven by `doe.bounds.branch_and_bound` where
the model allows.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from doe.bounds.approximate_design import ApproximateDesign, SparseDesign, certified_design, how_it_ended
from doe.bounds.bound import Bound
from doe.bounds.branch_and_bound import maximum
from doe.bounds.continuous import ContinuousSet
from doe.bounds.equivalence import largest_sensitivity, last_pass
from doe.bounds.pricing import Shortlist, candidate_price, continuous_price
from doe.bounds.restricted_master import Stage, generate_columns
from doe.bounds.trigonometric import TrigonometricJacobian, trigonometric_jacobian
from doe.plan.ascent import PlanAscent
from doe.problem.candidates import Candidates, PostureList, well_spread
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array
from identification.errors import JobError

SAMPLE = 20_000  # of very many candidates, which are priced first
COARSE = 1e-4  # relative gap at which pricing goes on to the next, larger set
FINE = 1e-6  # the same, before the first thorough search
MILLIONTH = 1e-6  # relative gap for very many candidates and many parameters: a pass takes seconds
SEMIDEFINITE = 1e-6  # relative gap that a semidefinite program reaches reliably
LONG = 3  # postures per parameter of that plan
PROOFS = 20  # attempts, each with a posture more that was missed
MOST_BOXES = 8_000  # of branch and bound; about a second


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
    began = perf_counter()
    prior = problem.prior.per_new_run(runs)
    tolerance = _attainable(problem, tolerance)
    stages = [Stage(candidate_price(problem, candidates, prior), tolerance)]
    if len(candidates) > 4 * SAMPLE:
        tolerance = max(tolerance, MILLIONTH) if problem.many_parameters else tolerance
        sample, few = PostureList(well_spread(candidates, SAMPLE)), Shortlist(problem, candidates, prior)
        first = Stage(candidate_price(problem, sample, prior), max(COARSE, tolerance))
        stages = [first, Stage(few.best, tolerance), Stage(few.everything, tolerance, back=1)]
    start = well_spread(candidates, 6 * problem.parameters)
    ended, _ = generate_columns(problem, prior, start, stages, stop)
    largest = largest_sensitivity(problem, candidates, ended.gradient, prior, last_pass(stop, began))
    return with_certificate(ended, largest, len(candidates), tolerance, began, rigorous=True, cut=stop())


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
    began = perf_counter()
    prior = problem.prior.per_new_run(runs)
    tolerance = _attainable(problem, tolerance)
    everything = ContinuousSet(problem, prior, also)
    if problem.many_parameters:
        stages = [Stage(continuous_price(everything, np.random.default_rng(0), stop), tolerance)]
        start = climbed(problem, runs, stop) if also is None else also
    else:
        stages = ascents(everything, tolerance, stop)
        starts = PostureList(everything.starts)
        stages.insert(0, Stage(candidate_price(problem, starts, prior), COARSE))
        start = well_spread(starts, 6 * problem.parameters)
    ended, gap = generate_columns(problem, prior, start, stages, stop)
    thorough = np.random.default_rng(0) if stop() and not problem.many_parameters else None
    largest = max(ended.level + gap, float(everything.best(ended.gradient, ended.plan.postures, thorough)[1][0]))
    jacobians = trigonometric_jacobian(problem) if proof > 0.0 and not problem.constraints else None
    rigorous = False
    if jacobians is not None and not stop():
        proof, climbs_on = max(tolerance, proof), ascents(everything, tolerance)
        ended, largest, rigorous = prove(everything, jacobians, ended, largest, climbs_on, proof, stop)
    return with_certificate(ended, largest, None, max(tolerance, proof), began, rigorous=rigorous, cut=stop())


def climbed(problem: DesignProblem, runs: int | None, stop: Stop = never) -> Array:
    """(k, n) postures of a long plan that was climbed on gradients: nearly the support of the best weights."""
    postures = random_postures(problem, LONG * problem.parameters, np.random.default_rng(0))
    return PlanAscent(problem, runs or len(postures))(postures, stop=stop)


def ascents(everything: ContinuousSet, tolerance: float, stop: Stop = never) -> list[Stage]:
    """The pricing stages: a cheap multistart, then a thorough one, to a relative gap of `tolerance`."""
    climb = continuous_price(everything, stop=stop)
    thorough = continuous_price(everything, np.random.default_rng(0), stop)
    return [
        Stage(climb, max(FINE, tolerance)),
        Stage(thorough, max(COARSE, tolerance), back=1),
        Stage(climb, tolerance),
        Stage(thorough, tolerance, back=1),
    ]


def continuous_bound(problem: DesignProblem, *, runs: int | None = None, tolerance: float = 1e-8) -> Bound:
    """No design within limits and constraints is better: a theorem where `rigorous` is True, else numerical.

    Raises JobError where the optimum was not reached.
    """
    design = continuous_design(problem, runs=runs, tolerance=tolerance, proof=tolerance)
    if design.bound is None:
        raise JobError(f"continuous bound: {design.status.name}, gap {design.gap:.2g}; {design.status.value}")
    return design.bound


def _attainable(problem: DesignProblem, tolerance: float) -> float:
    """E-optimal weights come from a semidefinite program, which is less accurate than Newton's method."""
    return max(tolerance, SEMIDEFINITE) if problem.criterion.name == "E" else tolerance


def prove(
    everything: ContinuousSet,
    jacobians: TrigonometricJacobian,
    ended: SparseDesign,
    largest: float,
    stages: Sequence[Stage],
    tolerance: float,
    stop: Stop = never,
) -> tuple[SparseDesign, float, bool]:
    """Branch and bound on the sensitivity; a posture that the multistart missed starts the loop again.

    Returns the design, its largest sensitivity, and whether that is proven.
    """
    problem, prior = everything.problem, everything.prior
    for _ in range(PROOFS):
        constant = float(prior.mixed(np.zeros(()), ended.gradient))
        polynomial = jacobians.sensitivity(ended.gradient, prior.new_fraction, constant)
        close, known = tolerance * abs(ended.level), ended.plan.postures
        box = problem.lower, problem.upper
        found = maximum(polynomial, *box, known=known, tolerance=close, most_boxes=MOST_BOXES, stop=stop)
        largest = max(largest, found.value)
        if not found.proven:
            return ended, largest, False
        if found.value <= ended.level + close:
            return ended, found.upper, True
        start = np.concatenate([known, found.posture[None]])
        ended, gap = generate_columns(problem, prior, start, stages, stop)
        largest = ended.level + gap
    return ended, found.upper, True


def with_certificate(
    ended: SparseDesign,
    largest: float,
    candidates: int | None,
    tolerance: float,
    began: float,
    *,
    rigorous: bool,
    cut: bool = False,
) -> ApproximateDesign:
    """The certificate: `largest` >= max tr(G F) over the design space."""
    solved = largest - ended.level <= 10.0 * tolerance * abs(ended.level)
    status, in_words = how_it_ended(largest, solved=solved, cut=cut)
    return certified_design(
        ended,
        largest,
        candidates=candidates,
        rigorous=rigorous,
        status=status,
        solver="column_generation",
        solver_status=in_words,
        seconds=perf_counter() - began,
    )
