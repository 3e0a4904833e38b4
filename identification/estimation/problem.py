"""The least-squares problem that every method solves: weighted residuals of data sets and their Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.levenberg_marquardt import Index, LeastSquares
from identification.estimation.prior import Prior
from identification.estimation.triangle import compressed
from identification.information import RANK_TOLERANCE
from identification.kinematics.closed_form import PlanarClosedForm
from identification.measurements import Conditions, Measurements
from identification.model import Model

ROUNDING = 1e-14  # of a coordinate, after a chain of some ten operations


@dataclass(frozen=True, eq=False)
class Problem:
    """min over the parameters of sum_i w_i |measured_i - position_i|^2 (eq. 3, with weights), for K data sets.

    postures : (m, n) [rad] that all data sets share, with conditions (m,); or (K, m, n), each its own, and (K, m)
    positions : (K, m, d) measured [mm]
    weights : (m,) of the rows, 1/sigma_i^2 where sigma is known
    tolerance : singular values below this share of the largest do not count; along them nothing is estimated
    prior : of the parameters, r rows more;  noise : standard deviation of weighted residuals, 1 where sigma is known
    """

    model: Model
    postures: Array
    conditions: Conditions
    positions: Array
    weights: Array
    tolerance: float = RANK_TOLERANCE
    prior: Prior | None = None
    noise: float = 1.0

    @classmethod
    def of(cls, model: Model, measurements: Measurements, weights: Array) -> Problem:
        """The problem of one data set."""
        positions = measurements.positions[None]
        return cls(model, measurements.postures, measurements.conditions, positions, weights)

    @property
    def exact_form(self) -> PlanarClosedForm | None:
        """The model's closed form if that is the solution; None: there is none, or it is a start only."""
        form = self.model.closed_form
        return form if form is not None and form.exact and self.prior is None else None

    def rows(self, index: Index | NDArray[np.bool_] | slice) -> Problem:
        """The problem of some of the data sets."""
        chosen = replace(self, positions=self.positions[index])
        if self.postures.ndim == 2:
            return chosen
        return replace(chosen, postures=self.postures[index], conditions=self.conditions.rows(index))

    @cached_property
    def root_weights(self) -> Array:
        """(m, 1) square roots of the weights."""
        return np.sqrt(self.weights)[:, None]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """(p,) lower and (p,) upper physical bounds, API units."""
        return self.model.parameters.lower, self.model.parameters.upper

    @cached_property
    def start(self) -> Array:
        """(p,) best known values, moved inside the bounds."""
        return np.clip(self.model.values, *self.bounds)

    @cached_property
    def rounding(self) -> Array:
        """(K,) norms of the weighted residuals that rounding errors of coordinates of this size make."""
        return ROUNDING * np.sqrt(np.einsum("kmd,m->k", self.positions**2, self.weights))

    @cached_property
    def prior_rows(self) -> Array:
        """(r, p) rows of the prior in the Jacobian, see `Prior.rows`."""
        nothing = np.zeros((0, len(self.model.parameters)))
        return nothing if self.prior is None else self.prior.rows(self.model.parameters, self.noise)

    @cached_property
    def prior_center(self) -> Array:
        """(p,) means of the prior, see `Prior.center`."""
        parameters = self.model.parameters
        return np.zeros(len(parameters)) if self.prior is None else self.prior.center(parameters)

    @property
    def least_squares(self) -> LeastSquares:
        """The problem in the solver's form; tall problems are reduced to their QR triangle."""

        def linearize(parameters: Array, index: Index) -> tuple[Array, Array]:
            return compressed(*self.linearize(parameters, index))

        return LeastSquares(linearize, *self.bounds, self.model.scales, self.rounding, self.tolerance)

    def residuals(self, parameters: Array) -> Array:
        """(K, m, d) measured less computed [mm], for parameters (p,) or (K, p)."""
        return self.positions - self.model.position(self.postures, parameters, self.conditions)

    def squares(self, parameters: Array) -> Array:
        """(K,) weighted sums of squares."""
        return np.einsum("kmd,m->k", self.residuals(parameters) ** 2, self.weights)

    def linearize(self, parameters: Array, index: Index) -> tuple[Array, Array]:
        """(k, m d + r) weighted residuals of the data sets numbered (k,) and the (k, m d + r, p) weighted Jacobian."""
        chosen = self if len(index) == len(self.positions) else self.rows(index)
        position, jacobian = self.model.linearize(chosen.postures, parameters, chosen.conditions)
        residuals = self.root_weights * (chosen.positions - position)
        jacobian *= self.root_weights[:, :, None]  # in place: new memory takes as long as the product
        k, m, d, p = jacobian.shape
        residuals, jacobian = residuals.reshape(k, m * d), jacobian.reshape(k, m * d, p)
        if len(rows := self.prior_rows) == 0:
            return residuals, jacobian
        prior_rows = np.broadcast_to(rows, (k, *rows.shape))
        return np.concatenate([residuals, (self.prior_center - parameters) @ rows.T], axis=1), np.concatenate(
            [jacobian, prior_rows], axis=1
        )

    def linearize_at(self, parameters: Array) -> tuple[Array, Array]:
        """(m d + r,) weighted residuals of the first data set and the (m d + r, p) Jacobian, at parameters (p,)."""
        residuals, jacobian = self.linearize(parameters[None], np.arange(1))
        return residuals[0], jacobian[0]

    def jacobian(self, parameters: Array) -> Array:
        """(m d, p) weighted Jacobian of the plan that the data sets share, at parameters (p,), without the prior."""
        jacobian = self.root_weights[:, :, None] * self.model.jacobian(self.postures, parameters, self.conditions)
        return jacobian.reshape(-1, jacobian.shape[-1])
