"""What error of the tip a plan promises, if the model is right and if effects of typical size are missing in it.

The plan is measured with noise sigma. The tip is then computed at test poses, where nothing was measured; its error
is counted against the arm's true position, as root mean square over poses and over arms that the prior may give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.problem.problem import DesignProblem
from doe.problem.robust import robust_problem, workspace
from identification.arrays import Array
from identification.kinematics.parameters import EFFECT
from identification.model import Model


@dataclass(frozen=True)
class TipError:
    """Root mean square distances [mm].

    right : the model lacks nothing, and is fitted by least squares, of a spatial arm with the prior of its machining
    missing : effects of typical size are missing in the model, which is fitted in the same way
    with_prior : the same arms, fitted with the effects and their prior (`identify --prior`)
    """

    right: float
    missing: float
    with_prior: float

    def to_json(self) -> dict[str, float | None]:
        """Key `tip_error_mm` (identification/files/README.md, "JSON keys"); None where a plan is not enough."""
        found = {"model_right": self.right, "effects_missing": self.missing, "effects_missing_prior": self.with_prior}
        return {name: value if np.isfinite(value) else None for name, value in found.items()}


def tip_error(problem: DesignProblem, wide: DesignProblem, postures: Array, poses: Array | None = None) -> TipError:
    """Of a plan (m, n), postures measured already included; infinite where it does not identify the model.

    problem : of the model as it is;  wide : `robust_problem` of it, whose added parameters come last
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    own = problem.parameters
    rows = _flat(wide, np.concatenate([postures, problem.kept]))
    needed = workspace(problem) if poses is None else poses
    targets, count = _flat(wide, needed), len(needed)
    noise = float(wide.model.sigma or 0.0) ** 2
    information = rows[:, :own].T @ rows[:, :own] + np.diag(wide.precisions[:own])
    if np.linalg.matrix_rank(np.vstack([rows[:, :own], np.diag(np.sqrt(wide.precisions[:own]))])) < own:
        return TipError(np.inf, np.inf, _with_prior(wide, rows, targets, count, noise))
    right = noise * np.sum(targets[:, :own].T * np.linalg.solve(information, targets[:, :own].T)) / count
    # the fit takes up of each missing effect what lengths and offsets can, and the tip lacks the rest
    taken = np.linalg.solve(information, rows[:, :own].T @ rows[:, own:])
    lacking = targets[:, :own] @ taken - targets[:, own:]
    sizes = noise / wide.precisions[own:]  # squared, in scaled parameters
    bias = np.sum(np.square(lacking) @ sizes) / count
    return TipError(float(np.sqrt(right)), float(np.sqrt(right + bias)), _with_prior(wide, rows, targets, count, noise))


def _with_prior(wide: DesignProblem, rows: Array, targets: Array, count: int, noise: float) -> float:
    posterior = rows.T @ rows + np.diag(wide.precisions)
    if np.linalg.matrix_rank(posterior, hermitian=True) < len(posterior):
        return np.inf
    return float(np.sqrt(noise * np.sum(targets.T * np.linalg.solve(posterior, targets.T)) / count))


def _flat(wide: DesignProblem, postures: Array) -> Array:
    """(m d, p) scaled Jacobian."""
    return wide.scaled_jacobians(postures).reshape(-1, wide.parameters)


def robust_or_none(problem: DesignProblem) -> DesignProblem | None:
    """`robust_problem`, None where there is no sigma to weigh sizes against, no library for the model, or it is one."""
    model = problem.model
    robust = any(p.kind == EFFECT and p.name in problem.deviations for p in model.parameters)
    return None if model.sigma is None or not isinstance(model, Model) or robust else robust_problem(problem)
