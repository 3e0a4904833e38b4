"""The arms of the issue's tables."""

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from doe import DesignProblem
from identification import Arm, Array, EffectSpec, Model, Parameter, ParameterSet

FOUR = Arm([260.0, 180.0, 120.0, 100.0], np.radians([-180, -120, -100, -90]), np.radians([180, 120, 60, 90]), 0.1)
FIVE = Arm(
    [260.0, 180.0, 120.0, 100.0, 90.0], np.radians([-180, -100, -140, -60, -110]), np.radians([180, 40, 10, 75, 95])
)
SIX = Arm(
    [260.0, 180.0, 120.0, 100.0, 90.0, 80.0],
    np.radians([-180, -60, -130, -20, -90, -150]),
    np.radians([180, 95, -10, 110, 60, 5]),
)
OFFSET = EffectSpec("base_offset")
ECCENTRICITY = EffectSpec("encoder_eccentricity", 2)


def problem(arm: Arm, *effects: EffectSpec, **changes: object) -> DesignProblem:
    """The design problem of an arm with these effects to estimate."""
    return DesignProblem.of(Model(arm.with_effects(*effects)), **changes)


def random_box(generator: np.random.Generator, links: int) -> Arm:
    """An arm with random limits: narrow, wide and unlimited joints."""
    middle = generator.uniform(-1.0, 1.0, links)
    half = generator.uniform(0.2, 3.1, links)
    return Arm(generator.uniform(50.0, 400.0, links), middle - half, middle + half)


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
