"""Noise and sizes of a prior of the largest marginal likelihood, from a problem that is linear about its solution.

Sizes are tried from a few values each: factors on those of the machining and of the zeros of joints, and how many
settings of an effect are there at once. The columns of the effects change with them by factors alone, so that their
products are made once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
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
TOGETHER = tuple(2.0**k for k in range(7))  # settings of an effect at once; the likelihood is flat over a step
CREDIBLE = 4.0  # difference of -2 log likelihood from the sizes as stated: chi2 of one degree of freedom, 5 %
ENOUGH = 3000  # equations: of more, rows show the same misfits again, and widths are chosen as from so many


class Widths(NamedTuple):
    """What the likelihood says of the sizes of a prior.

    machining : factor on those of the machining;  zeros : one more on those of joint zeros
    together : how many settings of an effect are there at once (`Prior.alternatives`)
    """

    machining: float = 1.0
    zeros: float = 1.0
    together: float = 1.0


AS_STATED = Widths()


class LinearizedProblem(NamedTuple):
    """A problem without its prior, linear about values x of its parameters, in as few rows as say the same.

    target : (N,) weighted residuals if all parameters with a prior were at its center;  jacobian : (N, p)
    equations : of the data;  factor : (p, r) of the prior's covariance, see `Prior.factor`
    machined : (p,) those with the prior of the machining;  zeros : (p,) joint offsets among them
    alternatives : (p,) settings that their effect may have, 1 where it has but one
    """

    target: Array
    jacobian: Array
    equations: int
    factor: Array
    machined: NDArray[np.bool_]
    zeros: NDArray[np.bool_]
    alternatives: Array

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
        alternatives = parameters.vector({} if prior is None else prior.alternatives, default=1.0)
        return cls(target, jacobian, equations, factor, machined, zeros, alternatives)

    def sizes(self, widths: Widths) -> Array:
        """(p,) factors on the deviations of the prior."""
        machined = np.where(self.zeros, widths.zeros, 1.0) * np.where(self.machined, widths.machining, 1.0)
        return np.asarray(machined * np.sqrt(np.minimum(widths.together, self.alternatives)))

    @property
    def spare(self) -> int:
        """Equations that are left over by the parameters without a prior."""
        return self.equations - self.free.shape[1]

    @property
    def free(self) -> Array:
        """(N, f) columns without a prior."""
        return self.jacobian[:, ~self.factor.any(axis=1)]

    @property
    def scatter(self) -> float:
        """Of a fit of the parameters without a prior alone."""
        left = self.target - self.free @ np.linalg.lstsq(self.free, self.target, rcond=None)[0]
        return max(float(np.linalg.norm(left)) / np.sqrt(max(self.spare, 1)), 1e-12)


@dataclass(frozen=True)
class Effects:
    """Residuals and effects of all that has a prior, orthogonal to the columns without one; products are made once.

    target : (N,);  jacobian : (N, p);  factor : (p, r) of the prior's covariance;  effects : (N, r) their product
    own : (r,) parameter whose deviation a column of the factor is, where each is that of one parameter; else None
    normal, moment : (r, r) and (r,) of the effects, where they are fewer than the residuals, else None
    """

    target: Array
    jacobian: Array
    factor: Array
    effects: Array
    own: NDArray[np.intp] | None
    normal: Array | None
    moment: Array | None

    @classmethod
    def of(cls, target: Array, jacobian: Array, factor: Array) -> Effects:
        """Of residuals and Jacobian that are orthogonal to the columns without a prior."""
        single = bool(np.all(np.count_nonzero(factor, axis=0) == 1))
        own = np.argmax(factor != 0.0, axis=0) if single else None
        effects = jacobian @ factor if own is None else jacobian[:, own] * factor[own, np.arange(len(own))]
        few = own is not None and len(own) <= len(target)
        products = (effects.T @ effects, effects.T @ target) if few else (None, None)
        return cls(target, jacobian, factor, effects, own, *products)

    def restricted(self, sizes: Array, share: float, spare: int) -> Restricted:
        """The likelihood with factors (p,) on the deviations, from a share of the rows that leave `spare` equations."""
        root = np.sqrt(share)
        if self.own is None:
            effects = root * ((self.jacobian * sizes) @ self.factor)
            return Restricted.of(root * self.target, effects[:, :0], effects, spare)
        by = sizes[self.own]
        if self.normal is None or self.moment is None:
            return Restricted.of(root * self.target, self.effects[:, :0], root * (self.effects * by), spare)
        square = share * float(self.target @ self.target)
        return Restricted.of_normal(share * by[:, None] * self.normal * by, share * by * self.moment, square, spare)


def likeliest(problem: LinearizedProblem, noise: Noise, given: bool) -> tuple[float, Widths]:
    """Noise, no less than a given one (`given`: that one), and the widths of the prior of the largest likelihood."""
    unit = 1.0 if (known := noise.sigma is not None) or given else problem.scatter
    if problem.spare == 0:
        return unit, AS_STATED
    basis = np.linalg.qr(problem.free)[0]
    target, jacobian = (a - basis @ (basis.T @ a) for a in (problem.target, problem.jacobian))

    alike = bool(problem.machined[problem.factor.any(axis=1)].all())  # their sizes have one factor
    effects = Effects.of(target, jacobian, problem.factor)

    @cache
    def likelihood(widths: Widths, share: float) -> Restricted:
        return effects.restricted(problem.sizes(widths), share, max(round(share * problem.spare), 1))

    def fitted(widths: Array, other: Widths, share: float) -> tuple[Array, Array]:
        """-2 log of the likelihood for each width of the machining (w,), and the noise, from a share of the rows."""
        least = unit if known else unit / LARGEST
        if alike:
            found = [likelihood(other, share).likeliest(least, LARGEST * unit, widths, given)]
        else:
            each = [likelihood(other._replace(machining=width), share) for width in widths.tolist()]
            found = [one.likeliest(least, LARGEST * unit, np.ones(1), given) for one in each]
        values, noises = np.concatenate(found, axis=1)
        return values + CREDIBLE * (np.not_equal(widths, 1.0) + np.count_nonzero(np.not_equal(other, 1.0))), noises

    def best(widths: Array, others: Sequence[Widths]) -> Widths:
        values = np.array([fitted(widths, other, min(1.0, ENOUGH / problem.equations))[0] for other in others])
        row, column = divmod(int(np.argmin(values)), len(widths))
        return others[row]._replace(machining=float(widths[column]))

    several = [n for n in TOGETHER if n < 2.0 * problem.alternatives.max()]
    own = best(np.ones(1), [Widths(together=n) for n in several])
    zeros = ZERO_WIDTHS if problem.zeros.any() else ZERO_WIDTHS[:1]
    own = best(np.array(WIDTHS if problem.machined.any() else WIDTHS[:1]), [own._replace(zeros=z) for z in zeros])
    return float(fitted(np.array([own.machining]), own._replace(machining=1.0), 1.0)[1][0]), own


def widened(problem: Problem, widths: Widths) -> Prior | None:
    """The problem's prior with the sizes of the machining so many times as large, and so many settings at once."""
    if problem.prior is None or widths == AS_STATED:
        return problem.prior
    prior, machined = problem.prior.with_together(widths.together), problem.model.prior
    factors = {p.name: widths[p.kind == JOINT_OFFSET] for p in problem.model.parameters if p.name in machined}
    return replace(prior, deviations={name: own * factors.get(name, 1.0) for name, own in prior.deviations.items()})
