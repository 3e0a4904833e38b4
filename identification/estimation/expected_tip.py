"""How far a fitted arm's tip may be from where it is computed: the covariance of the parameters, at the tip."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.base_and_tool import base_and_tool
from identification.measurements import POINT
from identification.model import Model
from identification.model.positions import FEWEST, tip_jacobian
from identification.sessions import placing
from identification.threads import single_thread

if TYPE_CHECKING:
    from identification.estimation.result import Identification

# reasons: identification/README.md, "Doubtful fits"
POSES = 1000  # random postures that stand for the joint limits
FEW = "too few measurements"  # the beginning of that sentence
SHARE = 0.5  # of the drawing's own error


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
    arm, postures_measured = getattr(fit.model, "arm", None), fit.postures
    if not isinstance(arm, Arm) or fit.not_identifiable or not np.all(np.isfinite(fit.covariance)):
        return None
    if not arm.chain.instrument.whole and len(postures_measured) < FEWEST:
        return None

    def over(postures: Array) -> float:
        return float(np.hypot(expected_tip(fit.model, fit.parameters, fit.covariance, postures), own_error(fit)))

    if not measured:
        return over(working_postures(arm.lower, arm.upper))
    numbers = len(postures_measured) * fit.residuals_after.shape[1]
    share = max(numbers - fit.determined, 1.0) / numbers
    few = postures_measured[:: max(len(postures_measured) // POSES, 1)]
    among = expected_tip(fit.model, fit.parameters, fit.covariance, few) / float(np.sqrt(share))
    among = float(np.hypot(among, own_error(fit)))
    return min(among, over(working_postures(postures_measured.min(axis=0), postures_measured.max(axis=0))))


def own_error(fit: Identification) -> float:
    """Root mean square distance [mm] by which a posture's own error moves the tip, as the prior of a fit says."""
    model = fit.model
    if fit.prior is None or not isinstance(getattr(model, "arm", None), Arm):
        return 0.0
    return fit.prior.own_error * float(np.sqrt(model.arm.dimension))


def size_left_open(arm: Arm) -> str:
    """What more postures do not help against: contacts that an arm twice as large would make as well."""
    if arm.chain.instrument.shows_size:
        return ""
    if arm.chain.instrument.free_radius:
        return "; but however many, contacts with a sphere of unknown radius fit an arm of any size: give radius_mm"
    return "; but however many, contacts with planes fit an arm of any size, which only [machining] tells"


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
    few, far_off = inside > max(SHARE * before, noise), anywhere > max(before, noise)
    if few or far_off:
        everywhere = working_postures(fit.model.arm.lower, fit.model.arm.upper)
        if cause := base_and_tool(fit, lambda c: expected_tip(fit.model, fit.parameters, c, everywhere)):
            return cause
    if few:
        doubt = f"at other postures like those measured the tip may be {inside:.3g} mm (RMS) from where it is computed"
        return [f"{FEW}: {doubt}{was}. Measure more postures{size_left_open(fit.model.arm)}"]
    if far_off:
        doubt = f"the tip may be {anywhere:.3g} mm (RMS over the joint limits) from where it is computed{was}"
        return [f"away from the postures measured {doubt}. Keep near these postures, or measure others"]
    return []
