"""Is a problem solvable at all? Refusals before a search, and the reason after one that found nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from doe.design import Design
from doe.plan.expected_accuracy import plan_jacobians
from doe.plan.replicate_spacing import allowed_value, replicates_allowed
from doe.problem.postures import listed_candidates, random_postures
from doe.problem.problem import DesignProblem
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
    if every_parameter and (names := problem.without_effect):
        raise JobError(f"design: no plan identifies all {problem.parameters} parameters; {NEUTRAL}: {'; '.join(names)}")
    if begin is None or not problem.feasible(begin).any():
        random_postures(problem, 1, np.random.default_rng(seed))  # raises where the constraints exclude everything


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
        raise JobError(_not_identifiable(design))
    if throw and not np.isfinite(allowed_value(problem, design.plan.postures)):
        apart = f"postures {problem.spacing} apart"
        raise JobError(f"design: no plan within the constraints and with {apart} was found by {design.solver}")
    return design if identified else replace(design, status=Status.not_identifiable)


def _not_identifiable(design: Design) -> str:
    problem, p = design.problem, design.problem.parameters
    message = f"design: no plan that identifies all {p} parameters was found by {design.solver}"
    if problem.choices is None:
        many = np.random.default_rng(0).uniform(problem.lower, problem.upper, (4 * p, problem.joints))
    else:
        many = listed_candidates(problem, problem.choices).postures
    jacobians, names = plan_jacobians(problem, many), problem.model.parameters.names
    aliases = identifiability(jacobians, names, np.ones(p)).combinations
    if not aliases:
        return message
    if problem.choices is not None:
        return f"design: the {len(many)} candidates cannot identify all {p} parameters, whatever the plan"
    return f"{message}; {NEUTRAL}: {'; '.join(aliases)}"
