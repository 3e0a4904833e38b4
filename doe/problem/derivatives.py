"""First and second derivatives by the joint angles, of many postures at once: of Jacobians and of constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import casadi as ca

from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.vectorize import vectorize

# postures (m, n) -> values (m, k), first derivatives (m, k, a) and second ones (m, k, a, a) by a of the joints
Derivatives = Callable[[Array], tuple[Array, Array, Array]]


def jacobian_derivatives(problem: DesignProblem, joints: Sequence[int]) -> Derivatives:
    """Of the entries of the scaled Jacobian B (d, p), row by row: k = d p."""
    q = ca.SX.sym("q", problem.joints)
    return _compiled(q, ca.vec(problem.scaled_jacobian_function(q).T), joints)


def constraint_derivatives(problem: DesignProblem, joints: Sequence[int]) -> Derivatives:
    """Of the symbolic forms of all constraints, which are kept >= 0."""
    q, values = _constraints(problem)
    return _compiled(q, values, joints)


def constraint_values(problem: DesignProblem) -> Callable[[Array], Array]:
    """Postures (m, n) -> (m, k): the values of `constraint_derivatives` alone."""
    q, values = _constraints(problem)
    function = vectorize(ca.Function("constraints", [q], [values]))
    return lambda postures: function(postures)[0][..., 0]


def _constraints(problem: DesignProblem) -> tuple[ca.SX, ca.SX]:
    """Joint angles (n,), and the symbolic forms (k,) of all constraints."""
    q = ca.SX.sym("q", problem.joints)
    return q, ca.vertcat(*(constraint.symbolic(q) for constraint in problem.constraints))


def _compiled(q: ca.SX, values: ca.SX, joints: Sequence[int]) -> Derivatives:
    active = q[list(joints)]
    first = ca.jacobian(values, active)
    second = ca.jacobian(ca.vec(first.T), active)
    function = vectorize(ca.Function("derivatives", [q], ca.cse([values, first, second])))

    def evaluate(postures: Array) -> tuple[Array, Array, Array]:
        level, slope, curvature = function(postures)
        return level[..., 0], slope, curvature.reshape(*slope.shape, -1)

    return evaluate
