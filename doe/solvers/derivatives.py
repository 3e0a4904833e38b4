"""Exact first and second derivatives of a plan's criterion with respect to all of its joint angles.

    f(q_1, ..., q_m) = Phi(M),   M = (sum_i B_i^T B_i + K) / N

with B_i = B(q_i), K what is known from k runs already (`PriorInformation`), N = m + k. By the chain rule, with
G = dPhi/dM and X_ia = dM/dq_ia,

    df/dq_ia            = (2/N) tr(G B_i^T dB_i/dq_a)
    d2f/dq_ia dq_kb     = D^2 Phi[X_ia, X_kb] + (2/N) [i = k] ( tr(G dB_a^T dB_b) + tr(G B^T d2B_ab) )

B and its derivatives come from `doe.problem.derivatives`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from doe.criteria.criterion import Criterion, smooth
from doe.problem.derivatives import Derivatives, JacobianDerivatives, constraint_derivatives
from doe.problem.problem import DesignProblem
from identification.arrays import Array
from identification.information import information_matrix


@dataclass(frozen=True)
class PlanFunction:
    """The criterion of plans of m runs as a function of the angles of some `joints`; the others stay where they are.

    Points are (m, n) posture arrays; derivatives are ordered run by run, joint by joint: (m a), (m a, m a).
    """

    problem: DesignProblem
    runs: int
    joints: tuple[int, ...]

    @property
    def size(self) -> int:
        """m a, the number of variables."""
        return self.runs * len(self.joints)

    @property
    def criterion(self) -> Criterion:
        """Phi, or its smooth stand-in where it has no second derivatives (E)."""
        return smooth(self.problem.criterion)

    def value(self, postures: Array) -> float:
        """f; -inf where the information matrix is singular."""
        return float(self.criterion.value(self.problem.information(postures)))

    def expand(self, postures: Array) -> tuple[float, Array, Array]:
        """f, its gradient (m a,) and its Hessian (m a, m a), in one pass.

        Raises numpy's `LinAlgError` where the information matrix is singular.
        """
        jacobian, first = self._derivatives.first(postures)
        total = self.runs + self.problem.prior.runs
        information = self.problem.prior.information(information_matrix(jacobian), self.runs)
        gradient = self.criterion.gradient(information)
        slope = (2.0 / total) * np.einsum("mdp,madp->ma", jacobian @ gradient, first)
        value = float(self.criterion.value(information))
        bend = self._derivatives.bend(postures, jacobian @ gradient)
        return value, slope.ravel(), self._hessian(jacobian, first, bend, information, gradient, total)

    def _hessian(
        self, jacobian: Array, first: Array, bend: Array, information: Array, gradient: Array, total: float
    ) -> Array:
        """(m a, m a) of B (m, d, p), dB (m, a, d, p) and the Hessians (m, a, a) of <B G, B>."""
        m, a, d, p = first.shape
        half = np.swapaxes(jacobian, -1, -2)[:, None] @ first  # B^T dB_a, (m, a, p, p)
        directions = (half + np.swapaxes(half, -1, -2)).reshape(m * a, p, p) / total
        hessian = self.criterion.curvature(information, directions).reshape(m, a, m, a)
        flat = first.reshape(m, a, d * p)
        own = flat @ np.swapaxes((first @ gradient).reshape(m, a, d * p), -1, -2)
        own += bend
        runs = np.arange(m)
        hessian[runs, :, runs, :] += (2.0 / total) * own
        return hessian.reshape(m * a, m * a)

    @cached_property
    def _derivatives(self) -> JacobianDerivatives:
        return JacobianDerivatives(self.problem, self.joints)


@dataclass(frozen=True)
class ConstraintFunction:
    """All constraints of all runs, kept >= 0, as functions of the angles of some `joints`; ordered run by run."""

    problem: DesignProblem
    joints: tuple[int, ...]

    @cached_property
    def rows(self) -> int:
        """k, constraints of one posture."""
        return self._derivatives(self.problem.lower[None])[0].size if self.problem.constraints else 0

    def sparsity(self, runs: int) -> ca.Sparsity:
        """(m k, m a) pattern of the Jacobian: a run's constraints depend on its own joints only."""
        return ca.diagcat(*[ca.Sparsity.dense(self.rows, len(self.joints))] * runs)

    def values(self, postures: Array) -> Array:
        """(m k,) constraint expressions."""
        return self._derivatives(postures)[0].ravel()

    def jacobian(self, postures: Array) -> Array:
        """(m a k,) derivatives, in the order of CasADi's columns: run, joint, constraint."""
        return np.swapaxes(self._derivatives(postures)[1], 1, 2).ravel()

    def hessian(self, postures: Array, multipliers: Array) -> Array:
        """(m a, m a) second derivative of sum multipliers * constraints; zero between runs."""
        m, a = len(postures), len(self.joints)
        full = np.zeros((m, a, m, a))
        if self.rows:
            runs = np.arange(m)
            second = self._derivatives(postures)[2]
            full[runs, :, runs, :] = np.einsum("mk,mkab->mab", multipliers.reshape(m, -1), second)
        return full.reshape(m * a, m * a)

    @cached_property
    def _derivatives(self) -> Derivatives:
        return constraint_derivatives(self.problem, self.joints)
