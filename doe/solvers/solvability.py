"""Is a problem solvable at all? Refusals before a search, and the reason after one that found nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.design import Design
from doe.plan.expected_accuracy import plan_jacobians
from doe.plan.replicate_spacing import replicates_allowed
from doe.problem.candidates import listed_candidates
from doe.problem.feasible import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.driver import allowed
from identification.arrays import Array
from identification.errors import InputError, JobError
from identification.information import identifiability
from identification.status import Status

NEUTRAL = "under one payload, temperature, time and approach no posture distinguishes"


def check_solvable(
    problem: DesignProblem, runs: int, seed: int, begin: Array | None = None, *, every_parameter: bool
) -> None:
    """Raises where no plan is allowed, or none can identify as many parameters, or `every_parameter`.

    begin : (m, n) a plan to begin with; where it has an allowed posture, none is looked for
    """
    check_runs(problem, runs)
    if every_parameter:
        check_parameters(problem)
    if begin is None or not problem.feasible(begin).any():
        random_postures(problem, 1, np.random.default_rng(seed))  # raises where the constraints exclude everything


def check_runs(problem: DesignProblem, runs: int) -> None:
    """Raises `InputError` for fewer equations than unknowns, and for an invalid number of runs."""
    if isinstance(runs, bool) or not isinstance(runs, int | np.integer):
        raise InputError(f"runs: {runs!r:.40}, allowed: a whole number")
    if runs < problem.fewest_runs:
        raise InputError(
            f"runs: {runs} with {problem.parameters} parameters to identify, allowed: at least {problem.fewest_runs}"
        )
    kept = len(problem.kept)
    if runs + kept > (capacity := most_postures(problem, runs)):
        found = f"{runs + kept} postures {problem.spacing} apart"
        raise InputError(f"runs: {found}, allowed: at most {capacity:.0f} in the limits")


def most_postures(problem: DesignProblem, runs: int) -> float:
    """No more postures than this fit into the joint limits at the minimum distance; infinite where that is zero.

    Boxes of half the distance's side around the postures do not overlap, and one axis holds width / distance + 1.
    """
    alike = replicates_allowed(problem)
    if alike >= runs:
        return np.inf
    joints = list(problem.searched_joints)
    width = problem.comparable(problem.upper - problem.lower)[joints]
    return alike * float(np.prod(np.floor(width / problem.minimum_distance * (1.0 + 1e-9)) + 1.0))


def check_parameters(problem: DesignProblem) -> None:
    """Raises `JobError` where a parameter moves the tip at no posture: no search can help."""
    if names := problem.without_effect:
        raise JobError(f"design: no plan identifies all {problem.parameters} parameters; {NEUTRAL}: {'; '.join(names)}")


def identifies_all(design: Design) -> bool:
    """True if the plan identifies all parameters."""
    return bool(np.isfinite(design.value))


def judged_identifiable(design: Design, *, throw: bool) -> Design:
    """The design, with status `not_identifiable` where the plan does not identify all parameters.

    throw : raise `JobError` with the reason instead, and where the plan is not allowed
    """
    if throw:
        require_solved(design)
    return design if identifies_all(design) else replace(design, status=Status.not_identifiable)


def require_solved(design: Design) -> None:
    """Raises `JobError` with the reason unless the plan is allowed and identifies all parameters."""
    problem = design.problem
    if not identifies_all(design):
        raise JobError(_not_identifiable(design))
    if not allowed(problem, design.plan.postures):
        apart = f"postures {problem.spacing} apart"
        raise JobError(f"design: no plan within the constraints and with {apart} was found by {design.solver}")


def _not_identifiable(design: Design) -> str:
    problem, p = design.problem, design.problem.parameters
    message = f"design: no plan that identifies all {p} parameters was found by {design.solver}"
    if problem.choices is not None:
        many = listed_candidates(problem, problem.choices).postures
        whatever = f"design: the {len(many)} candidates cannot identify all {p} parameters, whatever the plan"
        return whatever if _aliases(problem, many) else message
    many = np.random.default_rng(0).uniform(problem.lower, problem.upper, (4 * p, problem.joints))
    aliases = _aliases(problem, many)
    return f"{message}; {NEUTRAL}: {'; '.join(aliases)}" if aliases else message


def _aliases(problem: DesignProblem, postures: Array) -> tuple[str, ...]:
    """Combinations of parameters that these postures, all together, do not identify."""
    jacobians, names = plan_jacobians(problem, postures), problem.model.parameters.names
    return identifiability(jacobians, names, np.ones(problem.parameters)).combinations
