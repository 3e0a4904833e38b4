"""A-optimality: the sum of the variances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.criteria.inverse_trace import InverseTrace
from identification.arrays import Array


@dataclass(frozen=True)
class A(InverseTrace):
    """Sum of the variances of the scaled parameters [mm^2]: angles times link length (doe/README.md, "Criteria").

    Not invariant to units. The paper's reason against it (a constant trace) is about tr M, not tr M^-1.
    """

    name: str = "A"

    def weight(self, parameters: int) -> Array:
        """(p, p) identity."""
        return np.eye(parameters)
