"""Step 8: does the gap shrink on data that were not used?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.gap.fit import Fit
from identification.measurements import Conditions, Measurements, rms_distance


@dataclass(frozen=True)
class Gap:
    """Root mean square distances between model and measurement [mm]; None where there is nothing to say.

    rms_before, rms_after : on the data, base model and named model refitted (outlier rows left out)
    held_out_before, held_out_after : the same two models on the held-out data
    noise_floor : RMS that a perfect model would leave on new data, from the residuals and their degrees of freedom
     predicted : what the named model should leave on held-out data
    """

    rms_before: float
    rms_after: float
    noise_floor: float
    held_out_before: float | None = None
    held_out_after: float | None = None
    predicted: float | None = None

    def __str__(self) -> str:
        floor = f"noise floor {self.noise_floor:.4g} mm"
        line = f"gap: {self.rms_before:.4g} mm before, {self.rms_after:.4g} mm after, {floor}"
        if self.held_out_after is None:
            return line
        then = f"{self.held_out_before:.4g} mm before, {self.held_out_after:.4g} mm after"
        return f"{line}\nheld out: {then}, {self.predicted:.4g} mm predicted"

    def to_json(self) -> dict[str, float | None]:
        """Keys of `gap` (identification/files/README.md, "JSON keys")."""
        return {f"{name}_mm": value for name, value in vars(self).items()}


def held_out_conditions(measurements: Measurements, holdout: Measurements) -> Conditions:
    """Conditions of the hold-out, its temperature counted from the mean of the identification data."""
    conditions = holdout.conditions
    if measurements.temperature is None or holdout.temperature is None:
        return conditions
    deviation = holdout.temperature - np.mean(measurements.temperature)
    return replace(conditions, temperature=deviation)


def confirm(
    base: Fit, named: Fit, measurements: Measurements, kept: NDArray[np.bool_], holdout: Measurements | None
) -> Gap:
    """The gap before and after, on the data and on the hold-out."""
    conditions = measurements.conditions
    before = rms_distance(base.position_residuals(measurements, conditions)[kept])
    remaining = named.position_residuals(measurements, conditions)[kept]
    after = rms_distance(remaining)
    floor = after * float(np.sqrt(remaining.size / max(named.freedom, 1)))
    if holdout is None:
        return Gap(before, after, floor)
    there = held_out_conditions(measurements, holdout)
    held_before, held_after = (rms_distance(fit.position_residuals(holdout, there)) for fit in (base, named))
    return Gap(before, after, floor, held_before, held_after, predicted_distance(named, floor, holdout, there))


def predicted_distance(found: Fit, floor: float, holdout: Measurements, there: Conditions) -> float:
    """Root mean square distance [mm] to expect: the floor, and the uncertainty of the predicted positions."""
    jacobian = found.model.jacobian(holdout.postures, found.values, there)
    variances = np.einsum("mip,pq,miq->m", jacobian, found.covariance(), jacobian, optimize=True)
    return float(np.sqrt(floor**2 + np.mean(variances)))


def check_same_arm(base: Fit, measurements: Measurements, holdout: Measurements) -> None:
    """Refuse a hold-out that the arm calibrated on the data misses by far more than any effect would make it.

    The limit is ten times what the base model should leave, and a hundredth of the reach: another payload or another
    part of the workspace stays below, other links or another set-up of base and instrument do not.
    """
    there = held_out_conditions(measurements, holdout)
    left = rms_distance(base.position_residuals(measurements, measurements.conditions))
    limit = max(10.0 * predicted_distance(base, left, holdout, there), 0.01 * base.model.reach)
    # the median, since a few outliers do not make it another arm
    missed = float(np.median(np.linalg.norm(base.position_residuals(holdout, there), axis=1)))
    if missed > limit:
        raise InputError(
            f"holdout: median residual {missed:.3g} mm with the arm calibrated on the data, allowed: up to {limit:.3g} "
            "mm; another arm, set-up or unit?"
        )


def _distance_to_data(measurements: Measurements, holdout: Measurements) -> Array:
    """(m,) largest difference to the most similar row of the data, in units of 1e-5 rad and 1e-3 mm."""
    from scipy.spatial import KDTree

    data, rows = (np.column_stack([d.postures / 1e-5, d.positions / 1e-3]) for d in (measurements, holdout))
    return np.asarray(KDTree(data).query(rows, p=np.inf)[0])


def check_holdout(measurements: Measurements, holdout: Measurements) -> None:
    """Refuse a hold-out of another arm, or one that is (in part) the data itself."""
    if holdout.links != measurements.links:
        raise InputError(f"holdout: {holdout.links} joints, allowed: {measurements.links} as in the data")
    if holdout.dimension != measurements.dimension:
        found, needed = holdout.dimension, measurements.dimension
        raise InputError(f"holdout: positions of {found} coordinates, allowed: {needed} as in the data")
    distance = _distance_to_data(measurements, holdout)
    shared, near = int(np.sum(distance == 0.0)), int(np.sum(distance <= 1.0))
    if shared or 2 * near > len(holdout):  # a few repeats may agree by chance, most rows only in a rounded copy
        shared = max(shared, near)
        raise InputError(
            f"holdout: {shared} of {len(holdout)} rows are also in the data, allowed: rows not used before"
        )
