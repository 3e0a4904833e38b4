"""Polynomial regression as an information model: textbook optima, one measured coordinate, no arm anywhere."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from doe import DesignProblem
from identification import Array, Parameter, ParameterSet


@dataclass(frozen=True)
class Regression:
    """y = sum_k b_k x^k, k = 0..degree: the row of sensitivities at x is (1, x, .., x^degree)."""

    degree: int
    dimension: int = 1

    joint_types: tuple[str, ...] = ("revolute",)
    sigma: None = None
    lower: Array = field(default_factory=lambda: np.array([-1.0]))
    upper: Array = field(default_factory=lambda: np.array([1.0]))
    prior = MappingProxyType[str, float]({})

    @property
    def parameters(self) -> ParameterSet:
        return ParameterSet(Parameter(f"b{k}", "1") for k in range(self.degree + 1))

    @property
    def values(self) -> Array:
        return np.zeros(self.degree + 1)

    def symbolic_position(self, q: ca.SX, p: ca.SX) -> ca.SX:
        return ca.dot(ca.vertcat(*(q**k for k in range(self.degree + 1))), p)


def regression(degree: int, **changes: Any) -> DesignProblem:
    """The design problem on [-1, 1]."""
    return DesignProblem(Regression(degree), **changes)
