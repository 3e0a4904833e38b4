"""What accuracy a plan promises before anything is measured: standard deviations from the covariance."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from doe.problem.bayesian import EnsembleModel
from doe.problem.problem import DesignProblem, InformationModel
from identification.arrays import Array, readonly
from identification.information import Spectrum, orientation_transform, spectrum


@dataclass(frozen=True)
class ExpectedDeviations:
    """Standard deviations that a plan will give, per link or joint; zero where a value is known and not estimated.

    length : (n,) of the length errors [mm]
    orientation : (n,) of the orientation offsets dtheta_j = dq_1 + ... + dq_j [rad]: the paper's sigma_q (eq. 25)
    joint_offset : (n,) of the joint offsets dq_j themselves [rad], larger for j >= 2
        (identification/README.md, "Covariance and intervals")
    """

    length: Array
    orientation: Array
    joint_offset: Array

    def __post_init__(self) -> None:
        for name in ("length", "orientation", "joint_offset"):
            object.__setattr__(self, name, readonly(getattr(self, name), -1))


def plan_spectrum(problem: DesignProblem, postures: Array, weights: Array | None = None) -> Spectrum:
    """What m runs tell, measured postures (`kept`) included: decomposition of their sensitivities (`problem.blocks`).

    weights : (m,) shares of the m runs, None: one each. Its rank is right where det M is nothing but rounding.
    """
    return spectrum(plan_blocks(problem, postures, weights), np.ones(problem.parameters))


def plan_blocks(problem: DesignProblem, postures: Array, weights: Array | None = None) -> Array:
    """(m + k, d, p) sensitivities of m runs and of the k measured already."""
    blocks = problem.blocks(postures)
    if weights is not None:
        blocks = blocks * np.sqrt(len(blocks) * weights)[:, None, None]
    return np.concatenate([blocks, problem.blocks(problem.kept)])


def expected_deviations(
    problem: DesignProblem, postures: Array, sigma: float | None, weights: Array | None = None
) -> ExpectedDeviations | None:
    """What the plan will give with `sigma` [mm] per coordinate; None without sigma or if the plan is not enough.

    weights : (m,) of an approximate design, for m runs shared out by them; None: one run per posture
    """
    if sigma is None:
        return None
    told = plan_spectrum(problem, postures, weights)
    if told.rank < problem.parameters:
        return None
    return _deviations(told, problem.model, problem.joints, sigma)


def deviations_per_draw(
    problem: DesignProblem, model: EnsembleModel, postures: Array, sigma: float | None, weights: Array | None = None
) -> tuple[ExpectedDeviations, ...] | None:
    """What the plan will give if the arm is that of draw 1, 2, ..., K; None as in `expected_deviations`.

    model : the problem's own, of several arms: each is judged by its own block of the block-diagonal sensitivities
    """
    if sigma is None:
        return None
    stacked = plan_blocks(problem, postures, weights)
    d, p = model.model.dimension, len(model.model.names)
    each = range(len(model.draws))
    told = [spectrum(stacked[:, k * d : (k + 1) * d, k * p : (k + 1) * p], np.ones(p)) for k in each]
    if any(one.rank < p for one in told):
        return None
    return tuple(_deviations(one, model.model, problem.joints, sigma) for one in told)


def over_draws(found: Sequence[ExpectedDeviations], judge: Callable[..., Array]) -> ExpectedDeviations:
    """Mean (`np.mean`) or worst (`np.max`) of each deviation over the draws."""
    names = ("length", "orientation", "joint_offset")
    return ExpectedDeviations(*(judge([getattr(one, name) for one in found], axis=0) for name in names))


def _deviations(told: Spectrum, model: InformationModel, joints: int, sigma: float) -> ExpectedDeviations:
    names, scales = model.names, model.scales
    matrix = (sigma / scales)[:, None] * told.covariance * (sigma / scales)  # sigma^2 (sum J^T J)^-1, own units
    deviations = np.sqrt(np.diag(matrix))
    transform = orientation_transform(names)
    orientations = np.sqrt(np.einsum("jp,pq,jq->j", transform, matrix, transform))
    length, joint_offset, orientation = (np.zeros(joints) for _ in range(3))
    row = 0
    for name, deviation in zip(names, deviations, strict=True):
        found = re.fullmatch(r"(length_error|joint_offset):(\d+)", name)
        if found and found[1] == "length_error":
            length[int(found[2]) - 1] = deviation
        elif found:
            joint_offset[int(found[2]) - 1] = deviation
            orientation[int(found[2]) - 1] = orientations[row]
            row += 1
    return ExpectedDeviations(length, orientation, joint_offset)
