"""What is known of parameters before the data: a normal distribution, as extra rows of the least-squares problem.

Zero mean and independent standard deviations d_k: each adds one residual (0 - x_k) / d_k, in units of the noise. The
minimum is the mode of the posterior, and the inverse of the normal matrix with these rows its covariance (for a linear
model both exactly: ridge regression; A. E. Hoerl, R. W. Kennard, 1970).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from identification.arrays import Array, ByValue
from identification.errors import InputError
from identification.kinematics.parameters import ParameterSet


@dataclass(frozen=True, eq=False)
class Prior(ByValue):
    """Independent normal distributions of zero mean.

    deviations : parameter name -> standard deviation > 0 [API unit]; parameters that are not named are free, names
        that a model does not have do not matter
    """

    deviations: Mapping[str, float]

    def __post_init__(self) -> None:
        for name, deviation in self.deviations.items():
            if not 0.0 < deviation < np.inf:
                raise InputError(f"prior: {name} has standard deviation {deviation:g}, allowed: a finite number > 0")
        object.__setattr__(self, "deviations", MappingProxyType(dict(self.deviations)))

    def rows(self, parameters: ParameterSet, noise: float = 1.0) -> Array:
        """(r, p) rows for the Jacobian, one for each parameter that has a deviation; its residuals are -rows @ values.

        noise : standard deviation of the other residuals; 1 where those are divided by sigma
        """
        precisions = noise / parameters.vector(self.deviations, default=np.inf)
        return np.diag(precisions)[precisions > 0.0]


def effective_count(jacobian: Array, rows: Array) -> float:
    """How many of p parameters the data determine, the prior the rest: tr J (J^T J + R^T R)^-1 J^T.

    jacobian : (N, p) of the data alone;  rows : (r, p) of the prior, in the same units
    """
    triangle = np.linalg.qr(np.concatenate([jacobian, rows]), mode="r")
    lengths = np.maximum(np.linalg.norm(triangle, axis=0), np.finfo(float).tiny)
    _, values, right = np.linalg.svd(triangle / lengths, full_matrices=False)
    counted = values > values.max(initial=0.0) * 1e-12
    inverse = right[counted].T / values[counted]
    return float(np.sum(np.square(jacobian / lengths @ inverse)))
