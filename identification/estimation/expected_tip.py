"""How far a fitted arm's tip may be from where it is computed: the covariance of the parameters, at the tip."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from identification.arm import Arm
from identification.arrays import Array
from identification.estimation.plausibility import limited
from identification.measurements import POINT
from identification.model import Model
from identification.sessions import placing

if TYPE_CHECKING:
    from identification.estimation.result import Identification

# reasons: identification/README.md, "Doubtful fits"
POSES = 1000  # random postures that stand for the joint limits
SHARE = 0.5  # of the drawing's own error


def expected_tip(model: Model, parameters: Array, covariance: Array, postures: Array) -> float:
    """Root mean square over postures of the expected distance [mm]: the square root of the mean of trace(J C J^T).

    The tip is the first measured point, in the frame of the measurements, under neutral conditions. What the model
    lacks is not in it.

    parameters : (p,) of the fit;  covariance : (p, p), with a prior that of the posterior;  postures : (m, n) [rad]
    """
    jacobian = model.jacobian(postures, parameters)[:, POINT]
    return float(np.sqrt(np.einsum("mdp,pq,mdq->", jacobian, covariance, jacobian, optimize=True) / len(postures)))


def everywhere(arm: Arm, measured: Mapping[str, Any]) -> Array:
    """(k, n) random postures within the joint limits; of a joint without limits, within the angles measured.

    measured : `Measurements.origin`
    """
    low, high = arm.lower, arm.upper
    if (ranges := measured.get("joint_range_deg")) is not None:
        low, high = np.where(limited(arm), [low, high], np.radians(ranges).T)
    return np.random.default_rng(0).uniform(low, high, (POSES, arm.links))


def hardly_determined(found: Identification) -> list[str]:
    """What is doubtful about a fit that leaves the tip less certain than half of what the drawing was off by, and than
    one measurement of it."""
    equations = found.residuals_before.size
    spare = equations - len(placing(found.model.parameters))
    drawn = found.rms_before * float(np.sqrt(equations / spare)) if spare > 0 else 0.0
    noise = (found.scatter or found.sigma or 0.0) * float(np.sqrt(found.model.arm.dimension))
    expected = found.expected_tip
    if expected is None or expected <= max(SHARE * drawn, noise):
        return []
    off = f"; before the fit the arm was {found.rms_before:.3g} mm off where it was measured" if spare > 0 else ""
    said = f"elsewhere the tip may be {expected:.3g} mm off (RMS over the joint limits) from where it is computed{off}"
    return [f"too few measurements, or too much alike: {said}. Measure more postures, all over where the arm works"]
