"""`relax`: optimal weights over candidate postures, by column generation or as one convex program.

The value and the bound are recomputed from the weights, whoever computed them; a solver's own numbers are not used.
"""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.approximate_design import ApproximateDesign
from doe.bounds.column_generation import column_generation, rough_design
from doe.bounds.convex_program import solve_program
from doe.bounds.equivalence import largest_sensitivity
from doe.bounds.weights import proper_weights
from doe.problem.postures import Candidates, Grid, PostureList, grid, listed_candidates
from doe.problem.problem import DesignProblem, PriorInformation, Stop, never
from identification.errors import InputError, JobError, nearest
from identification.status import Status

# candidates up to which a solver's one big program works; beyond, Clarabel returns errors and SCS takes gigabytes
LARGEST = MappingProxyType({"clarabel": 20_000, "scs": 100_000})
OWN = MappingProxyType({"column_generation": column_generation, "multiplicative": rough_design})
CARRIED = 1e-7  # weight below which a posture is left out of the support; interior points give every posture a little
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
        return _one_program(problem, chosen, solver, problem.prior.per_new_run(runs))
    except np.linalg.LinAlgError:
        singular = "the candidates' information is singular to rounding; wider joint limits or fewer effects may help"
        raise JobError(f"{solver}: {singular}") from None


def _one_program(
    problem: DesignProblem, candidates: Candidates, solver: str, prior: PriorInformation
) -> ApproximateDesign:
    if len(candidates) > LARGEST[solver]:
        allowed = f"up to {LARGEST[solver]}, where one big program still works"
        raise InputError(
            f"candidates: {len(candidates)} for solver {solver}, allowed: {allowed}; solver column_generation works at "
            "this size"
        )
    began, postures = perf_counter(), candidates.take(np.arange(len(candidates)))
    jacobians = problem.scaled_jacobians(postures)
    weights, solver_status, dual = solve_program(prior.posture_information(jacobians), problem.criterion, solver)
    if weights is None:
        raise JobError(
            f"{solver}: status {solver_status} on {len(candidates)} candidates, no weights; solver column_generation "
            "works at this size"
        )
    weights = proper_weights(weights)
    design = ApproximateDesign.heaviest_first(problem, prior, postures, np.where(weights > CARRIED, weights, 0.0), dual)
    return replace(
        design,
        largest=largest_sensitivity(problem, candidates, design.gradient, prior),
        candidates=len(candidates),
        rigorous=True,
        status=STATUS.get(solver_status, Status.solver_failed),
        solver=solver,
        solver_status=solver_status,
        seconds=perf_counter() - began,
    )
