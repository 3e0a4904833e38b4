"""The D-optimum of the planar base model under joint limits, in closed form, and its Table I conditions.

Theorem (doe/README.md, "Planar theorem"). Over all designs, exact or approximate, with joint j inside a range Delta_j,

    max log det M' = 4 sum_j log sin( min(Delta_j, pi) / 2 )

The sum is over j = 2..n; a base offset adds j = 1. M' is scaled by the best known lengths: any arm has the same value.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from doe.bounds.certificate import Bound
from doe.problem.model import offered, offers
from doe.problem.problem import DesignProblem
from identification import Array


def applies(problem: DesignProblem) -> bool:
    """True for criterion D and a planar arm's lengths and joint offsets, with or without a base offset.

    Constraints and a list of allowed postures only shrink the design space: the bound stays valid, not always tight.
    """
    return offers(problem.model, "theorem_joints") and problem.criterion.name == "D" and problem.prior.empty


def closed_form_bound(problem: DesignProblem) -> Bound | None:
    """The theorem as a bound: the largest log det M' of any design within the joint limits; None where it does not
    apply."""
    if not applies(problem):
        return None
    joints = list(offered(problem.model, "theorem_joints", "closed form"))
    ranges = np.minimum(problem.upper[joints] - problem.lower[joints], np.pi)
    value = float(4.0 * np.sum(np.log(np.sin(ranges / 2.0))))
    return Bound(value, "closed_form", True, unconstrained=bool(problem.constraints))


def pair_means(postures: Array, weights: Array | None = None) -> dict[str, complex]:
    """Angle q_(j+1) + ... + q_k, 1 <= j < k <= n, as Table I prints it, `q2+q3` -> mean over the runs of exp(i angle) =
    H_jk.

    All of them vanish if and only if log det M' = 0: Table I for any n. The paper's six sums of four links are right:
    q2, q3, q4, q2+q3, q3+q4 and q2+q3+q4; only the name c_24, s_24 of the last is not, whose indices say q2+q4.
    """
    angles = np.atleast_2d(np.asarray(postures, dtype=float))
    shares = np.full(len(angles), 1.0 / len(angles)) if weights is None else weights
    means = dict[str, complex]()
    for j, k in combinations(range(angles.shape[1]), 2):
        name = "+".join(f"q{joint + 1}" for joint in range(j + 1, k + 1))
        means[name] = complex(shares @ np.exp(1j * angles[:, j + 1 : k + 1].sum(axis=1)))
    return means


def table_1_max_residual(postures: Array, weights: Array | None = None) -> float:
    """Largest |H_jk| over all pairs; 0 for a single link, which has no conditions."""
    return max((abs(value) for value in pair_means(postures, weights).values()), default=0.0)
