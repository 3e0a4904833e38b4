"""I-optimality: the accuracy after compensation at the poses that matter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from doe.criteria.inverse_trace import InverseTrace
from identification.arrays import Array, readonly


@dataclass(frozen=True)
class I(InverseTrace):  # noqa: E742 (its name in the literature)
    """Mean squared position error at test poses after compensation (Klimchik's test-pose criterion).

    After m runs with noise sigma per coordinate, -Phi sigma^2 / m is the mean over the poses of E |error|^2 [mm^2]:
    Phi = -tr(W M^-1) with W = mean of B_0^T B_0. Invariant to units.

    jacobians : (k, d, p) scaled Jacobians at the test poses, `DesignProblem.scaled_jacobians(poses)`
    """

    jacobians: Array
    name: str = "I"

    def __post_init__(self) -> None:
        object.__setattr__(self, "jacobians", readonly(self.jacobians))

    @cached_property
    def _weight(self) -> Array:
        return np.mean(np.swapaxes(self.jacobians, -1, -2) @ self.jacobians, axis=0)

    def weight(self, parameters: int) -> Array:
        """(p, p) mean of B_0^T B_0."""
        return self._weight
