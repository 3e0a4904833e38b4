"""What is known of parameters before the data: a normal distribution, as extra rows of the least-squares problem.

Independent ones of zero mean and standard deviations d_k each add one residual (0 - x_k) / d_k, in units of the noise;
an earlier calibration, mean x_0 and covariance L L^T, adds the residuals L^-1 (x_0 - x). The minimum is the mode of the
posterior, and the inverse of the normal matrix with these rows its covariance (for a linear model both exactly: ridge
regression; A. E. Hoerl, R. W. Kennard, 1970).

Marginal likelihood of noise and of the sizes of a prior, the parameters without a prior integrated out (restricted
maximum likelihood, H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are unequal",
1971), from a problem that is linear about its solution.

Sizes are tried from a few values each: factors on those of the machining and of the zeros of joints.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet

if TYPE_CHECKING:
    from identification.estimation.problem import Noise, Problem

SURE = 1e-12  # of the largest eigenvalue of the correlations: combinations known better are held as well as this


@dataclass(frozen=True, eq=False)
class Earlier(ByValue):
    """A normal distribution of k parameters, as an earlier calibration left them.

    values : (k,) means;  covariance : (k, k), its diagonal > 0 [API units]
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array

    def __post_init__(self) -> None:
        for name in ("values", "covariance"):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        for name, variance in zip(self.names, np.diag(self.covariance).tolist(), strict=True):
            if not 0.0 < variance < np.inf:
                raise InputError(f"prior: {name} has variance {variance:g}, allowed: a finite number > 0")

    def about(self, names: Collection[str]) -> Earlier:
        """Of some of the parameters, whatever the others are."""
        kept = [k for k, name in enumerate(self.names) if name in names]
        chosen = tuple(self.names[k] for k in kept)
        return Earlier(chosen, self.values[kept], self.covariance[np.ix_(kept, kept)])

    def conditioned_on(self, values: Mapping[str, float]) -> Earlier:
        """Of the others, where some of the parameters have these values."""
        named = np.array([name in values for name in self.names], dtype=bool)
        crossed, among = self.covariance[np.ix_(~named, named)], self.covariance[np.ix_(named, named)]
        off = np.array([values[name] for name in self.names if name in values]) - self.values[named]
        gain = np.linalg.lstsq(among, crossed.T, rcond=None)[0].T
        left = self.covariance[np.ix_(~named, ~named)] - gain @ crossed.T
        free = tuple(name for name in self.names if name not in values)
        return Earlier(free, self.values[~named] + gain @ off, left)

    @property
    def root(self) -> tuple[Array, Array]:
        """(k, k) L with the covariance L L^T, and its inverse."""
        sizes = np.sqrt(np.diag(self.covariance))
        values, vectors = np.linalg.eigh(self.covariance / np.outer(sizes, sizes))
        roots = np.sqrt(np.maximum(values, SURE * values.max(initial=0.0)))
        return sizes[:, None] * vectors * roots, (vectors / roots).T / sizes


@dataclass(frozen=True, eq=False)
class Prior(ByValue):
    """Independent normal distributions of zero mean, and that of an earlier calibration, which comes first.

    deviations : parameter name -> standard deviation > 0 [API unit]; parameters that are not named are free, names
        that a model does not have do not matter
    own_error : standard deviation [mm] of one coordinate of a posture's own error, of which other postures say nothing:
        to a fit it is noise
    """

    deviations: Mapping[str, float]
    earlier: Earlier | None = None
    own_error: float = 0.0

    def __post_init__(self) -> None:
        for name, deviation in self.deviations.items():
            if not 0.0 < deviation < np.inf:
                raise InputError(f"prior: {name} has standard deviation {deviation:g}, allowed: a finite number > 0")
        first = () if self.earlier is None else self.earlier.names
        independent = {name: deviation for name, deviation in self.deviations.items() if name not in first}
        object.__setattr__(self, "deviations", MappingProxyType(independent))

    @property
    def names(self) -> frozenset[str]:
        """Of all parameters that have one."""
        return frozenset(self.deviations) | frozenset(() if self.earlier is None else self.earlier.names)

    def center(self, parameters: ParameterSet) -> Array:
        """(p,) means; zero where there is none."""
        means = {} if self.earlier is None else dict(zip(self.earlier.names, self.earlier.values.tolist(), strict=True))
        return parameters.vector(means, default=0.0)

    def rows(self, parameters: ParameterSet, noise: float = 1.0) -> Array:
        """(r, p) rows for the Jacobian, one for each parameter that has a prior; its residuals are rows @ (center -
        values).

        noise : standard deviation of the other residuals; 1 where those are divided by sigma
        """
        precisions = noise / parameters.vector(self.deviations, default=np.inf)
        return np.concatenate([np.diag(precisions)[precisions > 0.0], noise * self._of_earlier(parameters, 1).T])

    def factor(self, parameters: ParameterSet) -> Array:
        """(p, r) F, with the covariance F F^T, zero where there is no prior."""
        deviations = parameters.vector(self.deviations, default=0.0)
        return np.concatenate([np.diag(deviations)[:, deviations > 0.0], self._of_earlier(parameters, 0)], axis=1)

    def _of_earlier(self, parameters: ParameterSet, inverse: int) -> Array:
        """(p, k) root of the covariance, or the transpose of its inverse, at the places of the parameters."""
        if self.earlier is None:
            return np.zeros((len(parameters), 0))
        here = self.earlier.about(parameters.names)
        root = np.zeros((len(parameters), len(here.names)))
        root[[parameters.index(name) for name in here.names]] = here.root[1].T if inverse else here.root[0]
        return root


def effective_count(jacobian: Array, rows: Array) -> float:
    """How many of p parameters the data determine, the prior the rest: tr J (J^T J + R^T R)^-1 J^T.

    jacobian : (N, p) of the data alone;  rows : (r, p) of the prior, in the same units
    """
    triangle = np.linalg.qr(np.concatenate([jacobian, rows]), mode="r")
    lengths = np.maximum(np.linalg.norm(triangle, axis=0), np.finfo(float).tiny)
    _, values, right = np.linalg.svd(triangle / lengths, full_matrices=False)
    counted = values > values.max(initial=0.0) * 1e-12
    inverse = right[counted].T / values[counted]
    return float(np.sum(np.square(jacobian / lengths @ inverse)))


WIDTHS = tuple(2.0**k for k in range(6))  # factors on the machining's sizes; the likelihood is flat over a step
ZERO_WIDTHS = (1.0, 4.0, 16.0, 64.0)  # of joint zeros besides, which are set by hand: to 32 deg
CREDIBLE = 4.0  # difference of -2 log likelihood from the sizes as stated: chi2 of one degree of freedom, 5 %
ENOUGH = 3000  # equations: of more, rows show the same misfits again, and widths are chosen as from so many
GRID = 33  # values of the noise at once, on a logarithmic scale: each pass finds it 16 times as closely
FINE = 1e-4  # of its logarithm, where the likelihood is a parabola
LARGEST = 1e3  # noise in units of sigma, or of the scatter of a fit without the parameters that have a prior


@dataclass(frozen=True)
class Restricted:
    """Residuals as noise and effects of normal sizes, with the parameters without a prior integrated out.

    values : variances of orthogonal combinations of residuals that effects of deviation one make
    squares : of these combinations;  rest, count : sum of squares of the others, and their number
    """

    values: Array
    squares: Array
    rest: float
    count: int

    @classmethod
    def of(cls, target: Array, free: Array, effects: Array, spare: int | None = None) -> Restricted:
        """Of (N,) residuals, (N, f) columns without a prior and (N, e) columns times the deviation of their prior.

        spare : equations less f, where the rows stand for more than they are
        """
        spare = len(target) - free.shape[1] if spare is None else spare
        basis = np.linalg.qr(free)[0]
        target, effects = target - basis @ (basis.T @ target), effects - basis @ (basis.T @ effects)
        square, many = float(target @ target), effects.shape[0] < effects.shape[1]
        normal = effects @ effects.T if many else effects.T @ effects  # both have the same values, but for zeros
        values, vectors = np.linalg.eigh(normal)
        kept = np.flatnonzero(values > 1e-12 * max(values.max(initial=0.0), 1e-300))[-spare:]  # no rounding
        values, vectors = values[kept], vectors[:, kept]
        along = (vectors.T @ target) ** 2 if many else (vectors.T @ (effects.T @ target)) ** 2 / values
        return cls(values, along, max(square - float(along.sum()), 0.0), spare - len(values))

    def minus_log(self, noise: Array) -> Array:
        """(...) -2 log of the likelihood of values of the noise, up to a constant."""
        total = self.values + np.square(noise)[..., None]
        by_direction = np.sum(np.log(total) + self.squares / total, axis=-1)
        return np.asarray(by_direction + self.count * 2.0 * np.log(noise) + self.rest / noise**2)

    def likeliest(self, least: float, largest: float) -> tuple[float, float]:
        """Least -2 log of the likelihood, and the noise there, between two values."""
        low, high = np.log(least), np.log(largest)
        while high - low > FINE:
            grid = np.linspace(low, high, GRID)
            lowest = int(np.argmin(self.minus_log(np.exp(grid))))
            low, high = grid[max(lowest - 1, 0)], grid[min(lowest + 1, GRID - 1)]
        first, middle, last = self.minus_log(np.exp([low, 0.5 * (low + high), high]))
        bend = first - 2.0 * middle + last  # of a parabola, whose vertex rounding hardly moves
        vertex = 0.5 * (low + high) + (0.25 * (high - low) * (first - last) / bend if bend > 0.0 else 0.0)
        noise = np.exp(np.clip(vertex, low, high))
        return float(self.minus_log(noise)), float(noise)


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
        of_machining = {} if prior is None else problem.model.prior.keys() & prior.deviations.keys()
        machined = np.array([name in of_machining for name in parameters.names])
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


def likeliest(problem: LinearizedProblem, noise: Noise, sigma_holds: bool) -> tuple[float, Widths]:
    """Noise, no less than a given one (`sigma_holds`: that), and the widths of the prior of the largest likelihood."""
    basis = np.linalg.qr(problem.free)[0]
    target, jacobian = (a - basis @ (basis.T @ a) for a in (problem.target, problem.jacobian))
    has_sigma = noise.sigma is not None or sigma_holds
    scatter = float(np.linalg.norm(target)) / np.sqrt(max(problem.spare, 1))  # without all that has a prior
    unit = 1.0 if has_sigma else max(scatter, 1e-12)
    if problem.spare == 0:
        return unit, AS_STATED

    def fitted(widths: Widths, share: float) -> tuple[float, float]:
        """-2 log of the likelihood, and the noise, from a share of the rows."""
        times = np.where(problem.zeros, widths.zeros, 1.0) * np.where(problem.machined, widths.machining, 1.0)
        effects, root = (jacobian * times) @ problem.factor, np.sqrt(share)
        spare = max(round(share * problem.spare), 1)
        restricted = Restricted.of(root * target, effects[:, :0], root * effects, spare)
        value, scale = restricted.likeliest(
            unit if has_sigma else unit / LARGEST, unit if sigma_holds else LARGEST * unit
        )
        return value + CREDIBLE * sum(width != 1.0 for width in widths), scale

    widths = WIDTHS if problem.machined.any() else WIDTHS[:1], ZERO_WIDTHS if problem.zeros.any() else ZERO_WIDTHS[:1]
    several = [Widths(*pair) for pair in product(*widths)]
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
    return replace(
        prior, deviations={name: deviation * factors.get(name, 1.0) for name, deviation in prior.deviations.items()}
    )
