"""Optimal weights by the multiplicative algorithm: for very many parameters, to a gap of a percent.

    w_i  <-  w_i tr(G B_i^T B_i)^power, made to sum to one

S. D. Silvey, D. M. Titterington, B. Torsney (1978); the criterion never falls for D with power 1 and for A and I with
power 1/2 (Y. Yu, "Monotonic convergence of a general algorithm for computing optimal designs", Annals of Statistics 38,
2010). A step costs one pass over the candidates, whatever the number of postures that carry weight: with a prior over
many effects that is hundreds, and the second-order method of `doe.bounds.interior_point` takes minutes. Very many
candidates are weighted in parts: a sample, then the postures of it that carry weight and the best of all others.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from doe.bounds.approximate_design import ApproximateDesign, SparseDesign, certified_design, how_it_ended
from doe.bounds.equivalence import REMEMBERED, last_pass, level
from doe.bounds.pricing import candidate_price
from doe.bounds.restricted_master import check_identified
from doe.plan.plan import Plan
from doe.problem.candidates import Candidates, well_spread
from doe.problem.prior import PriorInformation
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array
from identification.errors import InputError
from identification.vectorize import PART

GAP = 0.01  # relative gap at which to stop: the bound is within as much of the optimum
ITERATIONS = 2000
POWERS = {"D": 1.0, "A": 0.5, "I": 0.5}
SAMPLE = 2000  # candidates that are weighted at once however many parameters there are
CARRIED = 1e-6  # weight, relative to the largest, below which a posture is left out


def multiplicative(
    problem: DesignProblem,
    candidates: Candidates,
    *,
    runs: int | None = None,
    gap: float = GAP,
    stop: Stop = never,
) -> ApproximateDesign:
    """Weights over a finite candidate set, with a bound that holds whatever the gap.

    runs : number of new runs, needed where anything is known beforehand;  stop : asked after every step
    Raises `InputError` for a criterion other than D, A and I, `JobError` where the candidates do not identify all
    parameters.
    """
    began = perf_counter()
    if problem.criterion.name not in POWERS:
        raise InputError(f"criterion: {problem.criterion.name} for solver multiplicative, allowed: D, A, I")
    prior, working = problem.prior.per_new_run(runs), well_spread(candidates, _most(problem))
    while True:
        found = weighted(problem, prior, working, gap, stop)
        give_up = last_pass(stop, began)
        offers, largest = candidate_price(problem, candidates, prior, give_up)(found.gradient, found.level, working)
        solved = largest - found.level <= 2.0 * gap * abs(found.level)  # postures were left out
        if solved or stop() or len(working) == len(candidates):
            break
        working = np.unique(np.concatenate([found.plan.postures, offers]), axis=0)
    status, in_words = how_it_ended(largest, solved=solved, cut=stop())
    return certified_design(
        found,
        largest,
        candidates=len(candidates),
        rigorous=True,
        status=status,
        solver="multiplicative",
        solver_status=in_words,
        seconds=perf_counter() - began,
    )


def _most(problem: DesignProblem) -> int:
    """Candidates that are weighted at once; of more than that a sample, and those that a pass over all offers."""
    return max(SAMPLE, REMEMBERED // (problem.model.dimension * problem.parameters))


def weighted(
    problem: DesignProblem, prior: PriorInformation, postures: Array, gap: float, stop: Stop = never
) -> SparseDesign:
    """Weights on postures (k, n) to a relative gap among them, heaviest first; those that carry nothing are left out.

    Raises `JobError` where the postures do not identify all parameters.
    """
    jacobians = in_rows(problem, postures)
    check_identified(problem, prior, jacobians)
    weights = improved_weights(problem, prior, jacobians, gap, stop)
    kept = np.flatnonzero(weights > CARRIED * weights.max())
    kept = kept[np.argsort(-weights[kept], kind="stable")]
    plan = Plan(postures[kept], weights[kept] / weights[kept].sum(), problem.model.joint_types)
    return SparseDesign(problem, prior, plan)


def improved_weights(
    problem: DesignProblem, prior: PriorInformation, jacobians: Array, gap: float, stop: Stop = never
) -> Array:
    """(k,) weights on scaled Jacobians (k, d, p) from equal ones, until max tr(G F) is within `gap` of tr(G M)."""
    k, d, p = jacobians.shape
    parts = [slice(start, start + PART) for start in range(0, k, PART)]
    power, weights = POWERS[problem.criterion.name], np.full(k, 1.0 / k)
    for _ in range(ITERATIONS):
        information = prior.information(
            sum((_weighted(jacobians[part], weights[part]) for part in parts), np.zeros(()))
        )
        gradient = problem.criterion.gradient(information)
        rows = (jacobians[part].reshape(-1, p) for part in parts)
        own = np.concatenate([np.einsum("ia,ia->i", some @ gradient, some) for some in rows])
        own = own.reshape(k, d).sum(axis=1)
        if prior.mixed(own, gradient).max() <= (1.0 + gap) * level(gradient, information) or stop():
            break
        weights = weights * own**power
        weights /= weights.sum()
    return weights


def _weighted(jacobians: Array, weights: Array) -> Array:
    """(p, p) sum of w B^T B of scaled Jacobians (k, d, p)."""
    rows = jacobians.reshape(-1, jacobians.shape[2])
    return np.asarray((rows * np.repeat(weights, jacobians.shape[1])[:, None]).T @ rows)


def in_rows(problem: DesignProblem, postures: Array) -> Array:
    """(k, d, p) scaled Jacobians of postures (k, n), the entries of a posture side by side in memory."""
    found = np.empty((len(postures), problem.model.dimension, problem.parameters))
    for start in range(0, len(postures), PART):
        found[start : start + PART] = problem.scaled_jacobians(postures[start : start + PART])
    return found
