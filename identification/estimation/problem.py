"""The least-squares problem that every method solves: weighted residuals and their Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.information import RANK_TOLERANCE
from identification.measurements import Conditions, Measurements
from identification.model import Model
from identification.status import Status

ROUNDING = 1e-14  # of a coordinate, after a chain of some ten operations
GRADIENT_TOLERANCE = 1e-9  # stationary: no column of the Jacobian has a cosine with the residuals above this


class Fit(NamedTuple):
    """What a method returns: parameters (p,) in API units, and how it ended."""

    parameters: Array
    status: Status
    iterations: int


@dataclass(frozen=True)
class Problem:
    """min over the parameters of sum_i w_i |measured_i - position_i|^2 (eq. 3, with weights).

    weights : (m,) of the rows, 1/sigma_i^2 where sigma is known
    tolerance : singular values below this share of the largest do not count; along them nothing is estimated
    """

    model: Model
    measurements: Measurements
    weights: Array
    tolerance: float = RANK_TOLERANCE

    def with_tolerance(self, tolerance: float) -> Problem:
        """The same problem with another rank tolerance."""
        return replace(self, tolerance=tolerance)

    @cached_property
    def conditions(self) -> Conditions:
        """What the rows were measured under."""
        return self.measurements.conditions

    @cached_property
    def root_weights(self) -> Array:
        """(m, 1) square roots of the weights."""
        return np.sqrt(self.weights)[:, None]

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """(p,) lower and (p,) upper physical bounds, API units."""
        parameters = self.model.parameters
        return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])

    @cached_property
    def start(self) -> Array:
        """(p,) best known values, moved inside the bounds."""
        return np.clip(self.model.values, *self.bounds)

    @cached_property
    def rounding(self) -> float:
        """Norm of the weighted residuals that rounding errors of coordinates of this size make."""
        return ROUNDING * float(np.linalg.norm(self.root_weights * self.measurements.positions))

    def residuals(self, parameters: Array) -> Array:
        """(2m,) weighted, measured minus computed."""
        position = self.model.position(self.measurements.postures, parameters, self.conditions)
        return (self.root_weights * (self.measurements.positions - position)).ravel()

    def linearize(self, parameters: Array) -> tuple[Array, Array]:
        """(2m,) weighted residuals and (2m, p) weighted Jacobian of the positions."""
        position, jacobian = self.model.linearize(self.measurements.postures, parameters, self.conditions)
        rows = self.root_weights[:, :, None] * jacobian
        return (self.root_weights * (self.measurements.positions - position)).ravel(), rows.reshape(-1, rows.shape[-1])
