"""`relax`: optimal weights over candidate postures, by column generation or as one convex program.

The value and the bound are recomputed from the weights, whoever found them; a solver's own numbers are not used.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.approximate_design import ApproximateDesign, SparseDesign, certified_design
from doe.bounds.column_generation import column_generation
from doe.bounds.convex_program import solve_program
from doe.bounds.equivalence import largest_sensitivity
from doe.bounds.multiplicative import multiplicative
from doe.bounds.weights import proper_weights
from doe.plan.plan import Plan
from doe.problem.candidates import Candidates, PostureList, chunks, grid, listed_candidates
from doe.problem.candidates import Grid as CandidateGrid
from doe.problem.prior import PriorInformation
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array
from identification.errors import InputError, JobError, nearest
from identification.status import Status

# candidates up to which a solver's one big program works; beyond, Clarabel returns errors and SCS takes gigabytes
LARGEST = MappingProxyType({"clarabel": 20_000, "scs": 100_000})
SOLVERS = (*LARGEST, "column_generation")
ROUGH = "multiplicative"  # to a gap of a percent only, but for hundreds of parameters
CARRIED = 1e-7  # weight below which a posture is left out of the support; interior points give every posture a little
STATUS = MappingProxyType(
    {
        "optimal": Status.converged,
        "optimal_inaccurate": Status.almost_solved,
        "user_limit": Status.iteration_limit,
    }
)


SINGULAR = "the candidates' information is singular to rounding; wider joint limits or fewer effects may help"


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
    if solver not in (*SOLVERS, ROUGH):
        raise InputError(f"solver: unknown name {solver!r}, {nearest(solver, (*SOLVERS, ROUGH))}")
    chosen = candidate_set(problem, candidates)
    try:
        return _relaxed(problem, chosen, solver, runs, stop)
    except np.linalg.LinAlgError:
        raise JobError(f"{solver}: {SINGULAR}") from None


def _relaxed(
    problem: DesignProblem, chosen: Candidates, solver: str, runs: int | None, stop: Callable[[], bool]
) -> ApproximateDesign:
    if solver == "column_generation":
        return column_generation(problem, chosen, runs=runs, stop=stop)
    if solver == ROUGH:
        return multiplicative(problem, chosen, runs=runs, stop=stop)
    if len(chosen) > LARGEST[solver]:
        raise InputError(
            f"candidates: {len(chosen)} for solver {solver}, allowed: up to {LARGEST[solver]}, where one big program "
            "still works; solver column_generation works at this size"
        )
    return _one_program(problem, chosen, solver, problem.prior.per_new_run(runs))


def candidate_set(problem: DesignProblem, candidates: int | ArrayLike | Candidates) -> Candidates:
    """`Candidates` from the levels of a grid, from a list of postures, or unchanged."""
    if isinstance(candidates, CandidateGrid | PostureList):
        return candidates
    if isinstance(candidates, int | np.integer):
        return grid(problem, int(candidates))
    return listed_candidates(problem, np.asarray(candidates, dtype=float))


def _one_program(
    problem: DesignProblem, candidates: Candidates, solver: str, prior: PriorInformation
) -> ApproximateDesign:
    began = perf_counter()
    answer = solve_program(_rows(problem, candidates, prior), problem.criterion, solver)
    if answer.weights is None:
        raise JobError(
            f"{solver}: status {answer.status} on {len(candidates)} candidates, no weights; solver column_generation "
            "works at this size"
        )
    weights = proper_weights(answer.weights)
    support = np.flatnonzero(weights > CARRIED)
    support = support[np.argsort(-weights[support], kind="stable")]
    plan = Plan(candidates.take(support), proper_weights(weights[support]), problem.model.joint_types)
    found = SparseDesign(problem, prior, plan, answer.gradient)
    return certified_design(
        found,
        largest_sensitivity(problem, candidates, found.gradient, prior),
        candidates=len(candidates),
        rigorous=True,
        status=STATUS.get(answer.status, Status.solver_failed),
        solver=solver,
        solver_status=answer.status,
        seconds=perf_counter() - began,
    )


def _rows(problem: DesignProblem, candidates: Candidates, prior: PriorInformation) -> Array:
    """(N, p (p + 1) / 2) upper triangles of every F_i."""
    upper = np.triu_indices(problem.parameters)
    rows = np.empty((len(candidates), len(upper[0])))
    for index, postures in chunks(candidates, 1024):
        rows[index] = prior.posture_information(problem.scaled_jacobians(postures))[:, upper[0], upper[1]]
    return rows
