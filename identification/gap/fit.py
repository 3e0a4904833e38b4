"""The rows of a diagnosis with whitened noise, and models fitted to them within physical bounds.

Only relative values of sigma matter here: every test divides by a scale estimated from the residuals, since a data
sheet's sigma that is 1.5 times too small would make every test significant.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from identification.arm import Arm, Calibration, EffectSpec
from identification.arrays import Array
from identification.effects import Effect
from identification.estimation import estimate, without_outliers
from identification.estimation.doubts import FAR
from identification.estimation.problem import Problem
from identification.information import spectrum
from identification.levenberg_marquardt import Index
from identification.measurements import Conditions, Measurements, rms_distance
from identification.model import Model
from identification.model.placed import PRACTICAL, practical, with_sessions
from identification.running import Status


@dataclass(frozen=True)
class Rows:
    """m measured rows; conditions that follow from the whole session are fixed, so that rows can be left out.

    postures : (m, n) [rad];  positions : (m, d) [mm];  order : (m,) rank of each row in time
    posture_numbers : (m,) equal numbers mark rows of one posture
    spread : (m, d, d) symmetric square root of the relative covariance of each row, None: the same for all
    correlation : lag-1 correlation of the noise between consecutive rows
    sigma : standard deviation [mm] of a whitened coordinate as given by the data, None: not given
    shared : variance that all rows of one posture have in common, relative to that of each row
    """

    postures: Array
    positions: Array
    conditions: Conditions
    order: Array
    posture_numbers: NDArray[np.int64]
    spread: Array | None = None
    correlation: float = 0.0
    sigma: float | None = None
    shared: float = 0.0

    def __len__(self) -> int:
        return len(self.postures)

    @classmethod
    def of(cls, measurements: Measurements) -> Rows:
        """The rows of a data set; a sigma for each row becomes a relative weight."""
        order = np.empty(len(measurements))
        order[measurements.sequence] = np.arange(len(order))  # one session after another
        spread, sigma = None, None
        if measurements.sigma is not None:
            sigma = float(np.exp(np.mean(np.log(measurements.sigma))))
            spread = (measurements.sigma / sigma)[:, None, None] * np.eye(measurements.dimension)
        numbers = np.unique(measurements.posture_numbers, return_inverse=True)[1]
        data = measurements.postures, measurements.positions, measurements.conditions
        return cls(*data, order, numbers, spread, sigma=sigma)

    def pick(self, index: Any) -> Rows:
        """Some of the rows, by index, mask or slice."""
        postures = self.postures[index]
        postures.setflags(write=False)  # models know what they found for the same postures
        return replace(
            self,
            postures=postures,
            positions=self.positions[index],
            conditions=self.conditions.rows(index),
            order=self.order[index],
            posture_numbers=np.unique(self.posture_numbers[index], return_inverse=True)[1],
            spread=None if self.spread is None else self.spread[index],
        )

    @property
    def dimension(self) -> int:
        """d, coordinates per row."""
        return int(self.positions.shape[1])

    @property
    def sequence(self) -> NDArray[np.int64]:
        """(m,) row numbers in the order of measurement."""
        return np.argsort(self.order, kind="stable")

    @property
    def log_determinant(self) -> float:
        """Log determinant of the relative covariance of all m d coordinates."""
        memory = self.dimension * (len(self) - 1) * np.log1p(-(self.correlation**2))
        spread = 0.0 if self.spread is None else 2.0 * np.sum(np.linalg.slogdet(self.spread)[1])
        common = np.log1p(self.shared * np.bincount(self.posture_numbers))
        return float(memory + spread + self.dimension * np.sum(common))

    def whiten(self, values: Array) -> Array:
        """Transform (m, d, ...) to (m d, ...) with white noise; linear, so that it serves residuals and columns."""
        shape, values = values.shape, values.reshape(len(values), self.dimension, -1)
        if self.spread is not None:
            values = np.linalg.inv(self.spread) @ values
        if self.shared:  # the mean over the n rows of each posture is shrunk by (1 + n shared)^(-1/2)
            numbers, counts = self.posture_numbers, np.bincount(self.posture_numbers)
            sums = np.zeros((len(counts), *values.shape[1:]))
            np.add.at(sums, numbers, values)
            values = values - (sums * ((1.0 - (1.0 + counts * self.shared) ** -0.5) / counts)[:, None, None])[numbers]
        if self.correlation:  # from each row what the previous one predicts, for a first-order autoregression
            rho, order = self.correlation, self.sequence
            ordered = values[order] / np.sqrt(1.0 - rho**2)
            ordered[1:] -= rho * ordered[:-1]
            ordered[0] = values[order[0]]
            values = np.empty_like(values)
            values[order] = ordered
        return values.reshape(-1, *shape[2:])


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model with values (p,) of its parameters [API units], and m rows, with N = m d whitened coordinates.

    free : (p,) False where a bound is active, None: nowhere;  status : how the fit to the rows ended, if it is one
    """

    model: Model
    values: Array
    rows: Rows
    free: NDArray[np.bool_] | None = field(default=None, kw_only=True)
    status: Status = field(default=Status.converged, kw_only=True)

    def on(self, rows: Rows) -> Fitted:
        """The same model at other rows, or with another noise."""
        return Fitted(self.model, self.values, rows)

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return self.model.parameters.mapping(self.values)

    @cached_property
    def linearized(self) -> tuple[Array, Array]:
        """(m, d) computed positions [mm] and (m, d, p) their derivatives."""
        return self.model.linearize(self.rows.postures, self.values, self.rows.conditions)

    @cached_property
    def levers(self) -> Array:
        """(m, d, n) of the joints [mm/rad]."""
        return self.model.joint_levers(self.rows.postures, self.values, self.rows.conditions)

    @property
    def errors(self) -> Array:
        """(m, d) measured less computed positions [mm], not whitened."""
        return self.rows.positions - self.linearized[0]

    def columns_of(self, *effects: Effect) -> Index:
        """Numbers of the parameters of these effects among those that are fitted."""
        names = self.model.names
        numbers = [names.index(p.name) for effect in effects for p in effect.parameters if p.name in names]
        return np.array(numbers, dtype=np.int64)

    def residuals(self, measurements: Measurements, conditions: Conditions | None = None) -> Array:
        """(m, d) measured less computed positions [mm] of other rows;  conditions : None: as they say"""
        conditions = measurements.conditions if conditions is None else conditions
        return measurements.positions - self.model.position(measurements.postures, self.values, conditions)

    # -- of a least-squares fit to the rows ------------------------------------------------------------------------
    residual = cached_property(lambda self: self.rows.whiten(self.errors))  # (N,) whitened

    @cached_property
    def jacobian(self) -> Array:
        """(N, p) derivative of the whitened positions with respect to the parameters."""
        return self.rows.whiten(self.linearized[1])

    @cached_property
    def freedom(self) -> int:
        """Residual degrees of freedom; parameter combinations that the data do not determine cost none."""
        return len(self.residual) - spectrum(self.jacobian, self.model.scales).rank

    @cached_property
    def sigma(self) -> float:
        """Scale of the noise [mm] estimated from the residuals."""
        return float(np.linalg.norm(self.residual) / np.sqrt(max(self.freedom, 1)))

    @cached_property
    def covariance(self) -> Array:
        """(p, p) of the estimates [unit of row x unit of column]; a parameter with an active bound counts as known."""
        full, free = np.zeros((len(self.values),) * 2), np.arange(len(self.values))
        free = free if self.free is None else free[self.free]
        full[np.ix_(free, free)] = self.sigma**2 * spectrum(self.jacobian[:, free], self.model.scales[free]).covariance
        return full


def determined(arm: Arm, measurements: Measurements) -> tuple[Arm, tuple[int, ...]]:
    """`practical`, with what so many rows of so little scatter determine, too: three standard errors of a mean. What
    they say less of than its machining does, one such error, stays as drawn, by the sizes that are likeliest in a fit
    with the prior of the machining: free, it would fit noise, and axes that may be anywhere fit contacts of no known
    size best where all pass through what is touched. And rows (from 1) that are outliers of that fit."""
    found, out = without_outliers(lambda rows: estimate(Model(with_sessions(arm, rows)), rows), measurements)
    error = (found.scatter or 0.0) / float(np.sqrt(measurements.positions.size))
    return practical(arm, measurements, float(np.clip(PRACTICAL, error, 3.0 * error)), found.prior.deviations), out


def fitted_arm(
    arm: Arm, measurements: Measurements, specs: Sequence[EffectSpec] = (), left_out: Collection[int] = ()
) -> Arm:
    """The arm with these effects added, none: its geometry only, calibrated by rows that are not `left_out` (from 1),
    whatever a diagnosis would say of them."""
    arm, _ = determined(arm, measurements)
    model = Model(arm.with_effects(*arm.effects, *specs))
    kept = ~np.isin(np.arange(len(measurements)) + 1, list(left_out))
    return replace(model.arm, calibration=Calibration(fit(model, Rows.of(measurements).pick(kept)).by_name))


def fit(model: Model, rows: Rows, start: Mapping[str, float] | None = None) -> Fitted:
    """Fit a model to whitened rows by least squares within the bounds of its parameters.

    start : parameter name -> value, zero where missing; None, or far worse: as `estimation.problem.starts` finds it
    """
    problem = Problem(model, rows.postures, rows.conditions, rows.positions[None], np.ones(len(rows)))

    def linearize(values: Array, _: Index) -> tuple[Array, Array]:
        position, jacobian = model.linearize(rows.postures, values[0], rows.conditions)
        return rows.whiten(rows.positions - position)[None], rows.whiten(jacobian)[None]

    def left(values: Array) -> float:
        return rms_distance(rows.positions - model.position(rows.postures, values, rows.conditions))

    values = None if start is None else model.parameters.vector(start)
    if values is None or left(values) > FAR * model.reach:  # with a base offset the closed form holds in any frame
        closed = problem.starts()[0]
        values = closed if values is None or left(closed) < left(values) else values
    solution = problem.minimized(values[None], linearize)
    return Fitted(model, solution.parameters[0], rows, free=~solution.active[0], status=solution.status[0])
