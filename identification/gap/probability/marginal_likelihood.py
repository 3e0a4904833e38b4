"""Bayes factor of a set of effects against the base model, in closed form from one fit.

Base parameters have flat priors and sigma the prior 1 / sigma. The prior of an effect's amplitudes is set by its size
lambda: the length, in units of sigma, of its contribution at the measured postures after projection off the base model.
A missing effect has a size other than zero: the prior density of its amplitudes b is proportional to

    (b^T S b / sigma^2) exp(-b^T V^-1 b / (2 lambda^2 sigma^2))

with S their information matrix (moment prior of V. E. Johnson and D. Rossell, 2010; without the first factor and with
V = S^-1 it is A. Zellner's g-prior). Each effect of a set has its own lambda. With b, S and V those of all effects, V
times their lambda^2, RSS and RSS_0 the residual sums of squares of the fit and of the base model, and f the degrees of
freedom of the base model, the Bayes factor is

    |I + S V|^(-1/2) (R / RSS_0)^(-f / 2) E,   R = RSS + b^T (S^-1 + V)^-1 b,

with E the posterior mean of b^T S b / (lambda sigma)^2 of each effect. As the size of a missing effect is unknown, the
Bayes factor is averaged over sizes equally spaced in log lambda, from just detectable to obvious without a test. Of
several effects each is averaged with the others at their likeliest sizes, and the averages relative to the factor there
are multiplied: they would be independent if it were not for sigma and what effects have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from identification.arrays import Array
from identification.gap.fits.fit import Fit

# reasons: identification/README.md, "Constants"
SIZES: Array = 6.0 * np.exp2(np.arange(14))  # lambda
ALIKE = 0.3  # relative scatter of one family's parameters over the joints
TINY = 1e-300  # sums of squares below it count as equal
ROUNDING = 1e-9  # of a log factor
RANK = 1e-9  # eigenvalues below this share of the largest are directions that the data do not determine


@dataclass(frozen=True)
class Decomposition:
    """What a set of M effects explains, in units of the prior: the p amplitudes have covariance I for lambda = 1.

    information : (p, p) matrix S;  amplitudes : (p,) estimates b;  effect : (p,) number of the effect of each
    further : (H, 1) number of parameters and (H, 1) sum of squares explained by one further effect each
    """

    information: Array
    amplitudes: Array
    effect: NDArray[np.int64]
    further: tuple[NDArray[np.int64], Array] | None = None

    @cached_property
    def members(self) -> NDArray[np.bool_]:
        """(p, M) True for the amplitudes of each effect."""
        return np.asarray(self.effect[:, None] == np.arange(self.effect.max(initial=-1) + 1))

    @cached_property
    def by_effect(self) -> Array:
        """(p, p) information of each effect alone, zero between effects."""
        return np.asarray(self.information * (self.members @ self.members.T))

    def with_each(self, sizes: NDArray[np.int64], squares: Array) -> Decomposition:
        """This set with each of H further effects, one at a time.

        sizes : (H,) number of parameters;  squares : (H,) reduction of the sum of squares beside the set
        """
        return replace(self, further=(sizes[:, None], squares[:, None]))


def decomposed(found: Fit, effects: Sequence[Sequence[str]], families: Sequence[bool]) -> Decomposition:
    """Decompose what the effects of a fitted model explain.

    effects : parameter names of each effect;  families : True for effects with one similar parameter for each joint
    """
    of_effects = [found.model.parameters.index(name) for names in effects for name in names]
    information, lengths = beside_base(found.triangle, of_effects)
    effect = np.repeat(np.arange(len(effects)), [len(names) for names in effects])
    root = np.zeros_like(information)  # root root^T is the prior covariance
    for k, family in enumerate(families):
        own = np.ix_(effect == k, effect == k)
        values, vectors = np.linalg.eigh(amplitude_prior(information[own], lengths[effect == k] if family else None))
        root[own] = vectors * np.sqrt(np.maximum(values, 0.0))
    amplitudes = np.linalg.pinv(root, rcond=RANK) @ (lengths * found.values[of_effects])
    return Decomposition(root.T @ information @ root, amplitudes, effect)


def beside_base(triangle: Array, of_effects: Sequence[int]) -> tuple[Array, Array]:
    """(p, p) Gram matrix of the effects' unit columns projected off all other columns, and (p,) their lengths.

    triangle : (r, P) with the products of all P columns of the Jacobian;  of_effects : p of their indices
    """
    lengths = np.linalg.norm(triangle, axis=0)
    columns = triangle / np.where(lengths > 0.0, lengths, 1.0)
    q = np.linalg.qr(np.delete(columns, of_effects, axis=1))[0]
    z = columns[:, of_effects]
    for _ in range(2):  # the second pass removes what rounding left
        z = z - q @ (q.T @ z)
    return z.T @ z, lengths[of_effects]


def amplitude_prior(information: Array, lengths: Array | None) -> Array:
    """(p, p) prior covariance of an effect's amplitudes for lambda = 1, with trace 1 in units of the information.

    information : (p, p);  lengths : (p,) units of a family's parameters, None for any other effect

    It is the inverse of the information; for a family one common value with a relative scatter of `ALIKE`.
    """
    if lengths is None:
        inverse = np.linalg.pinv(information, rcond=RANK, hermitian=True)
        return np.asarray(inverse / max(1, np.linalg.matrix_rank(information, tol=RANK, hermitian=True)))
    alike = (1.0 + ALIKE**2 * np.eye(len(lengths))) * np.outer(lengths, lengths)
    return np.asarray(alike / np.sum(information * alike))


@dataclass(frozen=True)
class _Posterior:
    """A set of M effects for combinations (...) of their sizes, in units of sigma.

    volume : (...) log |I + S V|;  missed : (...) sum of squares that the prior keeps the amplitudes from explaining
    spread, moved : (..., M) of the mean of b^T S b / lambda^2 the part due to the covariance, and that due to the mean
    """

    volume: Array
    missed: Array
    spread: Array
    moved: Array

    @classmethod
    def around(cls, found: Decomposition, sizes: Array) -> _Posterior:
        """(M, len(SIZES)) combinations: one effect with each of the sizes, the others with theirs.

        sizes : (M,) lambda of each effect

        Another size of one effect takes as many dyads from the covariance of the amplitudes as it has amplitudes
        (Woodbury's identity), so that all combinations need one inverse.
        """
        amplitudes, own, precision = found.amplitudes, found.members.T, np.square(sizes[found.effect]) ** -1.0
        volume, covariance = _covariance(found.information, sizes[found.effect])
        values, vectors = _eigen_by_effect(covariance, own)
        dyads, change = covariance @ vectors, SIZES**-2.0 - precision[:, None]
        ratio = 1.0 + change * values[:, None]  # (p, sizes)
        taken = own[:, None, :] * (change / ratio).T  # (M, sizes, p) of each dyad
        mean = covariance @ (found.information @ amplitudes)
        means = mean - taken * (mean @ vectors) @ dyads.T
        precisions = np.where(own[:, None, :], SIZES[:, None] ** -2.0, precision)
        traces = (found.by_effect @ covariance).diagonal() - taken @ ((found.by_effect @ dyads) * dyads).T
        spread, moved = (x * precisions @ own.T for x in (traces, means * (means @ found.by_effect)))
        volumes = volume + own @ np.log(ratio * np.square(SIZES) * precision[:, None])
        # the same as b^T V^-1 mean, as a sum of squares: it cannot fall below zero, and errors of the mean cancel
        off = amplitudes - means
        missed = np.sum(np.square(means) * precisions, axis=-1) + np.sum(off @ found.information * off, axis=-1)
        return cls(volumes, missed, spread, moved)

    def at(self, *index: int) -> _Posterior:
        """One combination."""
        return _Posterior(self.volume[index], self.missed[index], self.spread[index], self.moved[index])

    def log_factors(self, left: Array, squares: float, freedom: int) -> Array:
        """Natural logarithm of the Bayes factors against the base model, in the shape of `left`.

        left : (...) residual sum of squares of the fit and `missed`
        squares, freedom : residual sum of squares and degrees of freedom of the base model
        """
        left = np.maximum(left, TINY)
        with np.errstate(divide="ignore"):  # of what shows only through another effect
            moments = np.log(self.spread + self.moved * (freedom / left)[..., None])
        return np.asarray(-0.5 * self.volume - 0.5 * freedom * np.log(left / squares) + np.sum(moments, axis=-1))


def _covariance(information: Array, scales: Array) -> tuple[Array, Array]:
    """log |I + S V|, and (p, p) posterior covariance of the amplitudes for unit sigma.

    scales : (p,) lambda of each amplitude
    """
    inner = np.eye(len(scales)) + scales[:, None] * information * scales
    return np.linalg.slogdet(inner)[1], scales[:, None] * np.linalg.inv(inner) * scales


def _eigen_by_effect(covariance: Array, own: NDArray[np.bool_]) -> tuple[Array, Array]:
    """(p,) eigenvalues and (p, p) eigenvectors of the covariance of each effect's own amplitudes (M, p)."""
    values, vectors = np.zeros(len(covariance)), np.zeros_like(covariance)
    counts = np.sum(own, axis=1)
    for size in np.unique(counts).tolist():
        at = np.nonzero(own[counts == size])[1].reshape(-1, size)
        block = at[:, :, None], at[:, None, :]
        values[at], vectors[block] = np.linalg.eigh(covariance[block])
    return values, vectors


def log_bayes_factor(found: Decomposition, left: float, squares: float, freedom: int) -> Array:
    """Natural logarithm of the Bayes factor against the base model; (H,) with H further effects, one at a time.

    left : residual sum of squares with the set
    squares, freedom : residual sum of squares and degrees of freedom of the base model
    """
    there, around = _likeliest(found, left, squares, freedom)
    if found.further is None:
        return np.asarray(there.log_factors(left + there.missed, squares, freedom) + around)
    count, explains = found.further
    gain = np.square(SIZES) / count  # (H, sizes)
    kept = gain / (1.0 + gain)
    rest = np.maximum(left + there.missed - explains * kept, TINY)
    own = np.log((kept * count + np.square(kept) * explains * (freedom / rest)) / np.square(SIZES))
    factors = there.log_factors(rest, squares, freedom) + own - 0.5 * count * np.log1p(gain)
    return np.asarray(logsumexp(factors, axis=1) - np.log(len(SIZES)) + around)


def _factors(
    found: Decomposition, at: NDArray[np.int64], left: float, squares: float, freedom: int
) -> tuple[_Posterior, Array]:
    """The posterior of sizes (M,), by their numbers, and of all that differ in one; log factors (M, len(SIZES))."""
    posterior = _Posterior.around(found, SIZES[at])
    return posterior, posterior.log_factors(left + posterior.missed, squares, freedom)


def _likeliest(found: Decomposition, left: float, squares: float, freedom: int) -> tuple[_Posterior, float]:
    """The likeliest sizes of the effects, and the log of the average over all sizes relative to the factor there.

    left, squares, freedom : as for `log_bayes_factor`
    """
    at = np.zeros(found.members.shape[1], dtype=np.int64)
    if not len(at):
        return _Posterior(*np.zeros((2, 1)), *np.zeros((2, 1, 0))).at(0), 0.0
    posterior, factors = _factors(found, at, left, squares, freedom)
    while True:  # one effect at a time, as long as the factor rises
        best, now = np.unravel_index(np.argmax(factors), factors.shape), factors[0, at[0]]
        if not factors[best] > now + ROUNDING:
            break
        trial = np.where(np.arange(len(at)) == best[0], best[1], at)
        further, its_factors = _factors(found, trial, left, squares, freedom)
        if its_factors[0, trial[0]] > now:
            at, posterior, factors = trial, further, its_factors
        else:  # a rise that rounding made up: without noise a set explains all but the last digits
            factors[best] = -np.inf
    there = posterior.at(0, at[0])
    if not np.isfinite(now):
        return there, -np.inf
    return there, float(np.sum(logsumexp(factors, axis=1) - now - np.log(len(SIZES))))
