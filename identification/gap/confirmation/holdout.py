"""Step 8 of the workflow: confirm the named model on held-out data, and split data for that purpose."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.effects.places import widths
from identification.errors import InputError
from identification.gap.average import PredictingModel
from identification.gap.confirmation.confirmation import (
    Confirmation,
    Groups,
    HeldOut,
    Mean,
    confirm,
    groupings,
    mean_of,
)
from identification.gap.confirmation.set_up import Predicted, SetUp, point_names, set_up_of
from identification.gap.fits.fit import Fit
from identification.gap.noise import NoiseFloor
from identification.measurements import POINT, Conditions, Measurements, distances, rms_distance

SESSION = "another session"
OTHER_ROWS = "other rows"


@dataclass(frozen=True)
class Gap:
    """RMS distances between model and measurement [mm]; None where not available.

    rms_before, rms_after : of the base model as `identify` fits it, and of the named model; both without outliers
    held_out_before, held_out_after : of the same two models on the held-out data;  predicted : expected held-out value
    floor : noise floor, which no model can go below
    """

    rms_before: float
    rms_after: float
    floor: NoiseFloor = field(default_factory=NoiseFloor)
    held_out_before: float | None = None
    held_out_after: float | None = None
    predicted: float | None = None

    @property
    def noise_floor(self) -> float | None:
        """Noise floor [mm] from repeats or the instrument's sigma; None where neither is available."""
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
    """Conditions of the hold-out on the scales of the data.

    Temperatures count from where those of the data do; time is on the scale of the data if both are of one session.
    Measured points have the numbers of the data, those that the data do not have that of the first.
    """
    conditions = replace(holdout.conditions, marker=point_names(measurements, holdout)[0])
    if measurements.temperature is not None and holdout.temperature is not None:
        conditions = replace(conditions, temperature=holdout.temperature - measurements.reference_temperature)
    own, other = measurements.order, holdout.order
    if own is None or other is None or transfer_of(measurements, holdout) == SESSION or np.ptp(own) == 0.0:
        return conditions
    return replace(conditions, time=(other - own.min()) / np.ptp(own) - 0.5)


def transfer_of(measurements: Measurements, holdout: Measurements) -> str:
    """Kind of transfer that a hold-out tests, judged by the order of measurement.

    An order number identifies one row of a session, so numbers that occur in both mean two sessions; so does a pause
    between them that is longer than the data.
    """
    own, other = measurements.order, holdout.order
    if own is None or other is None:
        return OTHER_ROWS
    pause = max(other.min() - own.max(), own.min() - other.max())
    if len(np.intersect1d(own, other)) or pause > np.ptp(own):
        return SESSION
    if other.min() > own.max():
        return "a later time"
    return "an earlier time" if other.max() < own.min() else "other postures"


def gap_of(before: Array, after: Array, there: HeldOut | None, floor: NoiseFloor) -> Gap:
    """The gap from residuals (m, d) [mm] before and after, and from the held-out rows if there are any."""
    own = rms_distance(before), rms_distance(after), floor
    if there is None:
        return Gap(*own)
    squares = (np.mean(there.before), np.mean(there.after), there.predicted.value)
    return Gap(*own, *(float(np.sqrt(square)) for square in squares))


def confirmation_of(measurements: Measurements, holdout: Measurements, there: HeldOut, named: bool) -> Confirmation:
    """Test the named model on the hold-out;  named : False if nothing was named."""
    every, transfer = np.ones(len(holdout), dtype=bool), transfer_of(measurements, holdout)
    found = confirm(there, groups_of(holdout, every), transfer, named=named)
    file = holdout.provenance.get("file") if transfer == SESSION else None
    return replace(found, file=file, refitted=there.refitted)


def held_out(
    base: Fit,
    named: Fit | PredictingModel,
    measurements: Measurements,
    kept: NDArray[np.bool_],
    holdout: Measurements,
    mismatch: float = 0.0,
) -> HeldOut:
    """Squared residuals of two models in the hold-out, and the mean expected of the named one.

    kept : (m,) rows of the data that are no outliers
    mismatch : mean square distance [mm^2] due to a possibly wrong choice of effects
    """
    there = held_out_conditions(measurements, holdout)
    before, after, set_up = placed_residuals(base, named, measurements, holdout)
    own = np.square(named.position_residuals(measurements, measurements.conditions)[kept, POINT]).sum(axis=1)
    white = 2.0 * float(np.mean(own)) ** 2 / max(named.freedom, 1)  # the variance that white Gaussian noise gives
    left = mean_of(own, groups_of(measurements, kept), white)
    # parameters are fitted to their own rows, so residuals in new rows are larger
    scale = len(own) * named.model.dimension / max(named.freedom, 1)
    added = parameter_part(named, holdout, there)
    return HeldOut(
        np.square(before).sum(axis=1),
        np.square(after).sum(axis=1),
        Mean(scale * left.value + added.value + mismatch, scale**2 * left.variance + added.variance, left.freedom),
        np.square(before - after).sum(axis=1),
        float(np.sqrt(scale * left.value / before.shape[1])),
        before.shape[1],
        set_up.words,
    )


def placed_residuals(
    base: Fit, named: Fit | PredictingModel, measurements: Measurements, holdout: Measurements
) -> tuple[Array, Array, SetUp]:
    """(m, d) residuals [mm] of both models in a hold-out, and what another set-up of it has had refitted: the least
    that the second model needs, the same for both."""
    there, (_, fresh) = held_out_conditions(measurements, holdout), point_names(measurements, holdout)
    renamed = not {*holdout.marker_names} <= {*measurements.marker_names}
    elsewhere = renamed or transfer_of(measurements, holdout) in (SESSION, OTHER_ROWS)
    names = np.full(len(holdout), "") if holdout.marker is None else np.asarray(holdout.marker)

    def predicted(fit: Fit | PredictingModel) -> Predicted:
        left = fit.position_residuals(holdout, there)[:, POINT]
        measured, axes = holdout.positions[:, POINT], None
        if fit.model.arm.chain is not None and fit.model.arm.chain.instrument.whole:
            sizes = widths(holdout.links, len(left.T))
            first = sum([*sizes.values()][: [*sizes].index("tool")])
            axes = fit.model.place_levers(holdout.postures, fit.values, there)[0][:, POINT, first : first + len(left.T)]
        return Predicted(measured - left, axes, measured, fit.model.reach, names)

    own = predicted(named)
    set_up = set_up_of(own, fresh, elsewhere)
    return predicted(base).residuals(set_up), own.residuals(set_up), set_up


def other_set_up(there: HeldOut | None) -> list[str]:
    """A sentence about what another set-up of the hold-out has had refitted, if anything."""
    if there is None or not there.refitted:
        return []
    return [f"the hold-out is of another set-up: {' and '.join(there.refitted)} refitted to its rows, for both models"]


def groups_of(measurements: Measurements, kept: NDArray[np.bool_]) -> tuple[Groups, Groups]:
    """Groups of rows that count as independent, among the kept rows: by time and by region, see `groupings`."""
    turn = np.empty(len(measurements))
    turn[measurements.sequence] = np.arange(len(measurements))
    return groupings(measurements.postures[kept], measurements.posture_numbers[kept], turn[kept])


def parameter_part(found: Fit | PredictingModel, rows: Measurements, there: Conditions) -> Mean:
    """Mean square distance [mm^2] in other rows due to errors of the parameters.

    With G = mean of J_i^T J_i over the rows and C the covariance, the mean of |J_i e|^2 is e^T G e: its expectation is
    tr(G C), its variance 2 tr(G C G C).
    """
    columns, covariance = found.uncertain(rows.postures, there)
    tall = columns[:, POINT].reshape(-1, columns.shape[-1])
    product = tall.T @ tall / len(rows) @ covariance
    return Mean(float(np.trace(product)), 2.0 * float(np.trace(product @ product)), np.inf)


def check_same_arm(base: Fit, measurements: Measurements, holdout: Measurements) -> None:
    """Raise `InputError` for a hold-out whose residuals are larger than any missing effect could make them, also where
    it may be of another set-up and that is refitted.

    The limit is the larger of ten times the expected residual of the base model and a hundredth of the reach: another
    payload or part of the workspace stays below it; other links do not.
    """
    there = held_out_conditions(measurements, holdout)
    left = distances(base.position_residuals(measurements, measurements.conditions)) ** 2
    expected = float(np.sqrt(np.mean(left) + parameter_part(base, holdout, there).value))
    limit = max(10.0 * expected, 0.01 * base.model.reach)
    # the median, since a few outliers do not make it another arm
    residuals, _, set_up = placed_residuals(base, base, measurements, holdout)
    missed = float(np.median(distances(residuals)))
    if missed > limit:
        refitted = f", {' and '.join(set_up.words)} refitted to these rows" if set_up.words else ""
        raise InputError(
            f"holdout: median residual {missed:.3g} mm with the arm calibrated on the data{refitted}, allowed: up to "
            f"{limit:.3g} mm; another arm or unit? armcal check tells what the columns of the file look like"
        )


def _distance_to_data(measurements: Measurements, holdout: Measurements) -> Array:
    """(m,) maximum difference from the most similar row of the data, in units of 1e-5 rad and 1e-3 mm."""
    from scipy.spatial import KDTree

    data, rows = (np.column_stack([d.postures / 1e-5, d.positions / 1e-3]) for d in (measurements, holdout))
    return np.asarray(KDTree(data).query(rows, p=np.inf)[0])


def split(
    measurements: Measurements, share: float, generator: np.random.Generator
) -> tuple[Measurements, Measurements]:
    """Split into data and hold-out: random postures with about this share of the rows, each with all its repeats.

    share : between 0 and 1

    Raises `InputError` for any other share, and for rows of a single posture.
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
    """Raise `InputError` for a hold-out of another arm, or one that contains rows of the data."""
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
