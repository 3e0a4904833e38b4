"""How far a fitted arm's tip may be from where it is computed, what a fit leaves of postures that it has not seen, and
why it is uncertain.

Base and measured point cannot be told apart where the flange turned too little:

    y_i = B (p_i + R_i t) + b

A shift of the point t along v and the shift of the base that follows it move measured points by B (R_i - mean R) v and
no more. Its mean square is v^T (I - (mean R)^T mean R) v: zero along every v where the flange keeps one orientation,
and along the axis where it turns about one only, however many rows there are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.uncertainty import decomposed_groups
from identification.information import ALONE, product_inverse
from identification.kinematics.chain import TOOL, KinematicChain
from identification.measurements import POINT, Measurements, rms_distance
from identification.model import Model
from identification.model.placed import tip_frames
from identification.model.positions import FEWEST, tip_jacobian
from identification.sessions import placing
from identification.threads import single_thread

if TYPE_CHECKING:
    from identification.estimation.result import Identification

# reasons: identification/README.md, "Doubtful fits"
POSES = 1000  # random postures that stand for the joint limits
FEW = "too few measurements"  # the beginning of that sentence
TOGETHER = "base and tool cannot be told apart"  # the beginning of that sentence
HARDLY = np.sin(np.radians(5.0))  # turned by less: as little as joints that hardly move


# -- the covariance of the parameters, at the tip ----------------------------------------------------------------------
@single_thread()  # the same bits, whatever the number of threads
def expected_tip(model: Model, parameters: Array, covariance: Array, postures: Array) -> float:
    """Root mean square over postures of the expected distance [mm]: the square root of the mean of trace(J C J^T).

    The tip is the first measured point, in the frame of the measurements (of lengths: best registered again), under
    neutral conditions. What the model lacks is not in it.

    parameters : (p,) of the fit;  covariance : (p, p), with a prior that of the posterior;  postures : (m, n) [rad]
    """
    jacobian = tip_jacobian(model, postures, parameters)[:, POINT]
    total = float(np.einsum("mdp,pq,mdq->", jacobian, covariance, jacobian, optimize=True))
    return float(np.sqrt(max(total, 0.0) / len(postures)))  # below zero by rounding, where data have no noise


def working_postures(low: Array, high: Array) -> Array:
    """(k, n) random postures between two limits (n,)."""
    return np.random.default_rng(0).uniform(low, high, (POSES, len(low)))


def tip_of(fit: Identification, *, measured: bool) -> float | None:
    """`expected_tip` of a fit over the joint limits, whatever they are, or over further postures like those measured
    [mm], with the error of its own that the prior says each posture has; None where something is not identifiable,
    without deviations, and of other models than an arm's.

    Real postures fill no box of joint angles. What the fit is uncertain by at its own postures is less than at others
    drawn as they were by 1 - p / N, the share of the N numbers that p parameters leave over (G. H. Golub, M. Heath,
    G. Wahba, "Generalized cross-validation", 1979), repeats counted once; and in the box of the angles measured it is
    hardly less, whatever few rows say.
    """
    arm, postures = getattr(fit.model, "arm", None), fit.postures
    if not isinstance(arm, Arm) or fit.not_identifiable or not np.all(np.isfinite(fit.covariance)):
        return None
    if not arm.chain.instrument.places and len(postures) < FEWEST:
        return None

    def over(low: Array, high: Array) -> float:
        tip = expected_tip(fit.model, fit.parameters, fit.covariance, working_postures(low, high))
        return float(np.hypot(tip, own_error(fit)))

    if not measured:
        return over(arm.lower, arm.upper)
    numbers = len(postures) * fit.residuals_after.shape[1]
    share = max(numbers - fit.determined, 1.0) / numbers
    few = postures[:: max(len(postures) // POSES, 1)]
    among = expected_tip(fit.model, fit.parameters, fit.covariance, few) / float(np.sqrt(share))
    return min(float(np.hypot(among, own_error(fit))), over(postures.min(axis=0), postures.max(axis=0)))


def own_error(fit: Identification) -> float:
    """Root mean square distance [mm] by which a posture's own error moves the tip, as the prior of a fit says."""
    model = fit.model
    if fit.prior is None or not isinstance(getattr(model, "arm", None), Arm):
        return 0.0
    return fit.prior.own_error * float(np.sqrt(model.arm.dimension))


def size_left_open(arm: Arm) -> str:
    """What more postures do not help against: readings that an arm twice as large would give as well."""
    readings, remedy = arm.chain.instrument.size_is_open
    return f"; but however many, {readings} fit an arm of any size: {remedy}" if readings else ""


def hardly_determined(fit: Identification) -> list[str]:
    """What is doubtful about a fit that leaves the tip uncertain, beyond the noise of one measurement: by over half of
    what the arm was off before, at postures like those measured; or by more than all of it, over the joint limits."""
    if fit.expected_tip_measured is None or fit.expected_tip is None:
        return base_and_tool(fit, None)
    own_square = own_error(fit) ** 2  # which no further rows help against
    inside, anywhere = (
        float(np.sqrt(max(error**2 - own_square, 0.0))) for error in (fit.expected_tip_measured, fit.expected_tip)
    )
    equations = fit.residuals_before.size
    spare = equations - len(places := placing(fit.model.parameters))
    off = fit.rms_before if len(places) < len(fit.names) else fit.rms_after  # its place says nothing of the arm
    before = off * float(np.sqrt(equations / spare)) if spare > 0 else 0.0
    noise = max(fit.scatter or 0.0, fit.sigma or 0.0) * float(np.sqrt(fit.model.arm.dimension))
    far = f"{fit.rms_before:{'.3g' if fit.rms_before < 1000.0 else '.0f'}} mm"
    was = f"; before the fit the arm was {far} off where it was measured" if spare > 0 else ""
    few, far_off = inside > max(0.5 * before, noise), anywhere > max(before, noise)
    if few or far_off:
        everywhere = working_postures(fit.model.arm.lower, fit.model.arm.upper)
        if cause := base_and_tool(fit, lambda c: expected_tip(fit.model, fit.parameters, c, everywhere)):
            return cause
    if few:
        doubt = f"at other postures like those measured the tip may be {inside:.3g} mm (RMS) from where it is computed"
        return [f"{FEW}: {doubt}{was}. Measure more postures{size_left_open(fit.model.arm)}"]
    if far_off:
        doubt = f"the tip may be {anywhere:.3g} mm (RMS over the joint limits) from where it is computed{was}"
        remedy = f"Keep near these postures, or measure others{size_left_open(fit.model.arm)}"
        return [f"away from the postures measured {doubt}. {remedy}"]
    return []


# -- base and tool -----------------------------------------------------------------------------------------------------
def flange_turns(chain: KinematicChain, measurements: Measurements) -> Array:
    """(3,) root mean square motion of a point 1 mm from the flange's center that its base follows [mm], by the axes
    along which it is, the least first. Each session has a base of its own."""
    turns, square = tip_frames(chain, measurements.postures)[:, :3, :3], np.zeros((3, 3))
    for rows in measurements.session_rows:
        apart = turns[rows] - turns[rows].mean(axis=0)
        square += np.einsum("mji,mjk->ik", apart, apart)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(square / len(turns)).clip(min=0.0)))


def base_and_tool(fit: Identification, tip: Callable[[Array], float] | None) -> list[str]:
    """The sentence that base and measured point cannot be told apart, where that is what leaves a fit uncertain.

    tip : expected error of the tip [mm] with a covariance (p, p); None: something is not identifiable at all
    """
    if (turns := fit.flange_turns) is None or turns[0] > HARDLY:
        return []
    arm = fit.model.arm
    tools = [k for k, p in enumerate(fit.model.parameters) if p.kind == TOOL]
    if not tools or (tip is None and all(fit.identifiable[tools])):
        return []
    if tip is not None:
        across = fit.covariance[:, tools]
        with_tools = fit.covariance - across @ product_inverse(fit.covariance[np.ix_(tools, tools)]) @ across.T
        if 2.0 * tip(with_tools) > tip(fit.covariance):  # with the tool given not half as uncertain: another reason
            return []
    able = flange_turns(arm.chain, Measurements(working_postures(arm.lower, arm.upper), np.zeros((POSES, 3))))
    if able[0] <= HARDLY:  # all its axes are parallel
        return []
    how = "by 45 deg and more, or give [tool]"
    if turns[1] <= HARDLY:  # mean squares of small turns a about x, y, z: y^2 + z^2, x^2 + z^2, x^2 + y^2
        angle = np.degrees(np.sqrt(np.sum(turns**2) / 2.0))
        kept = f"the flange kept one orientation, turned by {round(float(angle), 4):.2g} deg (RMS)"
        return [f"{TOGETHER}: {kept}. Measure postures that turn it about two axes {how}"]
    kept = f"the flange turned about one axis only, about others by {np.degrees(turns[0]):.2g} deg (RMS)"
    return [f"{TOGETHER}: {kept}. Measure postures that turn it about another axis, too, {how}"]


# -- postures left out -------------------------------------------------------------------------------------------------
@single_thread()
def left_out_residuals(fit: Identification, measurements: Measurements) -> Array | None:
    """(m, d) each posture's positions less where a fit to all other postures puts them [mm].

    With the leverages H_g = Q_g Q_g^T of the rows of a posture the residuals without them are (I - H_g)^-1 r_g =
    r_g + Q_g (I - Q_g^T Q_g)^-1 Q_g^T r_g: exact for a model that is linear in its parameters, and to first order for
    any other (R. D. Cook, S. Weisberg, "Residuals and Influence in Regression", 1982, section 2.2). The noise of one
    measurement is in it.

    measurements : the rows of the fit; copies do not count, and get what is left of the row they copy

    None where something is not identifiable, or a posture alone determines it.
    """
    if fit.not_identifiable or len(measurements) != len(fit.residuals_after):
        return None
    kept, weights = measurements.originals == np.arange(len(measurements)), np.ones(len(measurements))
    if (sigma := measurements.sigma) is not None:
        weights = np.sqrt(np.mean(sigma**2)) / sigma
    _, jacobian = fit.model.linearize(measurements.postures, fit.parameters, measurements.conditions)
    weights = weights[kept]
    rows = weights[:, None, None] * jacobian[kept]
    m, d, p = rows.shape
    prior = np.zeros((0, p)) if fit.prior is None else fit.prior.rows(fit.model.parameters, fit.scatter or 0.0)
    whole = np.concatenate([rows.reshape(-1, p), prior])
    whole /= np.maximum(np.linalg.norm(whole, axis=0), np.finfo(float).tiny)
    basis = np.linalg.qr(whole)[0][: m * d].reshape(m, d, -1)
    residuals = weights[:, None] * fit.residuals_after[kept]
    postures = np.unique(measurements.posture_numbers[kept], return_inverse=True)[1]
    leverages, vectors, scores = decomposed_groups(basis, residuals, postures)
    if leverages.max() > 1.0 - ALONE:
        return None
    pull = (vectors @ (scores / (1.0 - leverages))[:, :, None])[:, :, 0]
    without = residuals + np.einsum("mdr,mr->md", basis, pull[postures])
    return np.asarray((without / weights[:, None])[np.cumsum(kept)[measurements.originals] - 1])


def left_out_rms(fit: Identification, measurements: Measurements) -> float | None:
    """Root mean square distance [mm] of `left_out_residuals`, copies not counted; None as there."""
    residuals = left_out_residuals(fit, measurements)
    return None if residuals is None else rms_distance(residuals[np.unique(measurements.originals)][:, POINT])
