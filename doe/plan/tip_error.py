"""Predicted tip error of a plan: with a correct model, and with effects of typical size missing from it.

The plan is measured with noise sigma. The tip is then computed at test poses, where nothing was measured; its error
is counted against the arm's true position, as root mean square over poses and over arms that the prior may give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.problem.problem import DesignProblem
from doe.problem.robust import robust_problem, tip_jacobians, workspace
from doe.problem.spatial import of_one_arm
from identification.arrays import Array
from identification.estimation.prior import Prior
from identification.gap.library.library_prior import LibraryPrior
from identification.information import log_determinants, spectrum
from identification.kinematics.parameters import EFFECT
from identification.model.positions import of_positions
from identification.validate.row_groups import diagnosed

SPACE = 3  # coordinates of a point


@dataclass(frozen=True)
class TipError:
    """Root mean square distances [mm].

    right : the model lacks nothing, and is fitted by least squares, of a spatial arm with the prior of its machining
    missing : effects of typical size are missing in the model, which is fitted in the same way; infinite where none
        are counted
    with_prior : the same arms, fitted with the effects and their prior (`identify --library-prior`)
    worst : as `right`, at that of the test poses where it is largest
    """

    right: float
    missing: float
    with_prior: float
    worst: float = np.inf

    def to_json(self) -> dict[str, float | None]:
        """Key `tip_error_mm` (identification/files/README.md, "JSON keys"); None where a plan is not enough."""
        found = {"model_right": self.right, "effects_missing": self.missing, "effects_missing_prior": self.with_prior}
        found |= {"model_right_worst": self.worst}
        return {name: value if np.isfinite(value) else None for name, value in found.items()}


def tip_error(problem: DesignProblem, wide: DesignProblem, postures: Array, poses: Array | None = None) -> TipError:
    """Expected tip error of a plan (m, n) and the postures measured already; infinite if the model is not identified.

    problem : of the model as it is, whose parameters may have a prior, as a spatial arm's geometry has
    wide : `robust_problem` of it, whose added parameters come last
    poses : (k, n) where the tip is needed, None: the `workspace`
    """
    own, kept = problem.parameters, problem.kept
    rows = _of_measurements(wide, np.concatenate([postures, kept]))
    targets = _of_points(wide, workspace(problem) if poses is None else poses)
    noise = float(wide.model.sigma or 0.0) ** 2
    least = np.concatenate([rows[: -wide.parameters, :own], np.diag(np.sqrt(wide.precisions[:own]))])
    all_known = _spread(rows, targets, noise)
    if spectrum(least, np.ones(own)).rank < own:
        return TipError(np.inf, np.inf, _mean(all_known))
    right = _spread(least, targets[..., :own], noise)
    # the fit takes up of each missing effect what the geometry can, and the tip lacks the rest
    unseen = np.concatenate([rows[: -wide.parameters, own:], np.zeros((own, wide.parameters - own))])
    taken = np.linalg.lstsq(least, unseen, rcond=None)[0]
    lacking = targets[..., :own] @ taken - targets[..., own:]
    bias = np.sum(lacking**2 @ (noise / wide.precisions[own:]), axis=1)  # sizes squared, in scaled parameters
    lacks = (_mean(right + bias), _mean(all_known)) if wide.parameters > own else (np.inf, np.inf)
    return TipError(_mean(right), *lacks, float(np.sqrt(right.max())))


def _of_measurements(wide: DesignProblem, postures: Array) -> Array:
    """(m d + P, P) scaled Jacobian, and the prior as rows of its own."""
    measured = wide.scaled_jacobians(postures).reshape(-1, wide.parameters)
    return np.concatenate([measured, np.diag(np.sqrt(wide.precisions))])


def _of_points(wide: DesignProblem, poses: Array) -> Array:
    """(k, d, P) scaled Jacobian of the tip's position, its squares a mean over the measured points; an orientation that
    is measured too is no distance."""
    jacobians, model = tip_jacobians(wide, poses), of_one_arm(wide.model)
    coordinates = jacobians.shape[1]
    each = coordinates if model is None else of_positions(model).dimension
    points = np.concatenate([jacobians[:, k : k + SPACE] for k in range(0, coordinates, each)], axis=1)
    return np.asarray(points / np.sqrt(coordinates / each))


def _spread(rows: Array, targets: Array, noise: float) -> Array:
    """(k,) mean square of the tip's distance, from (N, p) rows that were fitted and (k, d, p) of the tip."""
    information = rows.T @ rows
    if np.isneginf(log_determinants(information)):
        return np.full(len(targets), np.inf)
    solved = np.linalg.solve(information, targets.reshape(-1, len(information)).T).T.reshape(targets.shape)
    return noise * np.einsum("kdp,kdp->k", targets, solved)


def _mean(squares: Array) -> float:
    return float(np.sqrt(np.mean(squares)))


def robust_or_none(problem: DesignProblem) -> DesignProblem | None:
    """`robust_problem`, None where there is no sigma to weigh sizes against, no library for the model, or it is one.

    Of a diagnosed arm nothing is missing: what its data could show is in the model, at typical size they would have.
    """
    model, own = problem.model, of_one_arm(problem.model)
    robust = any(p.kind == EFFECT and p.name in problem.deviations for p in model.parameters)
    if model.sigma is None or own is None or robust:
        return None
    nothing = LibraryPrior(own.arm, (), Prior({}), {}) if diagnosed(own.arm) else None
    return robust_problem(problem, nothing)
