"""What accuracy a plan promises before anything is measured: standard deviations from the covariance."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from doe.problem import DesignProblem
from identification.arm import Array, readonly
from identification.information import information_matrix, orientation_transform


@dataclass(frozen=True)
class ExpectedDeviations:
    """Standard deviations that a plan will give, per link or joint; zero where a value is known and not estimated.

    length : (n,) of the length errors [mm]
    orientation : (n,) of the orientation offsets dtheta_j = dq_1 + ... + dq_j [rad]: the paper's sigma_q (eq. 25)
    joint_offset : (n,) of the joint offsets dq_j themselves [rad], larger for j >= 2 (THEORY.md section 2)
    """

    length: Array
    orientation: Array
    joint_offset: Array

    def __post_init__(self) -> None:
        for name in ("length", "orientation", "joint_offset"):
            object.__setattr__(self, name, readonly(getattr(self, name), -1))


def covariance(problem: DesignProblem, postures: Array, sigma: float) -> Array:
    """(p, p) sigma^2 (sum J^T J)^-1 of the parameters in their own units, measured postures (`kept`) included.

    Raises numpy's `LinAlgError` where the information matrix is singular.
    """
    everything = postures if problem.kept is None else np.vstack([postures, problem.kept])
    information = information_matrix(problem.blocks(everything))
    scaled = np.linalg.inv(information)
    return sigma**2 * scaled / np.outer(problem.model.scales, problem.model.scales)


def expected_deviations(problem: DesignProblem, postures: Array, sigma: float | None) -> ExpectedDeviations | None:
    """What the plan will give with `sigma` [mm] per coordinate; None without sigma or if the plan is not enough."""
    if sigma is None or not np.isfinite(problem.objective(postures)):
        return None
    names = problem.model.names
    matrix = covariance(problem, postures, sigma)
    deviations = np.sqrt(np.diag(matrix))
    transform = orientation_transform(names)
    orientations = np.sqrt(np.einsum("jp,pq,jq->j", transform, matrix, transform))
    length, joint_offset, orientation = (np.zeros(problem.joints) for _ in range(3))
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
