"""Bayes factor of a set of effects against the base model, in closed form from one fit.

Base parameters have flat priors and sigma the prior 1 / sigma. The prior of an effect's amplitudes is set by its size
lambda: the length, in units of sigma, of its contribution at the measured postures after projection off the base model.
A missing effect has a size other than zero: the prior density of the amplitudes b is proportional to

    (b^T S b / sigma^2) exp(-b^T V^-1 b / (2 lambda^2 sigma^2))

with S their information matrix (moment prior of V. E. Johnson and D. Rossell, 2010; without the first factor and with
V = S^-1 it is A. Zellner's g-prior). With RSS and RSS_0 the residual sums of squares of the fit and of the base model,
b the estimate and f the degrees of freedom of the base model, the Bayes factor is

    |I + lambda^2 S V|^(-1/2) (R / RSS_0)^(-f / 2) E,   R = RSS + b^T (S^-1 + lambda^2 V)^-1 b,

with E the posterior mean of b^T S b / (lambda sigma)^2 of each effect. As the size of a missing effect is unknown, the
Bayes factor is averaged over sizes equally spaced in log lambda, from just detectable to obvious without a test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from identification.arrays import Array
from identification.gap.fit import Fit

# reasons: identification/README.md, "Constants"
SIZES = 6.0 * 2.0 ** np.arange(7)  # lambda
ALIKE = 0.3  # relative scatter of one family's parameters over the joints
TINY = 1e-300  # sums of squares below it count as equal
RANK = 1e-9  # eigenvalues below this share of the largest are directions that the data do not determine


@dataclass(frozen=True)
class Decomposition:
    """What a set of M effects explains, decomposed along G orthogonal directions.

    shares : (G,) prior variance along each direction, with sum 1 for each effect
    counts : (G,) multiplicity of each direction;  lengths : (G,) what the fit explains along it
    forms : (M, G, G) b^T S b of each effect as a quadratic form of `lengths`
    further : (H, 1) number of parameters and (H, 1) sum of squares explained by one further effect each
    """

    shares: Array
    counts: Array
    lengths: Array
    forms: Array
    further: tuple[NDArray[np.int64], Array] | None = None

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
    prior, parts, start = np.zeros_like(information), [], 0
    for names, family in zip(effects, families, strict=True):
        own = slice(start, start + len(names))
        prior[own, own] = amplitude_prior(information[own, own], lengths[own] if family else None)
        parts.append(np.zeros_like(information))
        parts[-1][own, own] = information[own, own]
        start += len(names)
    values, vectors = np.linalg.eigh(information)
    seen = values > RANK * values.max(initial=0.0)
    root = vectors[:, seen] * np.sqrt(values[seen])  # root root^T is the information
    shares, turn = np.linalg.eigh(root.T @ prior @ root)
    back = vectors[:, seen] / np.sqrt(values[seen]) @ turn  # from what is explained to amplitudes
    forms = np.array([back.T @ part @ back for part in parts]).reshape(len(parts), len(shares), len(shares))
    along = turn.T @ (root.T @ (lengths * found.values[of_effects]))
    return Decomposition(np.maximum(shares, 0.0), np.ones(len(shares)), along, forms)


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


def log_bayes_factor(found: Decomposition, left: Array, squares: float, freedom: int) -> Array:
    """Natural logarithm of the Bayes factor against the base model, in the shape of `left`.

    left : (...) residual sum of squares with the effects, (H,) where there are H further ones
    squares, freedom : residual sum of squares and degrees of freedom of the base model
    """
    gain = np.square(SIZES)[:, None] * found.shares  # (sizes, G)
    kept = gain / (1.0 + gain)
    mean = kept * found.lengths
    rest = left[..., None] + np.sum(np.square(found.lengths) * (1.0 - kept), axis=1)
    volume = np.log1p(gain) @ found.counts
    effects = [((kept * found.counts) @ np.diag(form), np.sum(mean @ form * mean, axis=1)) for form in found.forms]
    if found.further is not None:
        count, explains = found.further
        more = np.square(SIZES) / count  # (H, sizes)
        more_kept = more / (1.0 + more)
        rest = rest + explains * (1.0 - more_kept)
        volume = volume + count * np.log1p(more)
        effects.append((more_kept * count, np.square(more_kept) * explains))
    rest = np.maximum(rest, TINY)
    factors = -0.5 * volume - 0.5 * freedom * np.log(rest / squares)
    for spread, moved in effects:
        with np.errstate(divide="ignore"):  # of what shows only through another effect
            factors = factors + np.log((spread + moved * (freedom / rest)) / np.square(SIZES))
    return np.asarray(logsumexp(factors, axis=-1) - np.log(len(SIZES)))
