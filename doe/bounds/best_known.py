"""The best upper bound that is known for a problem, and what to do with a bound that a plan beats."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.bounds.bound import Bound
from doe.bounds.column_generation import column_generation, continuous_bound
from doe.bounds.multiplicative import POWERS, multiplicative
from doe.bounds.planar_theorem import closed_form_bound
from doe.plan.ascent import WIDE
from doe.problem.candidates import listed
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.errors import JobError
from identification.kinematics.parameters import EFFECT
from identification.threads import single_thread

BEATEN = 1e-8  # relative excess over a bound that is not rounding
EXACT = 1e-8  # relative gap of a bound over all postures
ROUGH = 1e-3  # the same for models of many parameters: some seconds instead of half a minute


def best_known_bound(problem: DesignProblem, runs: int) -> Bound | None:
    """The closed form; without one, or where constraints or a list of postures loosen it, the lower of both.

    None where the continuous problem cannot be solved; the bound over a list of choices is the relaxation's. Without a
    joint to choose, every plan has the same value.
    """
    closed = closed_form_bound(problem)
    if closed is not None and not problem.constraints and problem.choices is None:
        return closed
    if not problem.searched_joints:
        return Bound(problem.objective(np.tile(problem.lower, (runs, 1))), "continuous", rigorous=True)
    try:
        with single_thread():
            found = everywhere(problem, runs) if problem.choices is None else list_bound(problem, runs)
    except (JobError, np.linalg.LinAlgError):  # the latter: information that is singular to rounding
        return closed
    return min((bound for bound in (closed, found) if bound is not None), key=lambda bound: bound.value, default=None)


def everywhere(problem: DesignProblem, runs: int, also: Array | None = None) -> Bound:
    """Over all postures within limits and constraints; of many parameters within the limits alone, which holds too.

    also : (k, n) postures that the search must start from. Raises `JobError` where the optimum was not reached.
    """
    if problem.parameters > WIDE:
        return continuous_bound(replace(problem, constraints=()), runs=runs, tolerance=ROUGH, also=also)
    return continuous_bound(problem, runs=runs, tolerance=EXACT, also=also)


def list_bound(problem: DesignProblem, runs: int) -> Bound | None:
    """Over the choices: exact, within a percent with a prior over many effects."""
    candidates = listed(problem, () if problem.choices is None else problem.choices)
    missing = any(p.kind == EFFECT and p.name in problem.deviations for p in problem.model.parameters)
    if missing and problem.criterion.name in POWERS:
        return multiplicative(problem, candidates, runs=runs).bound
    return column_generation(problem, candidates, runs=runs).bound


def bound_that_holds(problem: DesignProblem, bound: Bound | None, postures: Array, value: float) -> Bound | None:
    """The bound, unless a plan (m, n) with this value beats it: then one that its postures helped to find, or None.

    A numerical bound rests on the largest sensitivity that a search found. A better plan proves that the search missed
    a posture, and one of the plan's own has a greater sensitivity (the criterion is concave).
    """
    if bound is None or not _beats(value, bound):
        return bound
    try:
        again = everywhere(problem, len(postures), also=postures)
    except JobError:
        return None
    return None if _beats(value, again) else again


def _beats(value: float, bound: Bound) -> bool:
    return value > bound.value + BEATEN * max(1.0, abs(bound.value))
