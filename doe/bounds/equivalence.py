"""Is a plan optimal? The equivalence theorem and the bounds that follow from it, independent of every solver.

A design w is optimal over a set Q of postures exactly when max_(q in Q) tr(G B(q)^T B(q)) = tr(G M(w)), with G the
gradient of the criterion at M(w) and B the scaled Jacobian (d, p) of a posture, whose d coordinates are indivisible
(doe/README.md, "Equivalence theorem"). For D, G = M^-1 and the right side is p. From any design, optimal or not, the
maximum gives an upper bound for every other one, exact plans of any number of runs included.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from doe.bounds.bound import Bound
from doe.problem.problem import DesignProblem
from identification.arrays import Array

CERTIFIED = 1.0 - 1e-6  # efficiency from which a plan is called optimal (identification/files/README.md, "JSON keys")
REACHED = 1.0 - 1e-9  # efficiency from which searching on cannot matter
ROUNDING = 1e-12  # by which an efficiency may exceed 1 where value and bound are the same number but for rounding


def without_rounding(efficiency: float) -> float:
    """An efficiency, 1 where only rounding makes it greater; a real excess over a bound stays."""
    return 1.0 if 1.0 < efficiency <= 1.0 + ROUNDING else efficiency


def sensitivity(problem: DesignProblem, information: Array, postures: ArrayLike) -> Array:
    """(m,) tr(G B^T B) of postures (m, n), with G the criterion's gradient at the design's information matrix."""
    gradient = problem.criterion.gradient(information)
    jacobians = problem.scaled_jacobians(postures)
    return np.sum((jacobians @ gradient) * jacobians, axis=(-2, -1))


def mixture_sensitivity(problem: DesignProblem, information: Array, largest: float, runs: int) -> float:
    """The largest tr(G N) of any design N of `runs` new runs, given `largest` >= max_q tr(G B^T B).

    What is known before them has a fixed share: with K from k runs it is (m largest + tr(G K)) / (m + k).
    """
    prior = problem.prior.per_new_run(runs)
    return float(prior.mixed(np.asarray(largest), problem.criterion.gradient(information)))


def gap_and_bound(
    problem: DesignProblem, postures: ArrayLike, largest: float, source: str, weights: Array | None = None
) -> tuple[float, Bound]:
    """What a design proves about all others, given `largest` >= max_q tr(G B^T B) over the design space.

    Returns max tr(G N) - tr(G M), which is zero exactly at an optimum, and the upper bound that follows from it.
    source : of the bound, see `doe.bounds.bound.Bound`
    """
    information = problem.information(postures, weights)
    most = mixture_sensitivity(problem, information, largest, len(np.atleast_2d(postures)))
    level = float(np.sum(problem.criterion.gradient(information) * information))
    return most - level, Bound(problem.criterion.upper_bound(information, most), source)


def gap_on_candidates(
    problem: DesignProblem, postures: ArrayLike, candidates: ArrayLike, weights: Array | None = None
) -> tuple[float, Bound]:
    """`gap_and_bound` on a list of candidates (k, n): the bound holds for designs on these candidates only."""
    information = problem.information(postures, weights)
    largest = float(sensitivity(problem, information, candidates).max())
    return gap_and_bound(problem, postures, largest, "grid", weights)
