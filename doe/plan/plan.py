"""A plan: the postures to measure, in the order of measurement, or an approximate design with weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array, ByValue, readonly


@dataclass(frozen=True, eq=False)
class Plan(ByValue):
    """m postures of an n-link arm.

    postures : (m, n) joint angles [rad]
    weights : (m,) shares of the measurements, summing to one, None: an exact plan, every row is one measurement
    """

    postures: Array
    weights: Array | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "postures", readonly(np.atleast_2d(self.postures)))
        if self.weights is not None:
            object.__setattr__(self, "weights", readonly(self.weights))

    def __len__(self) -> int:
        return len(self.postures)

    @property
    def links(self) -> int:
        """n, the number of joints."""
        return int(self.postures.shape[1])

    @property
    def shares(self) -> Array:
        """(m,) weight of every posture; 1/m for an exact plan."""
        return np.full(len(self), 1.0 / len(self)) if self.weights is None else self.weights
