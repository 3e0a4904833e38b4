"""What is known of parameters before the data: a normal distribution, as extra rows of the least-squares problem.

Independent ones of zero mean and standard deviations d_k each add one residual (0 - x_k) / d_k, in units of the noise;
an earlier calibration, mean x_0 and covariance L L^T, adds the residuals L^-1 (x_0 - x). The minimum is the mode of the
posterior, and the inverse of the normal matrix with these rows its covariance (for a linear model both exactly: ridge
regression; A. E. Hoerl, R. W. Kennard, 1970).

Noise and sizes of the prior are those of the largest marginal likelihood, the parameters without a prior integrated out
(restricted maximum likelihood, H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are
unequal", 1971), of a problem that is linear about its solution. Sizes are tried from a few values each: factors on
those of the machining and of the zeros of joints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc, fdtrc

from identification.arrays import Array, ByValue, readonly
from identification.errors import InputError
from identification.estimation.levenberg_marquardt import levenberg_marquardt
from identification.information import PRODUCT_TOLERANCE, product_inverse, significant, spectrum
from identification.kinematics.parameters import JOINT_OFFSET, ParameterSet

if TYPE_CHECKING:
    from identification.estimation.problem import LinearProblem, Problem

WIDTHS = tuple(2.0**k for k in range(6))  # factors on the machining's sizes; the likelihood is flat over a step
ZERO_WIDTHS = (1.0, 4.0, 16.0, 64.0)  # of joint zeros besides, which are set by hand: to 32 deg
LEAST = 1e-12  # [mm] of noise: data without any
LEVEL = 0.01  # of a contradiction that is said
LARGEST = 1e3  # noise in units of sigma, or of the scatter of a fit without the parameters that have a prior


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
        gain = crossed @ product_inverse(among)
        left = self.covariance[np.ix_(~named, ~named)] - gain @ crossed.T
        free = tuple(name for name in self.names if name not in values)
        return Earlier(free, self.values[~named] + gain @ off, left)

    @property
    def root(self) -> tuple[Array, Array]:
        """(k, k) L with the covariance L L^T, and its inverse."""
        sizes = np.sqrt(np.diag(self.covariance))  # combinations known better than rounding are held as well as that
        values, vectors = np.linalg.eigh(self.covariance / np.outer(sizes, sizes))
        roots = np.sqrt(np.maximum(values, PRODUCT_TOLERANCE * values.max(initial=0.0)))
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

    def released(self, names: Collection[str], machining: Mapping[str, float]) -> Prior:
        """Without what the earlier calibration says of these; that of the machining (name -> deviation) stays."""
        assert self.earlier is not None
        kept = self.earlier.about(set(self.earlier.names) - set(names))
        machined = {name: size for name, size in machining.items() if name in names}
        return Prior({**machined, **self.deviations}, kept if kept.names else None)

    def widened(self, factors: Mapping[str, float]) -> Prior:
        """With deviations so many times as large."""
        wide = {name: deviation * factors.get(name, 1.0) for name, deviation in self.deviations.items()}
        return replace(self, deviations=wide)

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


# -- noise and sizes ---------------------------------------------------------------------------------------------------
def restricted_likelihood(
    target: Array, free: Array, effects: Array, spare: int | None = None
) -> Callable[[Array], Array]:
    """-2 log of the likelihood of values (...) of the noise, up to a constant, where residuals are noise and effects of
    normal sizes, with the parameters without a prior integrated out.

    target : (N,) residuals;  free : (N, f) columns without a prior;  effects : (N, e) columns times the deviation of
        their prior
    spare : equations less f, where the rows stand for more than they are
    """
    spare = len(target) - free.shape[1] if spare is None else spare
    basis = np.linalg.qr(free)[0]
    target, effects = target - basis @ (basis.T @ target), effects - basis @ (basis.T @ effects)
    square, many = float(target @ target), effects.shape[0] < effects.shape[1]
    normal = effects @ effects.T if many else effects.T @ effects  # both have the same values, but for zeros
    values, vectors = np.linalg.eigh(normal)
    kept = np.flatnonzero(significant(values, PRODUCT_TOLERANCE))[-spare:]
    # variances of orthogonal combinations of residuals that effects of deviation one make, and squares of these
    values, vectors = values[kept], vectors[:, kept]
    squares = (vectors.T @ target) ** 2 if many else (vectors.T @ (effects.T @ target)) ** 2 / values
    rest, count = max(square - float(squares.sum()), 0.0), spare - len(values)

    def minus_log(noise: Array) -> Array:
        total = values + np.square(noise)[..., None]
        by_direction = np.sum(np.log(total) + squares / total, axis=-1)
        return np.asarray(by_direction + count * 2.0 * np.log(noise) + rest / noise**2)

    return minus_log


def likeliest_noise(minus_log: Callable[[Array], Array], least: float, largest: float) -> tuple[float, float]:
    """Least -2 log of the likelihood, and the noise there, between two values."""
    low, high = np.log(least), np.log(largest)
    count = 33  # values of the noise at once, on a logarithmic scale: each pass finds it 16 times as closely
    while high - low > 1e-4:  # then the likelihood is a parabola
        grid = np.linspace(low, high, count)
        lowest = int(np.argmin(minus_log(np.exp(grid))))
        low, high = grid[max(lowest - 1, 0)], grid[min(lowest + 1, count - 1)]
    first, middle, last = minus_log(np.exp([low, 0.5 * (low + high), high]))
    bend = first - 2.0 * middle + last  # of a parabola, whose vertex rounding hardly moves
    vertex = 0.5 * (low + high) + (0.25 * (high - low) * (first - last) / bend if bend > 0.0 else 0.0)
    noise = np.exp(np.clip(vertex, low, high))
    return float(minus_log(noise)), float(noise)


def likeliest(linearized: LinearProblem) -> tuple[float, tuple[float, float]]:
    """Noise, no less than a sigma that is given (where intervals rely on that: it), and the widths of the prior of the
    largest likelihood: a factor on the sizes of the machining, and a further one on those of joint zeros."""
    problem, x, residual, jacobian = linearized
    sigma_holds = problem.reliance == "given"
    parameters, prior = problem.model.parameters, problem.prior
    factor = np.zeros((len(parameters), 0)) if prior is None else prior.factor(parameters)
    held = factor.any(axis=1)
    of_machining = {} if prior is None else problem.model.prior.keys() & prior.deviations.keys()
    machined = np.array([name in of_machining for name in parameters.names])
    zeros = machined & np.array([p.kind == JOINT_OFFSET for p in parameters])
    target = residual + jacobian @ np.where(held, x - problem.prior_center, 0.0)  # all at the center of the prior
    basis = np.linalg.qr(jacobian[:, ~held])[0]
    spare = problem.equations - int(np.count_nonzero(~held))
    target, jacobian = (a - basis @ (basis.T @ a) for a in (target, jacobian))
    has_sigma = problem.sigma is not None or sigma_holds
    scatter = float(np.linalg.norm(target)) / np.sqrt(max(spare, 1))  # without all that has a prior
    unit = 1.0 if has_sigma else max(scatter, 1e-12)
    if spare == 0:
        return unit, (1.0, 1.0)
    least, largest = unit if has_sigma else unit / LARGEST, unit if sigma_holds else LARGEST * unit

    def fitted(widths: tuple[float, float], share: float) -> tuple[float, float]:
        """-2 log of the likelihood, and the noise, from a share of the rows."""
        times = np.where(machined, widths[0], 1.0) * np.where(zeros, widths[1], 1.0)
        effects, root = (jacobian * times) @ factor, np.sqrt(share)
        minus_log = restricted_likelihood(root * target, effects[:, :0], root * effects, max(round(share * spare), 1))
        value, noise = likeliest_noise(minus_log, least, largest)
        # 4, by which other sizes than those stated must be likelier: chi2 of one degree of freedom, 5 %
        return value + 4.0 * sum(width != 1.0 for width in widths), noise

    several = [*product(WIDTHS if machined.any() else WIDTHS[:1], ZERO_WIDTHS if zeros.any() else ZERO_WIDTHS[:1])]
    # of more equations, rows show the same misfits again, and widths are chosen as from so many
    share = min(1.0, 3000 / problem.equations)
    best = several[0] if len(several) == 1 else min(several, key=lambda widths: fitted(widths, share)[0])
    return fitted(best, 1.0)[1], best


# -- an earlier calibration that the measurements contradict -----------------------------------------------------------
def contradicted(problem: Problem, x: Array) -> tuple[dict[str, tuple[str, ...]], float, Array]:
    """Parameters whose prior, an earlier calibration, the measurements contradict, the clearest first, each with those
    that would explain it as well; and the noise without that calibration and the (N, p) Jacobian, about x.

    The drop of the weighted squares, where a parameter's own prior is released and the others' stay, is chi2 of one
    degree of freedom if both agree (F where the noise is estimated). What drops it most is released first, since errors
    of one parameter look like errors of others, and the fit is made again, from the one before since an error of
    degrees is not linear, before the others are tested.

    x : (p,) of the fit with the whole prior
    """
    explained, first = dict[str, tuple[str, ...]](), None
    while True:
        about = problem.linearized(x)
        noise, freedom = _noise_without_earlier(about)
        first = first or (noise, about.jacobian)
        if (worst := worst_contradicted(about, noise, freedom, explained)) is None:
            return explained, *first
        explained |= worst
        assert problem.prior is not None
        prior = problem.prior.released(explained, problem.model.prior)
        freed = replace(problem, prior=prior, noise=noise).least_squares
        x = levenberg_marquardt(freed, x[None]).parameters[0]


def _noise_without_earlier(about: LinearProblem) -> tuple[float, float]:
    """Noise of the measurements without the earlier calibration, and its degrees of freedom: infinite where it is the
    one given, 0 where nothing is left to tell."""
    problem, model = about.problem, about.problem.model
    assert problem.prior is not None
    alone = problem.prior.released(model.names, model.prior)
    has_sigma, holds = problem.sigma is not None, problem.reliance == "given"
    noise, spare = 1.0 if has_sigma or holds else problem.noise, 0.0
    for _ in range(0 if holds else 3):  # rounds of noise and of what the machining's prior is worth beside it
        decomposed = spectrum(about.jacobian, model.scales, prior=alone.rows(model.parameters, noise))
        spare = problem.equations - decomposed.determined(about.jacobian)
        if spare < 1.0:
            break
        noise = max(float(np.sqrt(about.squares(alone, noise) * noise**2 / spare)), 1.0 if has_sigma else LEAST)
    return (noise, np.inf) if holds or (has_sigma and noise == 1.0) else (noise, max(spare, 0.0))


def worst_contradicted(
    about: LinearProblem, noise: float, freedom: float, explained: Collection[str]
) -> dict[str, tuple[str, ...]] | None:
    """The parameter whose prior is contradicted most, of those that are not explained yet, with those that would
    explain it as well; None where none is."""
    prior, model = about.problem.prior, about.problem.model
    assert prior is not None
    assert prior.earlier is not None
    if freedom < 1.0 or noise <= LEAST:
        return None
    rest = [name for name in prior.earlier.names if name in model.names and name not in explained]
    left = {name: about.squares(prior.released([*explained, name], model.prior), noise) for name in rest}
    if not left:
        return None

    def p_value(drop: float) -> float:
        return float(chdtrc(1.0, max(drop, 0.0)) if np.isinf(freedom) else fdtrc(1.0, freedom, max(drop, 0.0)))

    best = min(left, key=lambda name: left[name])
    if p_value(about.squares(prior.released(explained, model.prior), noise) - left[best]) * len(rest) >= LEVEL:
        return None
    return {best: tuple(name for name in rest if name != best and p_value(left[name] - left[best]) > 0.05)}
