"""Noise and sizes of a prior of the largest marginal likelihood, from a problem that is linear about its solution.

Sizes are tried from a few values each: factors on those of the machining and of the zeros of joints.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.estimation.checks import Noise
from identification.estimation.prior import Prior
from identification.estimation.problem import Problem
from identification.estimation.restricted_likelihood import LARGEST, Restricted
from identification.kinematics.parameters import JOINT_OFFSET

WIDTHS = tuple(2.0**k for k in range(6))  # factors on the machining's sizes; the likelihood is flat over a step
ZERO_WIDTHS = (1.0, 4.0, 16.0, 64.0)  # of joint zeros besides, which are set by hand: to 32 deg
CREDIBLE = 4.0  # difference of -2 log likelihood from the sizes as stated: chi2 of one degree of freedom, 5 %
ENOUGH = 3000  # equations: of more, rows show the same misfits again, and widths are chosen as from so many


class Widths(NamedTuple):
    """What the likelihood says of the sizes of a prior.

    machining : factor on those of the machining;  zeros : one more on those of joint zeros
    """

    machining: float = 1.0
    zeros: float = 1.0


AS_STATED = Widths()


class LinearizedProblem(NamedTuple):
    """A problem without its prior, linear about values x of its parameters, in as few rows as say the same.

    target : (N,) weighted residuals if all parameters with a prior were at its center;  jacobian : (N, p)
    equations : of the data;  factor : (p, r) of the prior's covariance, see `Prior.factor`
    machined : (p,) those with the prior of the machining;  zeros : (p,) joint offsets among them
    """

    target: Array
    jacobian: Array
    equations: int
    factor: Array
    machined: NDArray[np.bool_]
    zeros: NDArray[np.bool_]

    @classmethod
    def of(cls, problem: Problem, x: Array, residual: Array, jacobian: Array) -> LinearizedProblem:
        """About x (p,), where the problem without its prior has these residuals (N,) and this Jacobian (N, p)."""
        parameters, prior = problem.model.parameters, problem.prior
        factor = np.zeros((len(parameters), 0)) if prior is None else prior.factor(parameters)
        target = residual + jacobian @ np.where(factor.any(axis=1), x - problem.prior_center, 0.0)
        equations = problem.model.dimension * int(np.count_nonzero(problem.weights))
        own = {} if prior is None else problem.model.prior.keys() & prior.deviations.keys()
        machined = np.array([name in own for name in parameters.names])
        zeros = machined & np.array([p.kind == JOINT_OFFSET for p in parameters])
        return cls(target, jacobian, equations, factor, machined, zeros)

    @property
    def free(self) -> Array:
        """(N, f) columns without a prior."""
        return self.jacobian[:, ~self.factor.any(axis=1)]

    @property
    def spare(self) -> int:
        """Equations that are left over by the parameters without a prior."""
        return self.equations - self.free.shape[1]


def likeliest(problem: LinearizedProblem, noise: Noise, given: bool) -> tuple[float, Widths]:
    """Noise, no less than a given one (`given`: that one), and the widths of the prior of the largest likelihood."""
    basis = np.linalg.qr(problem.free)[0]
    target, jacobian = (a - basis @ (basis.T @ a) for a in (problem.target, problem.jacobian))
    known = noise.sigma is not None or given
    scatter = float(np.linalg.norm(target)) / np.sqrt(max(problem.spare, 1))  # without all that has a prior
    unit = 1.0 if known else max(scatter, 1e-12)
    if problem.spare == 0:
        return unit, AS_STATED

    def fitted(widths: Widths, share: float) -> tuple[float, float]:
        """-2 log of the likelihood, and the noise, from a share of the rows."""
        times = np.where(problem.zeros, widths.zeros, 1.0) * np.where(problem.machined, widths.machining, 1.0)
        effects, root = (jacobian * times) @ problem.factor, np.sqrt(share)
        spare = max(round(share * problem.spare), 1)
        found = Restricted.of(root * target, effects[:, :0], root * effects, spare)
        least = unit if known else unit / LARGEST
        value, scale = found.likeliest(least, LARGEST * unit, np.ones(1), given)[:, 0].tolist()
        return value + CREDIBLE * sum(width != 1.0 for width in widths), scale

    widths = WIDTHS if problem.machined.any() else WIDTHS[:1], ZERO_WIDTHS if problem.zeros.any() else ZERO_WIDTHS[:1]
    several = [Widths(*both) for both in product(*widths)]
    share = min(1.0, ENOUGH / problem.equations)
    best = several[0] if len(several) == 1 else min(several, key=lambda one: fitted(one, share)[0])
    return fitted(best, 1.0)[1], best


def widened(problem: Problem, widths: Widths) -> Prior | None:
    """The problem's prior with the sizes of the machining so many times as large."""
    if problem.prior is None or widths == AS_STATED:
        return problem.prior
    prior, machined = problem.prior, problem.model.prior
    zeros = {p.name for p in problem.model.parameters if p.kind == JOINT_OFFSET}
    factors = {name: widths.machining * (widths.zeros if name in zeros else 1.0) for name in machined}
    return replace(prior, deviations={name: own * factors.get(name, 1.0) for name, own in prior.deviations.items()})
