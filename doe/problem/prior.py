"""What is known before the new runs, added to every information matrix: earlier measurements, typical sizes.

Let K be the sum of B^T B of the k runs measured already. A parameter that is normal beforehand with the standard
deviation d adds sigma^2 / (s d)^2 to the diagonal of K, s its scale, and no run. Then m new runs have the information
per run

    M = (sum_i B_i^T B_i + K) / (m + k)

and per new run, with K / m and k / m in place of K and k, weights that sum to one give the same M. It stays a convex
mixture of the matrices F_i = (B_i^T B_i + K) / (1 + k), so that the equivalence theorem holds as it stands.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from identification.arrays import Array, readonly
from identification.errors import InputError
from identification.information import information_matrix
from identification.kinematics.parameters import ParameterSet
from identification.vectorize import PART

NEEDS_SIGMA = (  # the end of a sentence
    "needs the instrument's scatter: add to the arm file the line [measurement] and below it sigma_mm = 0.05, "
    "or what the standard deviation of one coordinate is [mm]"
)


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Information known before the new runs: K and k of the module's formula.

    total : (p, p) sum of B^T B, positive semidefinite, or 0;  runs : how many runs it counts as, >= 0
    """

    total: Array = field(default_factory=lambda: np.zeros(()))
    runs: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "total", readonly(self.total))

    @property
    def empty(self) -> bool:
        """True if nothing is known."""
        return self.runs == 0.0 and not self.total.any()

    @property
    def new_fraction(self) -> float:
        """1 / (1 + k), of a mean over new runs, with the prior per new run."""
        return 1.0 / (1.0 + self.runs)

    def per_new_run(self, new_runs: int | None = None) -> PriorInformation:
        """K / m and k / m. Raises `InputError` where something is known and `new_runs`, m, is no number >= 1."""
        if self.empty:
            return self
        if new_runs is None or new_runs < 1:
            raise InputError(f"runs: {new_runs}, allowed: >= 1, the number of new runs beside what is known already")
        return PriorInformation(self.total / new_runs, self.runs / new_runs)

    def information(self, new: Array, new_runs: float = 1.0) -> Array:
        """(..., p, p) M of new runs whose B^T B sum to `new`; or of a weighted mean, with the prior per new run."""
        return np.asarray((new + self.total) / (new_runs + self.runs))

    def mixture(self, jacobians: Array, weights: Array) -> Array:
        """(p, p) M of (j, d, p) scaled Jacobians with weights (j,) that sum to one, with the prior per new run."""
        parts = (slice(k, k + PART) for k in range(0, len(jacobians), PART))
        return self.information(sum((information_matrix(jacobians[k], weights[k]) for k in parts), np.zeros(())))

    def posture_information(self, jacobians: Array) -> Array:
        """(j, p, p) F_i, what a design with all its weight on one posture would have."""
        return self.information(np.swapaxes(jacobians, 1, 2) @ jacobians)

    def sensitivities(self, jacobians: Array, gradient: Array) -> Array:
        """(j,) tr(G F_i) of (j, d, p) scaled Jacobians; the literature calls it d for G = M^-1."""
        return self.mixed(np.einsum("kda,kda->k", jacobians @ gradient, jacobians), gradient)

    def mixed(self, values: Array, gradient: Array) -> Array:
        """tr(G F) of values tr(G B^T B)."""
        return np.asarray((values + float(np.sum(gradient * self.total))) / (1.0 + self.runs))


def precisions(parameters: ParameterSet, deviations: Mapping[str, float], sigma: float | None) -> Array:
    """(p,) diagonal of what normal distributions beforehand add to sum B^T B; 0 for parameters without a deviation.

    deviations : parameter name -> standard deviation [API unit];  sigma : of a measured coordinate [mm]
    Raises `InputError` for unknown names, deviations that are not > 0, and where sigma is not known.
    """
    sizes = np.full(len(parameters), np.inf)
    for name, deviation in deviations.items():
        if not 0.0 < deviation < np.inf:
            raise InputError(f"deviations: {name} has {deviation:g}, allowed: a finite number > 0")
        sizes[parameters.index(name)] = deviation
    if deviations and sigma is None:
        raise InputError(f"a prior {NEEDS_SIGMA}")
    return readonly(((sigma or 0.0) / (parameters.scales * sizes)) ** 2)
