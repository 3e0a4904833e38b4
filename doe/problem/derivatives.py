"""First and second derivatives by the joint angles, of many postures at once: of Jacobians and of constraints.

A criterion needs the second derivatives of a Jacobian only in sums <W, B> over its entries with fixed weights W, and
its gradient alone needs no more than the slope of such a sum: reverse differentiation gives each at a few times the
cost of B itself, however many entries that has. Constraints are treated in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import casadi as ca
import numpy as np

from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.vectorize import vectorize


class Derivatives:
    """Of an expression c (k,) of one posture by a of the joints; weights w are (m, k)."""

    def __init__(self, q: ca.SX, expression: ca.SX, joints: Sequence[int]) -> None:
        self._q, self._expression = q, ca.densify(ca.SX(expression))
        self._active = q[list(joints)]
        self._weights = ca.SX.sym("w", self._expression.numel())
        self._sum = ca.dot(self._expression, self._weights)

    def values(self, postures: Array) -> Array:
        """(m, k) c."""
        return self._values(postures)[0][..., 0]

    def first(self, postures: Array) -> tuple[Array, Array]:
        """c (m, k) and its derivatives (m, k, a)."""
        values, slopes = self._first(postures)
        return values[..., 0], slopes

    def slope(self, postures: Array, weights: Array) -> Array:
        """(m, a) gradients of <w, c>."""
        return self._slope(postures, weights.reshape(len(weights), self._weights.numel()))[0][..., 0]

    def bend(self, postures: Array, weights: Array) -> Array:
        """(m, a, a) Hessians of <w, c>."""
        return self._bend(postures, weights.reshape(len(weights), self._weights.numel()))[0]

    def _compiled(self, inputs: list[ca.SX], *outputs: ca.SX) -> Callable[..., tuple[Array, ...]]:
        return vectorize(ca.Function("derivatives", inputs, ca.cse([ca.densify(output) for output in outputs])))

    @cached_property
    def _values(self) -> Callable[..., tuple[Array, ...]]:
        return self._compiled([self._q], self._expression)

    @cached_property
    def _first(self) -> Callable[..., tuple[Array, ...]]:
        return self._compiled([self._q], self._expression, ca.jacobian(self._expression, self._active))

    @cached_property
    def _slope(self) -> Callable[..., tuple[Array, ...]]:
        return self._compiled([self._q, self._weights], ca.gradient(self._sum, self._active))

    @cached_property
    def _bend(self) -> Callable[..., tuple[Array, ...]]:
        return self._compiled([self._q, self._weights], ca.hessian(self._sum, self._active)[0])


class JacobianDerivatives(Derivatives):
    """Of the scaled Jacobian B (d, p); weights W are (m, d, p)."""

    def __init__(self, problem: DesignProblem, joints: Sequence[int]) -> None:
        q = ca.SX.sym("q", problem.joints)
        jacobian = problem.scaled_jacobian_function(q)
        self._shape = jacobian.shape
        super().__init__(q, ca.vec(jacobian.T), joints)

    def first(self, postures: Array) -> tuple[Array, Array]:
        """B (m, d, p) and its derivatives (m, a, d, p)."""
        jacobian, first = super().first(postures)
        return jacobian.reshape(-1, *self._shape), np.moveaxis(first, -1, -2).reshape(
            *first.shape[:-2], first.shape[-1], *self._shape
        )


class ConstraintDerivatives(Derivatives):
    """Of the symbolic forms c (k,) of all constraints, which are kept >= 0."""

    def __init__(self, problem: DesignProblem, joints: Sequence[int]) -> None:
        q = ca.SX.sym("q", problem.joints)
        super().__init__(q, ca.vertcat(*(constraint.symbolic(q) for constraint in problem.constraints)), joints)
