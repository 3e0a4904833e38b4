"""Omnibus test: a wild bootstrap of the smallest weighted p-value over all hypotheses.

In each draw the residuals of a posture keep their size and direction and only their common sign is random. Noise that
is larger at some postures (joint noise, noise that increases with the reach) therefore raises no false alarms, as it
does with the plain F test. Residuals are first corrected for leverage (HC2: MacKinnon & White 1985; wild bootstrap:
Wu 1986, Davidson & Flachaire 2008).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from identification.arrays import Array
from identification.gap.hypotheses.f_tests import CHUNK, Dictionary

# reasons: identification/README.md, "Constants"
MANY = 1000  # postures from which sums over them count as normally distributed
BLOCK = 10_000  # draws whose random numbers are held at once
RIDGE = 1e-12  # of the mean variance: keeps the root of a singular covariance alive
Scatter = tuple[Array, Array]  # residual (N,) and basis (N, p) of the fit that left it


@dataclass(frozen=True)
class OmnibusTest:
    """Result of the test of H hypotheses.

    p : (H,) p-value of each by itself;  adjusted : (H,) adjusted for all that were tested
    reductions : (H,) of the sum of squares by each;  f : (H,) F statistics
    threshold : 5 % quantile of the smallest weighted p-value under the null hypothesis, by the bootstrap
    """

    p: Array
    adjusted: Array
    reductions: Array
    f: Array
    threshold: float

    @property
    def smallest(self) -> float:
        """Adjusted p-value of the strongest hypothesis."""
        return float(self.adjusted.min(initial=1.0))


def leverage_corrected(residual: Array, model_basis: Array, dimension: int) -> Array:
    """(m, d) residuals of each posture times (I - H_ii)^(-1/2), with H_ii (d, d) its block of the hat matrix.

    residual : (m d,);  model_basis : (m d, r) orthonormal basis of the Jacobian's columns
    """
    blocks = model_basis.reshape(len(residual) // dimension, dimension, -1)
    rest = np.eye(dimension) - blocks @ blocks.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(rest)
    factor = 1.0 / np.sqrt(np.maximum(values, 1e-3))
    matrices = vectors * factor[:, None, :] @ vectors.transpose(0, 2, 1)
    return np.einsum("mij,mj->mi", matrices, residual.reshape(-1, dimension))


class Draws(NamedTuple):
    """B draws of null data: (D, B) scores of the hypotheses' basis vectors, and (B,) sums of squares off the model."""

    scores: Array
    squares: Array


def wild_draws(corrected: Array, hypotheses: Dictionary, draws: int, generator: np.random.Generator) -> Iterator[Draws]:
    """Draws of the wild bootstrap, in parts: corrected residuals (m, d) with one random sign for each posture.

    A score is the sum over postures of a sign times the contribution of the posture. From `MANY` postures on it is
    drawn from the normal distribution with the covariance of those sums, which is known exactly.
    """
    parts, inside = product_contributions(corrected, hypotheses)
    total, rank = np.sum(corrected**2), inside.shape[1]
    of_each = hypotheses.scores(parts.T, inside.T)  # (D, m) what each posture contributes to the scores
    if len(corrected) < MANY or len(hypotheses.index) > draws:  # normal draws take the root of a larger matrix
        for signs in _in_parts(
            lambda count: generator.integers(0, 2, (len(corrected), count)).astype(float), hypotheses, draws
        ):
            drawn = signs * 2.0 - 1.0
            yield Draws(of_each @ drawn, total - np.square(inside.T @ drawn).sum(axis=0))
        return
    together = np.concatenate([of_each, inside.T])
    root = square_root(together @ together.T)
    for normal in _in_parts(lambda count: generator.standard_normal((len(together), count)), hypotheses, draws):
        drawn = root @ normal
        yield Draws(drawn[:-rank], total - np.square(drawn[-rank:]).sum(axis=0))


def _in_parts(drawn: Callable[[int], Array], hypotheses: Dictionary, draws: int) -> Iterator[Array]:
    """Random numbers (rows, draws) in parts, each small enough that its scores are about `CHUNK` numbers.

    drawn : function of a number of draws, at most `BLOCK`, -> (rows, that number)
    """
    step = max(CHUNK // max(len(hypotheses.index), 1), 1)
    for start in range(0, draws, BLOCK):
        numbers = drawn(min(BLOCK, draws - start))
        yield from (numbers[:, k : k + step] for k in range(0, numbers.shape[1], step))


def smallest_drawn(hypotheses: Dictionary, drawn: Iterable[Draws]) -> Array:
    """(B,) smallest weighted p-value of each draw."""
    return np.concatenate([hypotheses.smallest_weighted(one.scores, one.squares) for one in drawn])


def product_contributions(corrected: Array, hypotheses: Dictionary) -> tuple[Array, Array]:
    """(m, C) and (m, r) contributions of each posture to the products of the residuals with columns and basis."""
    m, d = corrected.shape
    residual, matrix = corrected.ravel(), hypotheses.columns.matrix
    parts = np.empty((m, matrix.shape[1]))
    for rows in hypotheses.columns.chunks(d):
        weighted = matrix[rows] * residual[rows, None]
        parts[rows.start // d : rows.stop // d] = weighted.reshape(-1, d, matrix.shape[1]).sum(axis=1)
    inside = hypotheses.model_basis * residual[:, None]
    return parts, inside.reshape(m, d, -1).sum(axis=1)


def square_root(covariance: Array) -> Array:
    """Lower Cholesky factor of a covariance, which is changed in place by a small ridge as it may be singular."""
    covariance[np.diag_indices_from(covariance)] += RIDGE * np.trace(covariance) / max(len(covariance), 1)
    return np.asarray(np.linalg.cholesky(covariance))


def omnibus_test(
    residual: Array,
    hypotheses: Dictionary,
    dimension: int,
    draws: int,
    generator: np.random.Generator,
    scatter: Scatter | None = None,
) -> OmnibusTest:
    """Test all hypotheses on the residual (m d,) of the fitted model.

    dimension : d, coordinates per posture
    scatter : residual and basis of the fit whose residuals are resampled; None: those of the model itself
    """
    observed = residual[:, None] - hypotheses.model_basis @ (hypotheses.model_basis.T @ residual[:, None])
    squares = np.square(observed).sum(axis=0)
    reductions = hypotheses.reductions(observed)
    p = hypotheses.p_values(reductions, squares)[:, 0]
    corrected = leverage_corrected(*(scatter or (observed[:, 0], hypotheses.model_basis)), dimension)
    drawn = wild_draws(corrected, hypotheses, draws, generator)
    smallest = np.sort(smallest_drawn(hypotheses, drawn))
    ranks = np.searchsorted(smallest, p / hypotheses.weights, side="right")
    f = hypotheses.f_values(reductions, squares)[:, 0]
    adjusted = np.asarray((1.0 + ranks) / (draws + 1.0))
    return OmnibusTest(p, adjusted, reductions[:, 0], f, float(smallest[int(0.05 * draws)]))
