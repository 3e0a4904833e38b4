"""Polynomial regression as an information model: textbook optima, one measured coordinate, no arm anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.kinematics.parameters import Parameter, ParameterSet


@dataclass(frozen=True)
class Regression:
    """y = sum_k b_k x^k, k = 0..degree: the row of sensitivities at x is (1, x, .., x^degree)."""

    degree: int
    dimension: int = 1

    joint_types: tuple[str, ...] = ("revolute",)
    sigma: None = None

    @property
    def parameters(self) -> ParameterSet:
        return ParameterSet.of(Parameter(f"b{k}", "1") for k in range(self.degree + 1))

    @property
    def values(self) -> Array:
        return np.zeros(self.degree + 1)

    @property
    def neutral_conditions(self) -> Array:
        return np.zeros(1)

    @cached_property
    def jacobian_function(self) -> ca.Function:
        x, c, b = ca.SX.sym("x"), ca.SX.sym("c"), ca.SX.sym("b", self.degree + 1)
        row = ca.horzcat(*(x**k for k in range(self.degree + 1)))
        return ca.Function("regression", [x, c, b], [row @ b, row])

    def jacobian(self, postures: ArrayLike, parameters: Any = None, conditions: Any = None) -> Array:
        return np.power.outer(np.asarray(postures)[:, 0], np.arange(self.degree + 1))[:, None, :]


def regression(degree: int, **changes: Any) -> DesignProblem:
    """The design problem on [-1, 1]."""
    return DesignProblem(Regression(degree), np.array([-1.0]), np.array([1.0]), **changes)
