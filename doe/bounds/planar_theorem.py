"""The D-optimum of the planar base model under joint limits, in closed form, and its Table I conditions; and plans that
attain it, where joint limits and the number of runs allow any: no search.

Theorem (doe/README.md, "Planar theorem"). Over all designs, exact or approximate, with joint j inside a range Delta_j,

    max log det M' = 4 sum_j log sin( min(Delta_j, pi) / 2 )

The sum is over j = 2..n; a base offset adds j = 1. M' is scaled by the best known lengths: any arm has the same value.

*Plans.* Number the b runs of one by the elements of a group Z_2^t x Z_(b / 2^t), and write z_j in C^b for the column of
exp(i theta_j). The bound is attained where every new column, less its projection on its neighbor, is orthogonal to all
columns so far. Going from any link to the left or to the right,

- *wide* joint (range pi or more): the new column itself is orthogonal. It is tried as a character times any earlier
  column, and taken where the angles it asks of the joint fit into the range; their common phase stays free.
- *narrow* joint: always at one of its limits, exp(i q_j) = exp(i middle) (cos h + i s sin h), 2 h the range, with the
  signs s a character of order two such that s times the neighbor is orthogonal.

A phase of a wide joint changes no |H_jk|, so it is free; joints that play no part tell postures apart.
With no limits the plan of one group is theta_j = 2 pi i f_j / m with distinct random frequencies f_j and random phases:
any columns of the DFT matrix (doe/README.md, "Information matrix"), in shuffled order, since the plan f_j = j hides
missing effects. With all ranges below pi it is the two-level factorial, 2^(joints) runs or a multiple.
"""

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from numpy.random import Generator

from doe.bounds.certificate import Bound
from doe.plan.spacing import spread_free_joints, too_near
from doe.problem.model import offered, offers
from doe.problem.problem import DesignProblem
from identification import Array

Pattern = tuple[Array, Array]  # (b, J) angles above the lower limits [rad] and (J,) their free phase [rad]
ROUNDING = 1e-9  # [rad] by which a range may fall short; and of a mean product of columns that counts as zero


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
    value = float(4.0 * np.sum(np.log(np.sin(np.minimum(problem.upper[joints] - problem.lower[joints], np.pi) / 2.0))))
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


# -- plans that attain it ----------------------------------------------------------------------------------------------
def optimal_plans(problem: DesignProblem, runs: int, generator: Generator, tries: int = 60) -> Iterator[Array]:
    """Random plans (m, n) that attain the closed-form bound, until some attempts find none without repeats.

    tries : random constructions of a plan
    """
    if not applies(problem) or problem.constraints:
        return
    joints = list(offered(problem.model, "theorem_joints", "solver"))
    lower, upper = problem.lower[joints], problem.upper[joints]
    widths, twos = upper - lower, (runs & -runs).bit_length() - 1
    groups = [(2,) * t + (runs // 2**t,) for t in range(twos + 1)]  # Z_2^t x Z_(b / 2^t), as lists of moduli
    room = 2 ** (len(groups) - 1) if np.all(widths < np.pi - ROUNDING) else runs  # dimension that columns may have
    odd = runs % 2 and np.any(widths < np.pi - ROUNDING)  # half the runs stand at each limit of a narrow joint
    if room <= len(widths) or odd:  # too few orthogonal columns for so many links
        return
    while True:
        for _ in range(16):
            made = (_constructed(widths, groups[k % len(groups)], generator) for k in range(tries))
            if (pattern := next((each for each in made if each is not None), None)) is None:
                return
            angles, free_phase = pattern
            plan = np.empty((runs, problem.joints))
            plan[:, joints] = np.minimum(lower + angles + generator.uniform(0.0, free_phase), upper)
            plan = spread_free_joints(problem, plan, np.random.default_rng(0))
            if not len(too_near(problem, plan)):
                break
        else:
            return
        yield generator.permutation(plan)


# -- plans of one group ------------------------------------------------------------------------------------------------
def _constructed(widths: Array, group: tuple[int, ...], generator: Generator) -> Pattern | None:
    """One random choice of directions and characters; None in a dead end."""
    moduli, elements = np.array(group), np.indices(group).reshape(len(group), -1).T
    angles, free_phase = np.empty((len(elements), len(widths))), np.zeros(len(widths))
    left = right = int(generator.integers(len(widths) + 1))
    columns = np.ones((len(elements), 1), dtype=complex)  # of links left..right
    all_up_to, sample = 64, 32  # runs up to which all characters are tried; number tried of a larger group
    while right - left < len(widths):
        to_right = left == 0 or (right < len(widths) and generator.random() < 0.5)
        joint, neighbor = (right, columns[:, -1]) if to_right else (left - 1, columns[:, 0])
        wide = widths[joint] >= np.pi - ROUNDING
        if wide:
            chosen = elements  # characters of the group: all of a small one, else those of low order, on few angles,
            if len(elements) > all_up_to:  # and a random choice
                order = np.lcm.reduce(moduli // np.gcd(elements, moduli), axis=1)
                lowest = np.lexsort((generator.random(len(order)), order))[: 2 * sample]
                chosen = elements[np.r_[lowest, generator.integers(len(elements), size=sample)]]
            characters = np.exp(2j * np.pi * (elements @ (chosen / moduli).T % 1.0))
            offered = (characters[:, :, None] * columns[:, None, :]).reshape(len(columns), -1)
        else:
            even = moduli % 2 == 0
            bits = np.arange(1, min(2 ** int(even.sum()), sample * all_up_to))
            exponents = (bits[:, None] >> np.arange(int(even.sum()))) & 1
            signs = 1.0 - 2.0 * (elements[:, even] @ exponents.T % 2)  # (b, k) characters that are +1 and -1
            offered = neighbor[:, None] * signs.astype(complex)
        products = np.abs(columns.conj().T @ offered).max(axis=0)
        for k in generator.permutation(np.flatnonzero(products < ROUNDING * len(columns))).tolist():
            if wide:
                column = offered[:, k]
                turned = np.mod(np.angle(column / neighbor if to_right else neighbor / column), 2.0 * np.pi)
                around = np.sort(turned)
                gaps = np.diff(around, append=around[0] + 2.0 * np.pi)
                last = int(np.argmax(gaps))  # before the largest gap: the others are the shortest arc that holds them
                above, needed = turned - around[(last + 1) % len(around)], 2.0 * np.pi - float(gaps[last])
                angles[:, joint] = np.where(above < 0.0, above + 2.0 * np.pi, above)
                free_phase[joint] = max(widths[joint] - needed, 0.0)
            else:
                column, needed = neighbor * np.exp(0.5j * widths[joint] * signs[:, k]), widths[joint]
                angles[:, joint] = np.where((signs[:, k] > 0) == to_right, widths[joint], 0.0)
            if needed <= widths[joint] + ROUNDING:
                break
        else:
            return None
        columns = np.column_stack([columns, column] if to_right else [column, columns])
        left, right = (left, right + 1) if to_right else (left - 1, right)
    return angles, free_phase
