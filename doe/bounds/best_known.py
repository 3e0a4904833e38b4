"""The best upper bound that is known for a problem, and what to do with a bound that a plan beats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from doe.bounds.approximate_design import ApproximateDesign, SparseDesign, certified_design
from doe.bounds.bound import Bound
from doe.bounds.column_generation import column_generation, continuous_design
from doe.bounds.continuous import ContinuousSet
from doe.bounds.multiplicative import POWERS, multiplicative
from doe.bounds.planar_theorem import closed_form_bound
from doe.plan.ascent import IN_TIME, WIDE
from doe.problem.candidates import listed_candidates
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.errors import JobError
from identification.threads import single_thread

BEATEN = 1e-8  # relative excess over a bound that is not rounding
EXACT = 1e-8  # relative gap of a bound over all postures
SUPPORT = 64  # of the postures that carry most weight: starts of the search over all postures
ROUGH = 1e-3  # the same for models of many parameters: some seconds instead of half a minute


def best_known_bound(problem: DesignProblem, runs: int, stop: Callable[[], bool] = IN_TIME) -> Bound | None:
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
        with single_thread():
            found = best_design(problem, runs, stop=stop).bound
    except (JobError, np.linalg.LinAlgError):  # the latter: information that is singular to rounding
        return closed
    return min((bound for bound in (closed, found) if bound is not None), key=lambda bound: bound.value, default=None)


def best_design(
    problem: DesignProblem, runs: int, *, also: Array | None = None, stop: Callable[[], bool] = IN_TIME
) -> ApproximateDesign:
    """Over the choices, exact, within a percent with a prior over many effects, within 0.001 where many parameters are
    measured by one number a run; or over all postures within limits and constraints, of many parameters within the
    limits alone, which holds too. Where the choices are `sampled` the weights are on them and the bound is over all.

    also : (k, n) postures that a search over all must start from;  stop : asked now and then
    """
    if problem.choices is not None:
        listed = _over_choices(problem, problem.choices, runs, stop)
        return _over_all(problem, listed, runs, also, stop) if problem.sampled else listed
    wide = problem.parameters > WIDE
    free = replace(problem, constraints=()) if wide else problem
    gap = ROUGH if wide else EXACT
    return continuous_design(free, runs=runs, tolerance=gap, proof=gap, also=also, stop=stop)


def _over_choices(problem: DesignProblem, choices: Array, runs: int, stop: Callable[[], bool]) -> ApproximateDesign:
    candidates = listed_candidates(problem, choices)
    if problem.missing and problem.criterion.name in POWERS:
        return multiplicative(problem, candidates, runs=runs, stop=stop)
    exact = problem.model.dimension > 1 or problem.parameters <= WIDE  # one number a run: weights hardly settle
    options = {} if exact else {"tolerance": ROUGH}
    return column_generation(problem, candidates, runs=runs, stop=stop, **options)


def _over_all(
    problem: DesignProblem, listed: ApproximateDesign, runs: int, also: Array | None, stop: Callable[[], bool]
) -> ApproximateDesign:
    """The weights on the choices, with their bound over all postures: a tangent holds for every design, given the
    largest sensitivity, here of a multistart. Where there is no time for that, with what they prove of the choices."""
    if listed.bound is None or stop():
        return listed
    found = SparseDesign(problem, problem.prior.per_new_run(runs), listed.plan, listed.dual)
    starts = listed.plan.postures[:SUPPORT] if also is None else np.concatenate([also, listed.plan.postures[:SUPPORT]])
    everything = ContinuousSet(replace(problem, choices=None, sampled=False), found.prior)
    largest = max(listed.gap + found.level, float(everything.best(found.gradient, starts, stop=stop)[1][0]))
    if stop():
        return listed
    return certified_design(
        found,
        largest,
        candidates=None,
        rigorous=False,
        status=listed.status,
        solver=listed.solver,
        solver_status=listed.solver_status,
        seconds=listed.seconds,
    )


def bound_that_holds(
    problem: DesignProblem, bound: Bound | None, postures: Array, value: float, stop: Callable[[], bool] = IN_TIME
) -> Bound | None:
    """The bound, unless a plan (m, n) with this value beats it: then one that its postures helped to find, or None.

    A numerical bound rests on the largest sensitivity that a search found. A better plan proves that the search missed
    a posture, and one of the plan's own has a greater sensitivity (the criterion is concave).
    """
    if bound is None or not _beats(value, bound):
        return bound
    try:
        again = best_design(problem, len(postures), also=postures, stop=stop).bound
    except JobError:
        return None
    return None if again is None or _beats(value, again) else again


def _beats(value: float, bound: Bound) -> bool:
    return value > bound.value + BEATEN * max(1.0, abs(bound.value))
