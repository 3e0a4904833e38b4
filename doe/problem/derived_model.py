"""Models derived from another one and measured at the same postures: what they inherit, and their Jacobians."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from identification.arrays import Array
from identification.vectorize import vectorize

if TYPE_CHECKING:
    from doe.problem.problem import InformationModel


class DerivedModel:
    """Base class of models that stack the coordinates of another one; subclasses define `jacobian_function`."""

    model: InformationModel

    @property
    def values(self) -> Array:
        """(p,) best known parameters."""
        return self.model.values

    @property
    def joint_types(self) -> tuple[str, ...]:
        """As of the model."""
        return self.model.joint_types

    @property
    def sigma(self) -> float | None:
        """As of the model."""
        return self.model.sigma

    @property
    def neutral_conditions(self) -> Array:
        """As of the model."""
        return self.model.neutral_conditions

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, c, p) -> positions (d) and Jacobian (d, p)."""
        raise NotImplementedError

    @cached_property
    def _jacobian(self) -> Callable[..., tuple[np.ndarray, ...]]:
        return vectorize(self.jacobian_function)

    def jacobian(self, postures: ArrayLike, parameters: Any = None, conditions: Any = None) -> Array:
        """(..., d, p) of postures (..., n)."""
        values = self.values if parameters is None else np.asarray(parameters, dtype=float)
        table = self.neutral_conditions if conditions is None else conditions
        return np.asarray(self._jacobian(np.asarray(postures, dtype=float), table, values)[1])
