"""Step 8: does the gap shrink on data that were not used?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.errors import InputError
from identification.gap.confirmation import Confirmation, Groups, HeldOut, Mean, confirm, groupings, mean_of
from identification.gap.fit import Fit
from identification.gap.repeats import NOTHING_KNOWN, NoiseFloor
from identification.measurements import POINT, Conditions, Measurements, distances, rms_distance

SESSION = "another session"


@dataclass(frozen=True)
class Gap:
    """Root mean square distances between model and measurement [mm]; None where there is nothing to say.

    rms_before : what `identify` leaves, the base model fitted by least squares
    rms_after : what the named model leaves;  both without outlier rows
    held_out_before, held_out_after : the same two models on the held-out data
    predicted : what the named model should leave on held-out data
    floor : what no model can go below, where that is known
    """

    rms_before: float
    rms_after: float
    floor: NoiseFloor = NOTHING_KNOWN
    held_out_before: float | None = None
    held_out_after: float | None = None
    predicted: float | None = None

    @property
    def noise_floor(self) -> float | None:
        """Known without any model, from repeats or the instrument's sigma; None where neither exists."""
        return self.floor.value

    def __str__(self) -> str:
        line = f"gap: {self.rms_before:.4g} mm before, {self.rms_after:.4g} mm after, {self.floor}"
        if self.held_out_after is None:
            return line
        then = f"{self.held_out_before:.4g} mm before, {self.held_out_after:.4g} mm after"
        return f"{line}\nheld out: {then}, {self.predicted:.4g} mm predicted"

    def to_json(self) -> dict[str, float | str | None]:
        """Keys of `gap` (identification/files/README.md, "JSON keys")."""
        names = ("rms_before", "rms_after", "held_out_before", "held_out_after", "predicted")
        return {f"{name}_mm": getattr(self, name) for name in names} | self.floor.to_json()


def held_out_conditions(measurements: Measurements, holdout: Measurements) -> Conditions:
    """Conditions of the hold-out, its temperature counted from the mean of the identification data, and its time on
    their scale if it belongs to the same session."""
    conditions = holdout.conditions
    if measurements.temperature is not None and holdout.temperature is not None:
        conditions = replace(conditions, temperature=holdout.temperature - np.mean(measurements.temperature))
    own, other = measurements.order, holdout.order
    if own is None or other is None or transfer_of(measurements, holdout) == SESSION or np.ptp(own) == 0.0:
        return conditions
    return replace(conditions, time=(other - own.min()) / np.ptp(own) - 0.5)


def transfer_of(measurements: Measurements, holdout: Measurements) -> str:
    """What a hold-out tests, as far as the order of measurement tells.

    A number of the order stands for one row of a session, so numbers in both mean two sessions, as does a pause between
    them that is longer than the data took.
    """
    own, other = measurements.order, holdout.order
    if own is None or other is None:
        return "other rows"
    pause = max(other.min() - own.max(), own.min() - other.max())
    if len(np.intersect1d(own, other)) or pause > np.ptp(own):
        return SESSION
    if other.min() > own.max():
        return "a later time"
    return "an earlier time" if other.max() < own.min() else "other postures"


def gap_of(before: Array, after: Array, there: HeldOut | None, floor: NoiseFloor) -> Gap:
    """The gap of residuals (m, d) [mm] before and after, and the gap in the hold-out."""
    own = rms_distance(before), rms_distance(after), floor
    if there is None:
        return Gap(*own)
    squares = (np.mean(there.before), np.mean(there.after), there.predicted.value)
    return Gap(*own, *(float(np.sqrt(square)) for square in squares))


def confirmation_of(measurements: Measurements, holdout: Measurements, there: HeldOut, named: bool) -> Confirmation:
    """Whether the hold-out confirms the named model;  named : False where nothing was named."""
    every = np.ones(len(holdout), dtype=bool)
    return confirm(there, groups_of(holdout, every), transfer_of(measurements, holdout), named=named)


def held_out(
    base: Fit,
    named: Fit,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    holdout: Measurements,
    mismatch: float = 0.0,
) -> HeldOut:
    """What the two models leave in the hold-out, and what the named one should.

    mismatch : mean square distance [mm^2] that the choice of the named model adds
    """
    there = held_out_conditions(measurements, holdout)
    before, after = (fit.position_residuals(holdout, there)[:, POINT] for fit in (base, named))
    own = np.square(named.position_residuals(measurements, measurements.conditions)[kept, POINT]).sum(axis=1)
    white = 2.0 * float(np.mean(own)) ** 2 / max(named.freedom, 1)  # the variance that white Gaussian noise gives
    left = mean_of(own, groups_of(measurements, kept), white)
    # parameters are adapted to their own rows, where they leave less than in new ones
    scale = len(own) * named.model.dimension / max(named.freedom, 1)
    added = parameter_part(named, holdout, there)
    return HeldOut(
        np.square(before).sum(axis=1),
        np.square(after).sum(axis=1),
        Mean(scale * left.value + added.value + mismatch, scale**2 * left.variance + added.variance, left.freedom),
        np.square(before - after).sum(axis=1),
        float(np.sqrt(scale * left.value / before.shape[1])),
        before.shape[1],
    )


def groups_of(measurements: Measurements, kept: NDArray[np.bool_]) -> tuple[Groups, Groups]:
    """Groups of rows that count as independent, among those that are no outliers."""
    turn = np.empty(len(measurements))
    turn[measurements.sequence] = np.arange(len(measurements))
    return groupings(measurements.postures[kept], measurements.posture_numbers[kept], turn[kept])


def parameter_part(found: Fit, rows: Measurements, there: Conditions) -> Mean:
    """Mean square distance [mm^2] in other rows that the errors of the parameters make.

    With G = mean of J_i^T J_i over the rows and C the covariance, the mean of |J_i e|^2 is e^T G e: its expectation is
    tr(G C), its variance 2 tr(G C G C).
    """
    columns, covariance = found.uncertain(rows.postures, there)
    tall = columns[:, POINT].reshape(-1, columns.shape[-1])
    product = tall.T @ tall / len(rows) @ covariance
    return Mean(float(np.trace(product)), 2.0 * float(np.trace(product @ product)), np.inf)


def check_same_arm(base: Fit, measurements: Measurements, holdout: Measurements) -> None:
    """Refuse a hold-out that the arm calibrated on the data misses by far more than any effect would make it.

    The limit is ten times what the base model should leave, and a hundredth of the reach: another payload or another
    part of the workspace stays below, other links or another set-up of base and instrument do not.
    """
    there = held_out_conditions(measurements, holdout)
    left = distances(base.position_residuals(measurements, measurements.conditions)) ** 2
    expected = float(np.sqrt(np.mean(left) + parameter_part(base, holdout, there).value))
    limit = max(10.0 * expected, 0.01 * base.model.reach)
    # the median, since a few outliers do not make it another arm
    missed = float(np.median(distances(base.position_residuals(holdout, there))))
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


def split(
    measurements: Measurements, share: float, generator: np.random.Generator
) -> tuple[Measurements, Measurements]:
    """Data and hold-out: random postures with about this share of the rows are held out, each with all its repeats.

    Raises `InputError` for a share that is not between 0 and 1, and for rows of one posture only.
    """
    if not 0.0 < share < 1.0:
        raise InputError(f"holdout: {share:g}, allowed: a share of the rows between 0 and 1")
    numbers = measurements.posture_numbers
    counts = np.bincount(numbers)
    if len(counts) < 2:
        raise InputError("holdout: all rows are of one posture, allowed: several postures, to hold some of them out")
    order = generator.permutation(len(counts))
    taken = int(np.clip(np.searchsorted(np.cumsum(counts[order]), share * len(numbers)) + 1, 1, len(counts) - 1))
    held_out = np.isin(numbers, order[:taken])
    if measurements.order is None:  # the parts must know when in the session they were measured
        measurements = replace(measurements, order=np.arange(len(numbers), dtype=float))
    return measurements.rows(~held_out), measurements.rows(held_out)


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
