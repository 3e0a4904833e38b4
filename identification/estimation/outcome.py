"""From a solution of a least-squares problem to an `Identification`: what is estimable, how sure, what is doubtful."""

from __future__ import annotations

from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.base_and_tool import turns_measured
from identification.estimation.checks import Noise
from identification.estimation.levenberg_marquardt import Solution
from identification.estimation.outlying import limit_of, outlying, robust_squares, together
from identification.estimation.plausibility import doubts, far_rows
from identification.estimation.problem import Problem
from identification.estimation.result import Identification
from identification.estimation.uncertainty import Uncertainty
from identification.information import Spectrum, identifiability_of
from identification.kinematics.joint_range import joint_range
from identification.kinematics.spatial import BASE, TOOL
from identification.measurements import Measurements
from identification.model import Model
from identification.sessions import placing
from identification.status import Status

CLEAR = 0.5  # of the limit: rows this near are tested with their leverage, which is small where rows are many
MANY = 20  # equations for each parameter


class Spread(NamedTuple):
    """How sure a fit is: its intervals, standard deviation of one coordinate [mm], weighted squares, what is left."""

    uncertainty: Uncertainty
    scatter: float | None
    squares: float
    freedom: int


def as_it_was(problem: Problem) -> Array:
    """(m, d) residuals [mm] of the arm as it was; where nothing says where a spatial arm stands and what is measured on
    it, these are fitted in least squares (one Gauss-Newton step from the closed form)."""
    if not (free := placing(problem.model.parameters)):
        return np.asarray(problem.residuals(problem.start)[0])
    position, jacobian = problem.model.linearize(problem.postures, problem.start, problem.conditions)
    residual = problem.positions[0] - position
    slopes = (problem.root_weights[:, :, None] * jacobian[:, :, free]).reshape(-1, len(free))
    step = np.linalg.lstsq(slopes, (problem.root_weights * residual).ravel(), rcond=None)[0]
    parameters = problem.start.copy()
    parameters[free] += step
    return np.asarray(problem.residuals(parameters)[0])


def as_filed(model: Model, data: Measurements) -> Array | None:
    """(m, d) residuals [mm] of a spatial arm where its calibration has it, if nothing but that place is estimated; None
    for other fits and where the file does not say it: `as_it_was` fits it."""
    arm = getattr(model, "arm", None)
    if arm is None or arm.chain.planar or arm.calibration is None or len(data.session_names) > 1:
        return None
    chain, calibration = arm.chain, arm.calibration
    placed = (BASE in chain.known or calibration.base is not None) and (
        TOOL in chain.known or {*calibration.tools} >= {*chain.tools}
    )
    if not placed or len(placing(model.parameters)) < len(model.names):
        return None
    return np.asarray(data.positions - model.position(data.postures, model.values, data.conditions))


def identification(
    problem: Problem,
    data: Measurements,
    method: str,
    solution: Solution,
    decomposed: Spectrum,
    noise: Noise,
    spread: Spread,
) -> Identification:
    """The `Identification` of a solution: what is estimable, the uncertainty, and doubts about the fit."""
    model, parameters, has_sigma = problem.model, solution.parameters[0], noise.sigma is not None
    identifiability = identifiability_of(decomposed, model.names, model.scales)
    before, after = as_it_was(problem), problem.residuals(parameters)[0]
    doubtful = doubts(model, parameters, identifiability.identifiable, before, after, data)
    unexplained = unexplained_by_fit(problem, parameters, after)
    structure = together(unexplained, data.postures, data.posture_numbers)
    outlier = unexplained & ~structure
    used = np.flatnonzero(problem.weights > 0.0)
    first = used[np.unique(data.repeat_numbers[used], return_index=True)[1]]
    status = Status.not_identifiable if identifiability.combinations else solution.status[0]
    return Identification(
        model=model,
        parameters=parameters,
        covariance=spread.uncertainty.covariance,
        identifiable=identifiability.identifiable,
        not_identifiable=identifiability.combinations,
        sigma=noise.sigma if has_sigma else spread.scatter,
        sigma_known=has_sigma,
        chi2=spread.squares if has_sigma else None,
        dof=spread.freedom,
        residuals_before=before,
        residuals_after=after,
        method=method,
        status=Status.implausible if doubtful.implausible else status,
        iterations=int(solution.iterations[0]),
        provenance=MappingProxyType(data.origin | joint_range(data.postures, model.joint_types)),
        uncertainty=spread.uncertainty,
        scatter=spread.scatter,
        doubts=(*doubtful.sentences, *far_rows(after, outlier, structure)),
        flange_turns=turns_measured(model, data),
        postures=data.postures[first],
        determined=float(len(used) * after.shape[1] - spread.freedom),
        outlier_rows=tuple((np.flatnonzero(outlier) + 1).tolist()),
        unexplained_rows=tuple((np.flatnonzero(structure) + 1).tolist()),
    )


def unexplained_by_fit(problem: Problem, parameters: Array, residual: Array) -> NDArray[np.bool_]:
    """(m,) rows that the model does not explain, where enough equations are left to tell.

    parameters : (p,) of the fit;  residual : (m, d) [mm]
    """
    unexplained, used = np.zeros(len(residual), dtype=bool), problem.weights > 0.0
    white = (problem.root_weights * residual)[used]
    p, d = len(parameters), white.shape[1]
    if white.size - p + len(problem.prior_rows) <= p:
        return unexplained
    if white.size > MANY * p and robust_squares(np.sum(white**2, axis=1), d).max() < CLEAR * limit_of(d):
        return unexplained
    columns = problem.jacobian(parameters).reshape(len(used), -1)[used].reshape(white.size, p)
    held = problem.prior_rows
    unexplained[used] = outlying(white, columns, held, held @ (problem.prior_center - parameters))
    return unexplained
