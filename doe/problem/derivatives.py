"""First and second derivatives by the joint angles, of many postures at once: of Jacobians and of constraints.

A criterion needs the second derivatives of a Jacobian only in sums <W, B> over its entries with fixed weights W (d, p),
and its gradient alone needs no more than the slope of such a sum: reverse differentiation gives both at a few times the
cost of B itself, however many entries that has.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.vectorize import vectorize

# postures (m, n) -> values (m, k), first derivatives (m, k, a) and second ones (m, k, a, a) by a of the joints
Derivatives = Callable[[Array], tuple[Array, Array, Array]]


class JacobianDerivatives:
    """Derivatives of the scaled Jacobian B (d, p) by a of the joints; weights W are (m, d, p)."""

    def __init__(self, problem: DesignProblem, joints: Sequence[int]) -> None:
        self._q = ca.SX.sym("q", problem.joints)
        self._jacobian = ca.densify(problem.scaled_jacobian_function(self._q))
        self._weights = ca.SX.sym("w", self._jacobian.numel())
        self._active = self._q[list(joints)]
        self._sum = ca.dot(ca.vec(self._jacobian.T), self._weights)

    def first(self, postures: Array) -> tuple[Array, Array]:
        """B (m, d, p) and its derivatives (m, a, d, p)."""
        jacobian, first = self._first(postures)
        return jacobian, np.moveaxis(first, -1, -2).reshape(*first.shape[:-2], first.shape[-1], *jacobian.shape[-2:])

    def slope(self, postures: Array, weights: Array) -> Array:
        """(m, a) gradients of <W, B>."""
        return self._slope(postures, weights.reshape(len(weights), -1))[0][..., 0]

    def bend(self, postures: Array, weights: Array) -> Array:
        """(m, a, a) Hessians of <W, B>."""
        return self._bend(postures, weights.reshape(len(weights), -1))[0]

    @cached_property
    def _first(self) -> Callable[..., tuple[Array, ...]]:
        outputs = [self._jacobian, ca.densify(ca.jacobian(ca.vec(self._jacobian.T), self._active))]
        return vectorize(ca.Function("first", [self._q], ca.cse(outputs)))

    @cached_property
    def _slope(self) -> Callable[..., tuple[Array, ...]]:
        slope = ca.densify(ca.gradient(self._sum, self._active))
        return vectorize(ca.Function("slope", [self._q, self._weights], [ca.cse(slope)]))

    @cached_property
    def _bend(self) -> Callable[..., tuple[Array, ...]]:
        bend = ca.densify(ca.hessian(self._sum, self._active)[0])
        return vectorize(ca.Function("bend", [self._q, self._weights], [ca.cse(bend)]))


class ConstraintDerivatives:
    """The symbolic forms c (m, k) of all constraints, kept >= 0, and their slopes by a of the joints."""

    def __init__(self, problem: DesignProblem, joints: Sequence[int]) -> None:
        self._q, self._values = _constraints(problem)
        self._active = self._q[list(joints)]

    def values(self, postures: Array) -> Array:
        """(m, k) c."""
        return self._level(postures)[0][..., 0]

    def first(self, postures: Array) -> tuple[Array, Array]:
        """c (m, k) and its derivatives (m, k, a)."""
        level, slopes = self._first(postures)
        return level[..., 0], slopes

    def slope(self, postures: Array, weights: Array) -> Array:
        """(m, a) gradients of <w, c> with weights (m, k)."""
        return self._slope(postures, weights)[0][..., 0]

    @cached_property
    def _level(self) -> Callable[..., tuple[Array, ...]]:
        return vectorize(ca.Function("level", [self._q], [ca.cse(self._values)]))

    @cached_property
    def _first(self) -> Callable[..., tuple[Array, ...]]:
        outputs = [self._values, ca.jacobian(self._values, self._active)]
        return vectorize(ca.Function("first", [self._q], ca.cse(outputs)))

    @cached_property
    def _slope(self) -> Callable[..., tuple[Array, ...]]:
        weights = ca.SX.sym("w", self._values.numel())
        slope = ca.densify(ca.gradient(ca.dot(self._values, weights), self._active))
        return vectorize(ca.Function("slope", [self._q, weights], [ca.cse(slope)]))


def constraint_derivatives(problem: DesignProblem, joints: Sequence[int]) -> Derivatives:
    """Derivatives of the symbolic forms of all constraints, which are kept >= 0."""
    q, values = _constraints(problem)
    active = q[list(joints)]
    first = ca.jacobian(values, active)
    second = ca.jacobian(ca.vec(first.T), active)
    function = vectorize(ca.Function("derivatives", [q], ca.cse([values, first, second])))

    def evaluate(postures: Array) -> tuple[Array, Array, Array]:
        level, slope, curvature = function(postures)
        return level[..., 0], slope, curvature.reshape(*slope.shape, -1)

    return evaluate


def constraint_values(problem: DesignProblem) -> Callable[[Array], Array]:
    """Postures (m, n) -> (m, k): the values of `constraint_derivatives` alone."""
    q, values = _constraints(problem)
    function = vectorize(ca.Function("constraints", [q], [values]))
    return lambda postures: function(postures)[0][..., 0]


def _constraints(problem: DesignProblem) -> tuple[ca.SX, ca.SX]:
    """Joint angles (n,), and the symbolic forms (k,) of all constraints."""
    q = ca.SX.sym("q", problem.joints)
    return q, ca.vertcat(*(constraint.symbolic(q) for constraint in problem.constraints))
