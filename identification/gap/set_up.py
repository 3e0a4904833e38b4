"""A hold-out of other rows, or of another set-up: when it was measured, and what stands elsewhere.

Where base or instrument stand elsewhere, or the measured point is another one, what is predicted of a point y_i with
the axes R_i of the tip for the instrument becomes

    A (y_i + R_i t) + s,    A, s: motion of base or instrument;  t: from the old to the new point, in the tip's frame

These few numbers are found in the hold-out, as `armcal validate` finds them; nothing else of the models is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from identification.arrays import Array
from identification.effects.chain import widths
from identification.estimation.doubts import FALL
from identification.gap.average import PredictingModel
from identification.gap.fit import Fit
from identification.information import RANK_TOLERANCE
from identification.instruments.registration import placed, registered
from identification.measurements import POINT, Conditions, Measurements

SESSION, OTHER_ROWS = "another session", "other rows"


def transfer_of(measurements: Measurements, holdout: Measurements) -> str:
    """Kind of transfer that a hold-out tests, judged by the order of measurement.

    An order number identifies one row of a session, so numbers that occur in both mean two sessions; so does a pause
    between them that is longer than the data.
    """
    ours, other = measurements.order, holdout.order
    if ours is None or other is None:
        return OTHER_ROWS
    pause = max(other.min() - ours.max(), ours.min() - other.max())
    if len(np.intersect1d(ours, other)) or pause > np.ptp(ours):
        return SESSION
    if other.min() > ours.max():
        return "a later time"
    return "an earlier time" if other.max() < ours.min() else "other postures"


def held_out_conditions(measurements: Measurements, holdout: Measurements) -> Conditions:
    """Conditions of the hold-out on the scales of the data.

    Temperatures count from where those of the data do; time is on the scale of the data if both are of one session.
    Measured points have the numbers of the data, those that the data do not have that of the first.
    """
    conditions = replace(holdout.conditions, marker=point_names(measurements, holdout)[0])
    if measurements.temperature is not None and holdout.temperature is not None:
        conditions = replace(conditions, temperature=holdout.temperature - measurements.reference_temperature)
    ours, other = measurements.order, holdout.order
    if ours is None or other is None or transfer_of(measurements, holdout) == SESSION or np.ptp(ours) == 0.0:
        return conditions
    return replace(conditions, time=(other - ours.min()) / np.ptp(ours) - 0.5)


def point_names(measurements: Measurements, holdout: Measurements) -> tuple[Array | None, tuple[str, ...]]:
    """(m,) number of each held-out row's point among those of the data, 0 for others; and the names of these others.

    One point of the data is the one of the hold-out, whatever it is called there, as in an arm file.
    """
    names, numbers = measurements.marker_names, holdout.marker_numbers
    if numbers is None or holdout.marker is None or not names:
        return None, ()
    there = set(holdout.marker.tolist())
    if len(names) == 1 == len(there):
        return np.zeros(len(holdout)), ()
    number = {name: k for k, name in enumerate(names)}
    ours = np.array([number.get(name, 0) for name in holdout.marker_names], dtype=float)
    return ours[numbers], tuple(name for name in holdout.marker_names if name in there and name not in number)


class SetUp(NamedTuple):
    """What is refitted to a hold-out: where base and instrument stand, and measured points by their names."""

    base: bool = False
    points: tuple[str, ...] = ()

    @property
    def words(self) -> tuple[str, ...]:
        """The same in words."""
        return ("base",) * self.base + tuple(f"reflector {name}" if name else "reflector" for name in self.points)


class Predicted(NamedTuple):
    """What a model predicts of the rows of a hold-out.

    points : (m, d) [mm];  axes : (m, 3, 3) of the tip for the instrument, None in a plane and where lengths are read
    measured : (m, d) [mm];  reach : of the arm [mm];  names : (m,) of the measured points, "" where there are none
    """

    points: Array
    axes: Array | None
    measured: Array
    reach: float
    names: NDArray[np.str_]

    @classmethod
    def of(cls, fitted: Fit | PredictingModel, holdout: Measurements, there: Conditions) -> Predicted:
        """By a model;  there : conditions of the rows"""
        left = fitted.position_residuals(holdout, there)[:, POINT]
        measured, chain, axes = holdout.positions[:, POINT], fitted.model.arm.chain, None
        if not chain.planar and chain.instrument.reads_positions:
            sizes = widths(chain)
            first = sum([*sizes.values()][: [*sizes].index("tool")])
            levers = fitted.model.place_levers(holdout.postures, fitted.values, there)[0]
            axes = levers[:, POINT, first : first + len(left.T)]
        names = np.full(len(holdout), "") if holdout.marker is None else np.asarray(holdout.marker)
        return cls(measured - left, axes, measured, fitted.model.reach, names)

    def count(self, set_up: SetUp) -> int:
        """How many values are refitted."""
        return 3 * (self.points.shape[1] - 1) * set_up.base + 3 * len(set_up.points)

    def residuals(self, set_up: SetUp) -> Array:
        """(m, d) measured less predicted [mm], with what is refitted; larger by as much as the values fitted to these
        rows make them smaller."""
        if set_up == SetUp():
            return self.measured - self.points
        left = self._in_plane() if self.axes is None else self._in_space(self.axes, set_up)
        return np.asarray(left * np.sqrt(left.size / max(left.size - self.count(set_up), 1.0)))

    def _in_plane(self) -> Array:
        from_model, goal = (a @ np.array([1.0, 1.0j]) for a in (self.points, self.measured))
        center, target = from_model.mean(), goal.mean()
        turn = np.exp(1.0j * np.angle(np.vdot(from_model - center, goal - target)))
        left = goal - target - turn * (from_model - center)
        return np.column_stack([left.real, left.imag])

    def _in_space(self, axes: Array, set_up: SetUp) -> Array:
        """Everything but the turn A of the base is linear."""
        which = [self.names == name for name in set_up.points]
        shift = np.tile(np.eye(3), (len(axes), 1, 1))

        def left(turn: Array) -> Array:
            columns = [(turn @ axes) * own[:, None, None] for own in which] + [shift] * set_up.base
            table, target = np.concatenate(columns, axis=2), self.measured - self.points @ turn.T
            table = table.reshape(target.size, -1)
            return np.asarray(target.ravel() - table @ np.linalg.lstsq(table, target.ravel(), rcond=RANK_TOLERANCE)[0])

        def turned(by: Array) -> Array:
            return left(Rotation.from_rotvec(by).as_matrix() @ start)

        if not set_up.base:
            return left(np.eye(3)).reshape(self.points.shape)
        same = ~np.any(which, axis=0) if which else np.ones(len(axes), dtype=bool)
        if np.count_nonzero(same) >= 3:
            start = registered(self.points[same], self.measured[same])[:3, :3]
        else:
            most = max(which, key=np.count_nonzero)
            frames = np.tile(np.eye(4), (len(axes), 1, 1))
            frames[:, :3, :3], frames[:, :3, 3] = axes, self.points
            start = placed(frames[most], self.measured[most], self.reach).base[:3, :3]
        return turned(least_squares(turned, np.zeros(3), method="lm").x).reshape(self.points.shape)


def set_up_of(predicted: Predicted, fresh: tuple[str, ...], elsewhere: bool) -> SetUp:
    """The least that has to be refitted: points of names that the data do not have, and where rows may be of another
    set-up (`elsewhere`) what makes the RMS fall by `FALL`."""
    options = [SetUp()]
    if predicted.axes is None:
        options += [SetUp(base=True)] * (elsewhere and predicted.points.shape[1] == 2)
    elif fresh:
        options = [SetUp(points=fresh), SetUp(True, fresh)]
    elif elsewhere:
        every = tuple(dict.fromkeys(predicted.names.tolist()))
        options += [SetUp(points=every), SetUp(base=True), SetUp(True, every)]
    options = [one for one in options if predicted.measured.size > 2 * predicted.count(one)]
    if not options:
        return SetUp(points=fresh)
    squares = [float(np.sum(np.square(predicted.residuals(one)))) for one in options]
    if squares[0] <= FALL**2 * squares[-1]:
        return options[0]
    # one more set of parameters must save a tenth of the RMS error
    return next(one for one, left in zip(options, squares, strict=True) if left <= 1.25 * squares[-1])


def placed_residuals(
    base: Fit, model: Fit | PredictingModel, measurements: Measurements, holdout: Measurements
) -> tuple[Array, Array, tuple[str, ...]]:
    """(m, d) residuals [mm] of both models in a hold-out, and in words what another set-up of it has had refitted: the
    least that the second model needs, the same for both."""
    conditions = held_out_conditions(measurements, holdout)
    renamed = not {*holdout.marker_names} <= {*measurements.marker_names}
    elsewhere = renamed or transfer_of(measurements, holdout) in (SESSION, OTHER_ROWS)
    predicted = Predicted.of(model, holdout, conditions)
    set_up = set_up_of(predicted, point_names(measurements, holdout)[1], elsewhere)
    return Predicted.of(base, holdout, conditions).residuals(set_up), predicted.residuals(set_up), set_up.words
