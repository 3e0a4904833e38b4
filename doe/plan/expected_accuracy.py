"""What accuracy a plan promises before anything is measured: standard deviations from the covariance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from doe.criteria import I
from doe.problem.bayesian import EnsembleModel
from doe.problem.model import DesignModel
from doe.problem.problem import DesignProblem
from identification.arrays import Array, readonly
from identification.information import Spectrum, spectrum
from identification.kinematics.parameters import EFFECT, JOINT_OFFSET, LENGTH_ERROR, ParameterSet


@dataclass(frozen=True)
class ExpectedDeviations:
    """Standard deviations that a plan will give.

    parameters : what they belong to;  values : (p,) of every parameter [mm, rad, or its own unit]
    orientation : (n,) of the orientation offsets dtheta_j = dq_1 + ... + dq_j of a planar chain [rad]: the paper's
        sigma_q (eq. 25); zero where a joint offset is known, and for other chains
    """

    parameters: ParameterSet
    values: Array
    orientation: Array

    def __post_init__(self) -> None:
        for name in ("values", "orientation"):
            object.__setattr__(self, name, readonly(getattr(self, name), -1))

    @property
    def planar(self) -> bool:
        """True if length errors, joint offsets and effects are all there is: the parameters of a planar chain."""
        return {LENGTH_ERROR, JOINT_OFFSET, EFFECT}.issuperset(self.parameters.kinds)

    @property
    def length(self) -> Array:
        """(n,) of the length errors [mm], zero where one is known and not estimated."""
        return self._by_joint(LENGTH_ERROR)

    @property
    def joint_offset(self) -> Array:
        """(n,) of the joint offsets dq_j [rad], larger than those of the orientations for j >= 2
        (identification/README.md, "Covariance and intervals")."""
        return self._by_joint(JOINT_OFFSET)

    @property
    def largest_length(self) -> float:
        """Largest of a length of the arm's geometry [mm]; zero where none is estimated."""
        return self._largest("mm")

    @property
    def largest_angle(self) -> float:
        """Largest of an angle of the arm's geometry [rad]: of a joint offset, of a planar chain."""
        return self._largest("rad")

    def _largest(self, unit: str) -> float:
        chosen = [p.unit == unit and p.kind != EFFECT for p in self.parameters]
        return float(np.max(self.values[chosen], initial=0.0))

    def _by_joint(self, kind: str) -> Array:
        by_joint = np.zeros(self.orientation.size)
        for k in self.parameters.indices(kind).tolist():
            by_joint[(self.parameters[k].joint or 0) - 1] = self.values[k]
        return readonly(by_joint)


def error_at_poses(problem: DesignProblem, value: float, runs: int) -> float | None:
    """Expected error of the tip [mm], as RMS over the test poses, that a value of criterion I stands for.

    runs : of the plan, those measured already apart;  None for another criterion, without sigma, and where not
    everything is estimable. Of several measured points it is that of one of them.
    """
    criterion, sigma = problem.criterion, problem.model.sigma
    if not isinstance(criterion, I) or sigma is None or not np.isfinite(value):
        return None
    return float(np.sqrt(max(-value, 0.0) / criterion.points / (runs + problem.prior.runs) * sigma**2 + problem.beyond))


def plan_spectrum(problem: DesignProblem, postures: Array, weights: Array | None = None) -> Spectrum:
    """What is estimable from m runs and all that is known before: decomposition of their scaled Jacobians.

    weights : (m,) shares of the m runs, None: one each. Its rank is right where det M is nothing but rounding.
    """
    return spectrum(plan_jacobians(problem, postures, weights), np.ones(problem.parameters))


def plan_jacobians(problem: DesignProblem, postures: Array, weights: Array | None = None) -> Array:
    """(m + k + r, d, p) scaled Jacobians of m runs, of the k measured already, and of what else is known beforehand.

    The last r are rows that have its information, as a measurement of those parameters would.
    """
    jacobians = problem.scaled_jacobians(postures)
    if weights is not None:
        jacobians = jacobians * np.sqrt(len(jacobians) * weights)[:, None, None]
    return np.concatenate([jacobians, problem.scaled_jacobians(problem.kept), prior_rows(problem)])


def prior_rows(problem: DesignProblem) -> Array:
    """(r, d, p) rows whose B^T B sum to the information of `problem.deviations`, d at a time."""
    informed = np.flatnonzero(problem.precisions)
    d, p = problem.model.dimension, problem.parameters
    rows = np.zeros((-(-len(informed) // d) * d, p))
    rows[range(len(informed)), informed] = np.sqrt(problem.precisions[informed])
    return rows.reshape(-1, d, p)


def expected_deviations(
    problem: DesignProblem, postures: Array, sigma: float | None, weights: Array | None = None
) -> ExpectedDeviations | None:
    """What the plan will give with `sigma` [mm] per coordinate; None without sigma or if the plan is not enough.

    weights : (m,) of an approximate design, for m runs shared out by them; None: one run per posture
    """
    if sigma is None:
        return None
    decomposed = plan_spectrum(problem, postures, weights)
    if decomposed.rank < problem.parameters:
        return None
    return _deviations(decomposed, problem.model, problem.joints, sigma)


def deviations_per_draw(
    problem: DesignProblem, model: EnsembleModel, postures: Array, sigma: float | None, weights: Array | None = None
) -> tuple[ExpectedDeviations, ...] | None:
    """What the plan will give if the arm is that of draw 1, 2, ..., K; None as in `expected_deviations`.

    model : the problem's own, of several arms: each is judged by its own block of the block-diagonal Jacobian
    """
    if sigma is None:
        return None
    stacked = plan_jacobians(problem, postures, weights)
    d, p = model.model.dimension, len(model.model.parameters)
    each = range(len(model.draws))
    decomposed = [spectrum(stacked[:, k * d : (k + 1) * d, k * p : (k + 1) * p], np.ones(p)) for k in each]
    if any(one.rank < p for one in decomposed):
        return None
    return tuple(_deviations(one, model.model, problem.joints, sigma) for one in decomposed)


def over_draws(draws: Sequence[ExpectedDeviations], judge: Callable[..., Array]) -> ExpectedDeviations:
    """Mean (`np.mean`) or worst (`np.max`) of each standard deviation over the draws."""
    values, orientation = (judge([getattr(one, name) for one in draws], axis=0) for name in ("values", "orientation"))
    return replace(draws[0], values=values, orientation=orientation)


def _deviations(decomposed: Spectrum, model: DesignModel, joints: int, sigma: float) -> ExpectedDeviations:
    parameters = model.parameters
    per_scale = sigma / parameters.scales
    matrix = per_scale[:, None] * decomposed.covariance * per_scale  # sigma^2 (sum J^T J)^-1, own units
    orientation = np.zeros(joints)
    offsets = parameters.indices(JOINT_OFFSET).tolist()
    sums = np.tri(len(offsets))  # dtheta_j = dq_1 + ... + dq_j
    turned = sums @ matrix[np.ix_(offsets, offsets)] @ sums.T
    orientation[[(parameters[k].joint or 0) - 1 for k in offsets]] = np.sqrt(np.diag(turned))
    return ExpectedDeviations(parameters, np.sqrt(np.diag(matrix)), orientation)
