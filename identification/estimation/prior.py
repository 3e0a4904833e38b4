"""What is known of parameters before the data: a normal distribution, as extra rows of the least-squares problem.

Independent ones of zero mean and standard deviations d_k each add one residual (0 - x_k) / d_k, in units of the noise;
an earlier calibration, mean x_0 and covariance L L^T, adds the residuals L^-1 (x_0 - x). The minimum is the mode of the
posterior, and the inverse of the normal matrix with these rows its covariance (for a linear model both exactly: ridge
regression; A. E. Hoerl, R. W. Kennard, 1970).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError
from identification.kinematics.parameters import ParameterSet

SURE = 1e-12  # of the largest eigenvalue of the correlations: combinations known better are held as well as this


@dataclass(frozen=True, eq=False)
class Earlier(ByValue):
    """A normal distribution of k parameters, as an earlier calibration left them.

    values : (k,) means;  covariance : (k, k), its diagonal > 0 [API units]
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        for name in ("values", "covariance"):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        for name, variance in zip(self.names, np.diag(self.covariance).tolist(), strict=True):
            if not 0.0 < variance < np.inf:
                raise InputError(f"prior: {name} has variance {variance:g}, allowed: a finite number > 0")

    def about(self, names: Collection[str]) -> Earlier:
        """Of some of the parameters, whatever the others are."""
        kept = [k for k, name in enumerate(self.names) if name in names]
        chosen = tuple(self.names[k] for k in kept)
        return Earlier(chosen, self.values[kept], self.covariance[np.ix_(kept, kept)])

    def conditioned_on(self, values: Mapping[str, float]) -> Earlier:
        """Of the others, where some of the parameters have these values."""
        named = np.array([name in values for name in self.names], dtype=bool)
        crossed, among = self.covariance[np.ix_(~named, named)], self.covariance[np.ix_(named, named)]
        off = np.array([values[name] for name in self.names if name in values]) - self.values[named]
        gain = np.linalg.lstsq(among, crossed.T, rcond=None)[0].T
        left = self.covariance[np.ix_(~named, ~named)] - gain @ crossed.T
        free = tuple(name for name in self.names if name not in values)
        return Earlier(free, self.values[~named] + gain @ off, left)

    @property
    def root(self) -> tuple[Array, Array]:
        """(k, k) L with the covariance L L^T, and its inverse."""
        sizes = np.sqrt(np.diag(self.covariance))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(sizes, sizes))
        roots = np.sqrt(np.maximum(values, SURE * values.max(initial=0.0)))
        return sizes[:, None] * vectors * roots, (vectors / roots).T / sizes


@dataclass(frozen=True, eq=False)
class Prior(ByValue):
    """Independent normal distributions of zero mean, and that of an earlier calibration, which comes first.

    deviations : parameter name -> standard deviation > 0 [API unit]; parameters that are not named are free, names
        that a model does not have do not matter
    own_error : standard deviation [mm] of one coordinate of a posture's own error, of which other postures say nothing:
        to a fit it is noise
    """

    deviations: Mapping[str, float]
    earlier: Earlier | None = None
    own_error: float = 0.0

    def __post_init__(self) -> None:
        for name, deviation in self.deviations.items():
            if not 0.0 < deviation < np.inf:
                raise InputError(f"prior: {name} has standard deviation {deviation:g}, allowed: a finite number > 0")
        first = () if self.earlier is None else self.earlier.names
        independent = {name: deviation for name, deviation in self.deviations.items() if name not in first}
        object.__setattr__(self, "deviations", MappingProxyType(independent))

    @property
    def names(self) -> frozenset[str]:
        """Of all parameters that have one."""
        return frozenset(self.deviations) | frozenset(() if self.earlier is None else self.earlier.names)

    def center(self, parameters: ParameterSet) -> Array:
        """(p,) means; zero where there is none."""
        means = {} if self.earlier is None else dict(zip(self.earlier.names, self.earlier.values.tolist(), strict=True))
        return parameters.vector(means, default=0.0)

    def rows(self, parameters: ParameterSet, noise: float = 1.0) -> Array:
        """(r, p) rows for the Jacobian, one for each parameter that has a prior; its residuals are rows @ (center -
        values).

        noise : standard deviation of the other residuals; 1 where those are divided by sigma
        """
        precisions = noise / parameters.vector(self.deviations, default=np.inf)
        return np.concatenate([np.diag(precisions)[precisions > 0.0], noise * self._of_earlier(parameters, 1).T])

    def factor(self, parameters: ParameterSet) -> Array:
        """(p, r) F, with the covariance F F^T, zero where there is no prior."""
        deviations = parameters.vector(self.deviations, default=0.0)
        return np.concatenate([np.diag(deviations)[:, deviations > 0.0], self._of_earlier(parameters, 0)], axis=1)

    def _of_earlier(self, parameters: ParameterSet, inverse: int) -> Array:
        """(p, k) root of the covariance, or the transpose of its inverse, at the places of the parameters."""
        if self.earlier is None:
            return np.zeros((len(parameters), 0))
        here = self.earlier.about(parameters.names)
        root = np.zeros((len(parameters), len(here.names)))
        root[[parameters.index(name) for name in here.names]] = here.root[1].T if inverse else here.root[0]
        return root


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
