"""`fit`: least squares of one model to whitened rows within physical bounds, and quantities derived from the fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, levenberg_marquardt
from identification.estimation.methods import starts
from identification.estimation.plausibility import FAR
from identification.estimation.prior import Prior, effective_count
from identification.estimation.problem import Problem
from identification.gap.fits.whitening import Rows
from identification.information import Spectrum, column_space, spectrum
from identification.measurements import Conditions, Measurements, rms_distance
from identification.model import Model
from identification.status import Status

Linearization = Callable[[Array], tuple[Array, Array]]  # (p,) parameters -> positions (m, d), Jacobian (m, d, p)


@dataclass(frozen=True)
class Fit:
    """A model fitted to m rows, in N = m d whitened coordinates. The (N, p) Jacobian is not stored: many fits are kept.

    rows : data of the fit;  values : (p,) parameters [API units];  residual : (N,) whitened
    triangle : (p, p) or (N, p) matrix R with R^T R = J^T J for the whitened Jacobian J
    free : (p,) False where a bound is active;  count : number of values estimated, less than p with ties
    prior_rows : (r, p) rows of the prior, in units of the noise (see `Prior.rows`); None without a prior
    """

    model: Model
    rows: Rows
    values: Array
    residual: Array
    triangle: Array
    free: NDArray[np.bool_]
    count: int
    status: Status
    prior_rows: Array | None = None

    @property
    def squares(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.residual @ self.residual)

    @property
    def left(self) -> Array:
        """(m, d) measured less computed positions [mm] of the rows of the fit, not whitened."""
        return self.position_residuals(self.rows, self.rows.conditions)

    @property
    def jacobian(self) -> Array:
        """(N, p) derivative of the whitened positions with respect to the parameters."""
        return self.rows.whiten(self.model.jacobian(self.rows.postures, self.values, self.rows.conditions))

    @property
    def basis(self) -> Array:
        """(N, rank) orthonormal basis of the Jacobian's columns."""
        return column_space(self.jacobian, self.model.scales)

    @cached_property
    def rank(self) -> int:
        """Number of parameter combinations that the data determine."""
        return int(column_space(self.triangle, self.model.scales).shape[1])

    @cached_property
    def effective(self) -> float:
        """Effective number of parameters: the rank, less the part determined by the prior."""
        return self.rank if self.prior_rows is None else effective_count(self.triangle, self.prior_rows)

    @property
    def freedom(self) -> int:
        """Residual degrees of freedom; parameter combinations that the data do not determine cost none."""
        return len(self.residual) - round(self.effective)

    @property
    def sigma(self) -> float:
        """Scale of the noise [mm] estimated from the residuals."""
        return float(np.sqrt(self.squares / max(len(self.residual) - self.effective, 1.0)))

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return self.model.parameters.mapping(self.values)

    def position_residuals(self, measurements: Measurements | Rows, conditions: Conditions) -> Array:
        """(m, d) measured less computed positions [mm], not whitened, of these rows or of others."""
        position, _ = self.model.linearize(measurements.postures, self.values, conditions)
        return measurements.positions - position

    def covariance(self, bounded: bool = True) -> Array:
        """(p, p) covariance of the estimates [unit of row x unit of column].

        bounded : True for predictions: a parameter with an active bound counts as known, its row and column are zero;
            False for intervals: computed as if there were no bounds
        """
        free = self.free if bounded else np.ones(len(self.values), dtype=bool)
        full = np.zeros((len(self.values), len(self.values)))
        full[np.ix_(free, free)] = self.sigma**2 * self._spectrum(free).covariance
        return full

    def regression(self) -> tuple[Array, Array, Array]:
        """The model linearized at the fit, without parameters at a bound: (m, d, q) columns, not whitened; (k, q) rows
        of the prior in units of the whitened noise, and (k,) their residuals."""
        scales = self.model.scales[self.free]
        columns = self.model.jacobian(self.rows.postures, self.values, self.rows.conditions)[:, :, self.free] / scales
        if self.prior_rows is None:
            return columns, np.zeros((0, len(scales))), np.zeros(0)
        return columns, self.prior_rows[:, self.free] / scales, -self.prior_rows @ self.values

    def uncertain(self, postures: Array, conditions: Conditions) -> tuple[Array, Array]:
        """(m, d, q) derivative of the positions with respect to the q estimates, and their (q, q) covariance."""
        return self.model.jacobian(postures, self.values, conditions), self.covariance()

    def _spectrum(self, free: NDArray[np.bool_]) -> Spectrum:
        rows = self.triangle if self.prior_rows is None else np.concatenate([self.triangle, self.prior_rows])
        return spectrum(rows[:, free], self.model.scales[free])


def fit(
    model: Model,
    rows: Rows,
    start: Mapping[str, float] | None = None,
    ties: Sequence[Sequence[str]] = (),
    prior: Prior | None = None,
    noise: float = 1.0,
) -> Fit:
    """Fit a model to whitened rows by least squares within the bounds of its parameters.

    start : parameter name -> value, zero where missing; None: as `estimation.methods.starts` finds it
    ties : groups of parameters that share one value
    prior : of the parameters;  noise : scale of the whitened residuals [mm] against which the prior is weighted
    """
    weights = np.ones(len(rows))
    plain = Problem(model, rows.postures, rows.conditions, rows.positions[None], weights, prior=prior, noise=noise)
    at = _linearization(model, rows)

    def linearize(values: Array, _: Index) -> tuple[Array, Array]:
        position, jacobian = at(values[0])
        return rows.whiten(rows.positions - position)[None], rows.whiten(jacobian)[None]

    def with_prior(values: Array, index: Index) -> tuple[Array, Array]:
        residual, jacobian = linearize(values, index)
        if prior is None:
            return residual, jacobian
        more = plain.prior_rows
        return np.hstack([residual, -values @ more.T]), np.concatenate([jacobian, more[None]], axis=1)

    problem, spread = replace(plain.least_squares, linearize=with_prior).tied(
        [[model.parameters.index(name) for name in group] for group in ties]
    )
    values = starts(plain)[0] if start is None else _better_start(plain, model.parameters.vector(start), at)
    found = levenberg_marquardt(problem, values[None, np.argmax(spread, axis=0)])
    values = spread @ found.parameters[0]
    residual, jacobian = linearize(values[None], np.arange(1))
    free = spread @ ~found.active[0] > 0.0
    prior_rows = None if prior is None else plain.prior_rows
    triangle = np.asarray(np.linalg.qr(jacobian[0], mode="r"))
    return Fit(model, rows, values, residual[0], triangle, free, spread.shape[1], found.status[0], prior_rows)


def _linearization(model: Model, rows: Rows) -> Linearization:
    """Function of parameters (p,) -> positions and Jacobian; the last result is cached, as it is needed twice."""
    last: dict[bytes, tuple[Array, Array]] = {}

    def at(values: Array) -> tuple[Array, Array]:
        if (key := values.tobytes()) not in last:
            last.clear()
            last[key] = model.linearize(rows.postures, values, rows.conditions)
        return last[key]

    return at


def _better_start(problem: Problem, values: Array, at: Linearization) -> Array:
    """(p,) the start, or the closed form's where that is far better: with a base offset it holds in any frame.

    at : positions and Jacobian; used here because compiling a second function would take longer than the fit
    """

    def left(there: Array) -> float:
        return rms_distance(problem.positions[0] - at(there)[0])

    if left(values) <= FAR * problem.model.reach:
        return values
    closed = starts(problem)[0]
    return closed if left(closed) < left(values) else values
