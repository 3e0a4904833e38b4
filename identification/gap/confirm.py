"""Step 8: does the gap shrink on data that were not used?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.arm import Array
from identification.errors import InputError
from identification.gap.fit import Fit
from identification.measurements import Conditions, Measurements


@dataclass(frozen=True)
class Gap:
    """Root mean square distances between model and measurement [mm]; None where there is nothing to say.

    rms_before, rms_after : on the data, base model and named model refitted (outlier rows left out)
    held_out_before, held_out_after : the same two models on the held-out data
    noise_floor : what a perfect model would leave;  predicted : what the named model should leave on held-out data
    """

    rms_before: float
    rms_after: float
    noise_floor: float
    held_out_before: float | None = None
    held_out_after: float | None = None
    predicted: float | None = None

    def to_json(self) -> dict[str, float | None]:
        """Keys of the contract."""
        return {f"{name}_mm": value for name, value in vars(self).items()}


def rms_distance(residual: Array) -> float:
    """Root mean square over rows of the distance of (m, 2) residuals."""
    return float(np.sqrt(np.mean(np.sum(np.square(residual), axis=-1))))


def residuals(found: Fit, measurements: Measurements, conditions: Conditions) -> Array:
    """(m, 2) measured less predicted position [mm]."""
    return np.asarray(measurements.positions - found.model.position(measurements.postures, found.values, conditions))


def held_out_conditions(measurements: Measurements, holdout: Measurements) -> Conditions:
    """Conditions of the hold-out, its temperature counted from the mean of the identification data."""
    conditions = holdout.conditions
    if measurements.temperature is None or holdout.temperature is None:
        return conditions
    deviation = holdout.temperature - np.mean(measurements.temperature)
    return Conditions(conditions.payload, deviation, conditions.time, conditions.directions)


def confirm(
    base: Fit, named: Fit, measurements: Measurements, kept: NDArray[np.bool_], holdout: Measurements | None
) -> Gap:
    """The gap before and after, on the data and on the hold-out."""
    conditions = measurements.conditions
    before = rms_distance(residuals(base, measurements, conditions)[kept])
    remaining = residuals(named, measurements, conditions)[kept]
    after = rms_distance(remaining)
    floor = after * float(np.sqrt(remaining.size / max(named.freedom, 1)))
    if holdout is None:
        return Gap(before, after, floor)
    there = held_out_conditions(measurements, holdout)
    jacobian = named.model.jacobian(holdout.postures, named.values, there)
    spread = np.einsum("mip,pq,miq->m", jacobian, named.covariance(), jacobian, optimize=True)
    return Gap(
        before,
        after,
        floor,
        rms_distance(residuals(base, holdout, there)),
        rms_distance(residuals(named, holdout, there)),
        float(np.sqrt(floor**2 + np.mean(spread))),
    )


def check_holdout(measurements: Measurements, holdout: Measurements) -> None:
    """Refuse a hold-out of another arm, or one that is (in part) the data itself."""
    if holdout.links != measurements.links:
        raise InputError(f"holdout: {holdout.links} joints, allowed: {measurements.links} as in the data")
    both = np.column_stack([measurements.postures, measurements.positions])
    seen = {row.tobytes() for row in both}
    shared = sum(row.tobytes() in seen for row in np.column_stack([holdout.postures, holdout.positions]))
    if shared:
        raise InputError(
            f"holdout: {shared} of {len(holdout)} rows are also in the data, allowed: rows not used before"
        )
