"""A model fitted to whitened rows within its physical bounds, and what follows from the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, levenberg_marquardt
from identification.estimation.methods import starts
from identification.estimation.problem import Problem
from identification.gap.whitening import Rows
from identification.information import Spectrum, column_space, spectrum
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.status import Status


@dataclass(frozen=True)
class Fit:
    """A fitted model, in whitened coordinates (N = m d).

    values : (p,) parameters;  residual : (N,);  jacobian : (N, p);  free : (p,) no bound is active
    count : number of values estimated, fewer than p if some are tied to be equal
    """

    model: Model
    values: Array
    residual: Array
    jacobian: Array
    free: NDArray[np.bool_]
    count: int
    status: Status

    @property
    def squares(self) -> float:
        """Sum of squared whitened residuals."""
        return float(self.residual @ self.residual)

    @cached_property
    def basis(self) -> Array:
        """(N, rank) orthonormal basis of the Jacobian's columns."""
        return column_space(self.jacobian, self.model.scales)

    @property
    def rank(self) -> int:
        """Number of parameter combinations that the data determine."""
        return int(self.basis.shape[1])

    @property
    def freedom(self) -> int:
        """Degrees of freedom left; directions that the data do not determine cost none."""
        return len(self.residual) - self.rank

    @property
    def sigma(self) -> float:
        """Scale of the noise [mm] estimated from the residuals."""
        return float(np.sqrt(self.squares / max(self.freedom, 1)))

    @property
    def by_name(self) -> dict[str, float]:
        """Parameter name -> value."""
        return self.model.parameters.mapping(self.values)

    def position_residuals(self, measurements: Measurements, conditions: Conditions) -> Array:
        """(m, d) measured less computed positions [mm], not whitened, of these rows or of others."""
        return measurements.positions - self.model.position(measurements.postures, self.values, conditions)

    def covariance(self, bounded: bool = True) -> Array:
        """(p, p) of the estimates, [unit of row x unit of column].

        bounded : parameters with an active bound count as known, their rows and columns are zero, which suits
        predictions; False: as without bounds, which suits intervals: an active bound hides the value behind it
        """
        free = self.free if bounded else np.ones(len(self.values), dtype=bool)
        full = np.zeros((len(self.values), len(self.values)))
        full[np.ix_(free, free)] = self.sigma**2 * self._spectrum(free).covariance
        return full

    def _spectrum(self, free: NDArray[np.bool_]) -> Spectrum:
        return spectrum(self.jacobian[:, free], self.model.scales[free])


def fit(model: Model, rows: Rows, start: Mapping[str, float] | None = None, ties: Sequence[Sequence[str]] = ()) -> Fit:
    """Least squares within the parameters' bounds.

    start : parameter name -> value, zero where missing; None: see `estimation.methods.starts`
    ties : groups of parameters that are equal
    """
    plain = Problem(model, rows.postures, rows.conditions, rows.positions[None], np.ones(len(rows)))

    def linearize(values: Array, _: Index) -> tuple[Array, Array]:
        position, jacobian = model.linearize(rows.postures, values[0], rows.conditions)
        return rows.whiten(rows.positions - position)[None], rows.whiten(jacobian)[None]

    problem, spread = replace(plain.least_squares, linearize=linearize).tied(
        [[model.parameters.index(name) for name in group] for group in ties]
    )
    values = starts(plain)[0] if start is None else model.parameters.vector(start)
    found = levenberg_marquardt(problem, values[None, np.argmax(spread, axis=0)])
    values = spread @ found.parameters[0]
    residual, jacobian = linearize(values[None], np.arange(1))
    free = spread @ ~found.active[0] > 0.0
    return Fit(model, values, residual[0], jacobian[0], free, spread.shape[1], found.status[0])
