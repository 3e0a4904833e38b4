"""The D-optimum of the planar base model under joint limits, in closed form, and its Table I conditions.

Theorem (doe/README.md, "Planar theorem"). Over all designs, exact or approximate, with joint j inside a range Delta_j,

    max log det M' = 4 sum_j log sin( min(Delta_j, pi) / 2 )

The sum is over j = 2..n; a base offset adds j = 1. M' is scaled by the best known lengths: any arm has the same value.

Proof.
1. One complex number per link. With w_j = dl_j + i l_j dtheta_j the tip moves by sum_j z_j w_j, z_j = exp(i theta_j)
   (eq. 8 scaled by S). So M' is the real form of the Hermitian H = E conj(z) z^T, of unit diagonal, and
   det M' = (det H)^2. Joint offsets instead of orientation offsets change nothing: dtheta = T dq with det T = 1.
   At a calibrated arm l_j is the calibrated length, in the columns and in S alike. A base offset is a link 0 with
   z_0 = 1, w_0 = x0 + i y0: H has n + 1 rows, p = 2n + 2, and at least n + 1 runs are needed.
2. First off-diagonals. h_j = H_(j-1,j) = E exp(i q_j), the mean of points on an arc of angle Delta_j. The arc's
   convex hull has distance cos(Delta_j / 2) from 0 when Delta_j < pi, and contains 0 otherwise:
   |h_j| >= cos(min(Delta_j, pi) / 2). q_1 turns all of z: it cancels in H unless z_0 = 1 is there, where it gives h_1.
3. Completion. det H <= prod_j (1 - |h_j|^2): det H is det H_(1..n-1) times the squared distance of column z_n from the
   span of all columns before it, which is at most that from z_(n-1) alone, 1 - |h_n|^2. So on, column by column.
   Equality holds when H_(jk) is the product of the h between: z_n less its projection on z_(n-1) is then orthogonal
   to every earlier column too.
4. Attained. Independent joints, each on its two limits with equal weight (Delta_j < pi) or on two angles pi apart
   (Delta_j >= pi), have |h_j| = cos(min(Delta_j, pi)/2) and H_(jk) = prod of the h between. Hence
   1 - |h_j|^2 = sin^2(min(Delta_j, pi)/2), and log det M' = 2 log det H.                                            QED
"""

from __future__ import annotations

from typing import TypeGuard

import numpy as np

from doe.bounds.bound import Bound
from doe.criteria import D
from doe.problem.problem import DesignProblem, InformationModel
from identification.arrays import Array
from identification.errors import InputError
from identification.model import Model


def is_planar(model: InformationModel) -> TypeGuard[Model]:
    """True for the model of a planar arm, the only one of which this module knows anything."""
    return isinstance(model, Model)


def applies(problem: DesignProblem) -> bool:
    """True for criterion D and a planar arm's lengths and joint offsets, with or without a base offset.

    Constraints and a list of allowed postures only shrink the design space: the bound stays valid, not always tight.
    """
    model = problem.model
    return is_planar(model) and model.linear_in_links and isinstance(problem.criterion, D) and not len(problem.kept)


def chain_joints(problem: DesignProblem) -> tuple[int, ...]:
    """Joints (from 0) that play a part: 2..n for people, and joint 1 as well with a base offset."""
    model = problem.model
    offset = is_planar(model) and any(effect.name == "base_offset" for effect in model.effects)
    return tuple(range(0 if offset else 1, problem.joints))


def closed_form_log_det(problem: DesignProblem) -> float:
    """Largest log det M' of any design within the joint limits. Raises `InputError` where `applies` is False."""
    if not applies(problem):
        raise InputError(
            "closed form: this model or criterion has none, allowed: D with lengths, offsets and base_offset"
        )
    joints = list(chain_joints(problem))
    ranges = np.minimum(problem.upper[joints] - problem.lower[joints], np.pi)
    return float(4.0 * np.sum(np.log(np.sin(ranges / 2.0))))


def closed_form_bound(problem: DesignProblem) -> Bound | None:
    """The theorem as a bound, None where it does not apply."""
    return Bound(closed_form_log_det(problem), "closed_form", rigorous=True) if applies(problem) else None


def table_1(postures: Array, weights: Array | None = None) -> dict[tuple[int, int], complex]:
    """Pair (j, k), 1 <= j < k <= n -> mean over the runs of exp(i (q_(j+1) + ... + q_k)) = H_jk.

    All of them vanish exactly when log det M' = 0: Table I for any n. The paper's six sums of four links are right:
    q2, q3, q4, q2+q3, q3+q4 and q2+q3+q4; only the name c_24, s_24 of the last is not, whose indices say q2+q4.
    """
    angles = np.atleast_2d(np.asarray(postures, dtype=float))
    shares = np.full(len(angles), 1.0 / len(angles)) if weights is None else weights
    columns = np.exp(1j * np.cumsum(angles, axis=1))
    gram = columns.conj().T @ (shares[:, None] * columns)
    n = angles.shape[1]
    return {(j + 1, k + 1): complex(gram[j, k]) for j in range(n) for k in range(j + 1, n)}


def pair_name(pair: tuple[int, int]) -> str:
    """The angle of a pair as Table I prints it.

    >>> pair_name((1, 3))
    'q2+q3'
    """
    return "+".join(f"q{joint}" for joint in range(pair[0] + 1, pair[1] + 1))


def table_1_max_residual(postures: Array, weights: Array | None = None) -> float:
    """Largest |H_jk| over all pairs; 0 for a single link, which has no conditions."""
    return max((abs(value) for value in table_1(postures, weights).values()), default=0.0)
