"""The best upper bound that is known for a problem, for one number of runs or many; and a bound that a plan beats.

The certificate of one number of runs bounds all others too (doe/README.md, "Exact plans"). It is tight where it was
made and loose by about the square of the change of log m elsewhere: certificates are added where the lowest is far
above the designs that are known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from doe.bounds.certificate import ApproximateDesign, Bound
from doe.bounds.column_generation import ContinuousSet, column_generation, continuous_design
from doe.bounds.planar_theorem import closed_form_bound
from doe.problem.postures import listed_candidates
from doe.problem.problem import DesignProblem, Stop, never
from identification import Array, JobError


def best_known_bound(problem: DesignProblem, runs: int, stop: Stop = never) -> Bound | None:
    """The closed form if it applies and is tight, otherwise the lower of it and the numerical bound.

    None where the continuous problem cannot be solved; the bound over a list of choices is the relaxation's. Without a
    joint to choose, every plan has the same value. Where `stop` ends the search early the bound holds all the same.
    """
    closed = closed_form_bound(problem)
    if closed is not None and not problem.constraints and problem.choices is None:
        return closed
    closed = None if closed is None else replace(closed, unconstrained=bool(problem.constraints))
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


# -- many numbers of runs ----------------------------------------------------------------------------------------------
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
            also = made[-1].plan.postures if made else None
            made.append(best_design(problem, m, also=also, stop=stop))
    except (JobError, np.linalg.LinAlgError):
        return dict.fromkeys(runs)
    tightest = {m: min(made, key=lambda one: one.upper_at(m)) for m in runs}
    return {m: None if d.bound is None else replace(d.bound, value=d.upper_at(m)) for m, d in tightest.items()}
