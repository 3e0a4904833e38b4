"""The Bayes factor of a set of effects against the base model, from one fit: how much likelier it makes the data.

Base parameters have flat priors, sigma the prior 1 / sigma, and the amplitudes of the effects a normal prior whose size
is counted in lambda, the length of what the effects do at the measured postures (off the base model) in units of sigma.
With S the information of the amplitudes beside the base parameters, b their estimate and RSS what the fit leaves, prior
variance lambda^2 sigma^2 V gives in closed form (Zellner's g-prior where V is S^-1)

    |I + lambda^2 S V|^(-1/2) ((RSS + b^T (S^-1 + lambda^2 V)^-1 b) / RSS_0)^(-f / 2)

with f the degrees of freedom of the base model and RSS_0 what it leaves. How large a missing effect is nobody knows:
the mean over sizes equally spaced in log lambda is taken, from those just detectable to those that need no test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from identification.arrays import Array
from identification.gap.fit import Fit

# reasons: identification/README.md, "Constants"
SIZES = 6.0 * 2.0 ** np.arange(7)  # lambda
ALIKE = 0.4  # relative scatter of one family's parameters over the joints
RANK = 1e-9  # eigenvalues below this share of the largest are directions that the data do not determine


@dataclass(frozen=True)
class Explained:
    """What an effect or a set of effects explains, in groups of directions that are alike.

    shares : (G,) prior variance along each direction of a group, in all 1 for each effect
    counts : (G,) directions in the group;  squares : (G,) sum of squares explained along them
    """

    shares: Array
    counts: Array
    squares: Array

    def with_each(self, sizes: NDArray[np.int64], squares: Array) -> Explained:
        """(H, G + 1) these groups and one more for each of H further effects.

        sizes : (H,) parameters of the further effect;  squares : (H,) sum of squares that it explains beside the others
        """
        own, further = (self.shares, self.counts, self.squares), (1.0 / sizes, sizes, squares)
        both = (np.column_stack([np.tile(a, (len(b), 1)), b]) for a, b in zip(own, further, strict=True))
        return Explained(*both)


def explained(found: Fit, effects: Sequence[Sequence[str]], families: Sequence[bool]) -> Explained:
    """What the effects of a fitted model explain.

    effects : names of the parameters of each effect;  families : their parameters are alike, one for each joint
    """
    of_effects = [found.model.parameters.index(name) for names in effects for name in names]
    of_base = [k for k in range(len(found.values)) if k not in of_effects]
    lengths = np.linalg.norm(found.triangle, axis=0)
    jacobian = found.triangle / np.where(lengths > 0.0, lengths, 1.0)
    q, z = np.linalg.qr(jacobian[:, of_base])[0], jacobian[:, of_effects]
    z = z - q @ (q.T @ z)
    z = z - q @ (q.T @ z)
    information = z.T @ z
    prior, start = np.zeros_like(information), 0
    for names, family in zip(effects, families, strict=True):
        own = slice(start, start + len(names))
        prior[own, own] = amplitude_prior(information[own, own], lengths[of_effects][own] if family else None)
        start += len(names)
    values, vectors = np.linalg.eigh(information)
    root = vectors * np.sqrt(
        np.where(values > RANK * values.max(initial=0.0), values, 0.0)
    )  # root root^T is the information
    shares, turn = np.linalg.eigh(root.T @ prior @ root)
    along = turn.T @ (root.T @ (lengths[of_effects] * found.values[of_effects]))
    return Explained(np.maximum(shares, 0.0), np.ones(len(shares)), np.square(along))


def amplitude_prior(information: Array, lengths: Array | None) -> Array:
    """(p, p) prior covariance of an effect's amplitudes for lambda = 1: the inverse of their information (p, p), or for
    a family's, of which `lengths` (p,) are the units, one common value with a scatter of `ALIKE` of it; of trace 1 in
    units of the information."""
    if lengths is None:
        inverse = np.linalg.pinv(information, rcond=RANK, hermitian=True)
        return np.asarray(inverse / max(1, np.linalg.matrix_rank(information, tol=RANK, hermitian=True)))
    alike = (1.0 + ALIKE**2 * np.eye(len(lengths))) * np.outer(lengths, lengths)
    return np.asarray(alike / np.sum(information * alike))


def log_bayes_factor(found: Explained, left: Array, squares: float, freedom: int) -> Array:
    """(...) logarithm of the Bayes factor against the base model.

    found : groups (..., G) of directions;  left : (...) sum of squares with the effects
    squares, freedom : sum of squares and degrees of freedom of the base model
    """
    gain = np.square(SIZES)[:, None] * found.shares[..., None, :]  # (..., sizes, G)
    shrunk = np.sum(found.squares[..., None, :] / (1.0 + gain), axis=-1)
    volume = np.sum(found.counts[..., None, :] * np.log1p(gain), axis=-1)
    fit = np.log(np.maximum(left[..., None] + shrunk, 1e-300) / squares)
    return np.asarray(logsumexp(-0.5 * volume - 0.5 * freedom * fit, axis=-1) - np.log(len(SIZES)))
