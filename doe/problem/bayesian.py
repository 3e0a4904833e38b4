"""Designs for an arm whose parameters are not known yet: good on average, or at worst, over a prior.

Effects make the Jacobian depend on the parameters, so one guess may give a plan that is poor for the real arm. Draw K
parameter vectors from the prior and measure, in thought, K arms at once: the block of a posture is the block-diagonal
matrix of the K blocks, and so is the information matrix. Then log det M = sum_k log det M_k, so that D-optimality of
this model IS the average over the prior, and `Worst` looks at the smallest of the M_k. Solvers, relaxation, column
generation and certificates need no change: it is a model like any other, with d K coordinates and p K parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from doe.criteria import Criterion, D
from doe.criteria.bayesian import Average, Worst
from doe.problem.problem import DesignProblem
from identification.arrays import Array, readonly
from identification.errors import InputError, nearest
from identification.model import Model
from identification.vectorize import vectorize

KINDS = ("average", "worst")


@dataclass(frozen=True)
class EnsembleModel:
    """K arms measured at the same postures. draws : (K, p) parameter vectors [mm, rad]."""

    model: Model
    draws: Array

    def __post_init__(self) -> None:
        draws = readonly(np.atleast_2d(self.draws))
        if draws.shape[1] != len(self.model.names) or not np.all(np.isfinite(draws)):
            raise InputError(f"draws: shape {draws.shape}, allowed: (K, {len(self.model.names)}) finite numbers")
        object.__setattr__(self, "draws", draws)

    @property
    def names(self) -> tuple[str, ...]:
        """(K p) names, with the number of the draw."""
        return tuple(f"{name} [draw {k + 1}]" for k in range(len(self.draws)) for name in self.model.names)

    @property
    def scales(self) -> Array:
        """(K p) as of the model."""
        return np.tile(self.model.scales, len(self.draws))

    @property
    def dimension(self) -> int:
        """K d coordinates per posture."""
        return self.model.dimension * len(self.draws)

    @property
    def values(self) -> Array:
        """(K p) the draws."""
        return self.draws.ravel()

    @property
    def neutral_conditions(self) -> Array:
        """As of the model."""
        return self.model.neutral_conditions

    @cached_property
    def jacobian_function(self) -> ca.Function:
        """CasADi (q, c, draws) -> positions (K d) and block-diagonal Jacobian (K d, K p)."""
        inner = self.model.jacobian_function
        q, c = ca.SX.sym("q", inner.size1_in(0)), ca.SX.sym("c", inner.size1_in(1))
        p = ca.SX.sym("p", self.draws.size)
        each = [inner(q, c, part) for part in ca.vertsplit(p, self.draws.shape[1])]
        outputs = [ca.vertcat(*(position for position, _ in each)), ca.diagcat(*(jacobian for _, jacobian in each))]
        return ca.Function("uncertain", [q, c, p], ca.cse(outputs))

    @cached_property
    def _jacobian(self) -> Callable[..., tuple[np.ndarray, ...]]:
        return vectorize(self.jacobian_function)

    def jacobian(self, postures: ArrayLike, parameters: Any = None, conditions: Any = None) -> Array:
        """(..., K d, K p) block-diagonal Jacobians of postures (..., n)."""
        values = self.values if parameters is None else np.asarray(parameters, dtype=float)
        table = self.neutral_conditions if conditions is None else conditions
        return np.asarray(self._jacobian(np.asarray(postures, dtype=float), table, values)[1])


def prior_draws(
    model: Model, count: int, generator: np.random.Generator, *, length: float = 1.0, angle: float = np.radians(0.5)
) -> Array:
    """(count, p) parameter vectors around the best known values.

    With a calibration that has a covariance of the same parameters, from it; else independent normal deviations:
    lengths of `length` [mm], everything else such that it moves the tip as `angle` [rad] does at its joint.
    """
    calibration = model.arm.calibration
    if calibration is not None and calibration.covariance is not None and calibration.parameter_names == model.names:
        return generator.multivariate_normal(model.values, calibration.covariance, count, method="eigh")
    reach = float(np.mean(model.arm.lengths))
    moved = np.array(
        [length if p.unit == "mm" else angle * (1.0 if p.unit == "rad" else reach / p.scale) for p in model.parameters]
    )
    drawn = model.values + moved * generator.standard_normal((count, len(moved)))
    return np.clip(drawn, [p.lower for p in model.parameters], [p.upper for p in model.parameters])


def ensemble_problem(problem: DesignProblem, draws: Array, kind: str = "average") -> DesignProblem:
    """The same design space for an uncertain arm: D-optimal on `average`, or at `worst`, over the draws (K, p).

    Raises `InputError` for another kind, a problem whose criterion is not D, draws of the wrong shape.
    """
    if kind not in KINDS:
        raise InputError(f"uncertain: unknown kind {kind!r}, {nearest(kind, KINDS)}")
    if not isinstance(problem.criterion, D):
        raise InputError(f"criterion: {problem.criterion.name} for an uncertain arm, allowed: D")
    if not isinstance(problem.model, Model):
        raise InputError("uncertain: the model is one of several arms already, allowed: the model of one arm")
    model = EnsembleModel(problem.model, draws)
    criterion: Criterion = (Average if kind == "average" else Worst)(len(model.draws))
    return replace(problem, model=model, criterion=criterion)
