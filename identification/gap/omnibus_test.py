"""The omnibus test: is any effect missing?

A posture-wise wild bootstrap of the smallest weighted p-value over all hypotheses. The residuals of each posture keep
their size and direction and change only their common sign, so noise that is larger at some postures (joint noise,
noise that grows with the reach) does not raise false alarms as it does with the plain F test. Residuals are corrected
for leverage first (HC2: MacKinnon & White 1985; wild bootstrap: Wu 1986, Davidson & Flachaire 2008).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array
from identification.gap.f_tests import Dictionary

Scatter = tuple[Array, Array]  # residual (N,) and basis (N, p) of the fit that left it


@dataclass(frozen=True)
class OmnibusTest:
    """p : (H,) of each hypothesis alone;  adjusted : (H,) for all that were tried
    reductions : (H,) of the sum of squares by each;  f : (H,) F statistics
    threshold : the weighted p-value that one null data set in twenty falls below (by the bootstrap)
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
    """(m, d) residuals of each posture times (I - H_ii)^(-1/2), H_ii (d, d) the posture's block of the hat matrix."""
    blocks = model_basis.reshape(len(residual) // dimension, dimension, -1)
    rest = np.eye(dimension) - blocks @ blocks.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(rest)
    factor = 1.0 / np.sqrt(np.maximum(values, 1e-3))
    matrices = vectors * factor[:, None, :] @ vectors.transpose(0, 2, 1)
    return np.einsum("mij,mj->mi", matrices, residual.reshape(-1, dimension))


def wild_draws(
    residual: Array,
    residual_basis: Array,
    model_basis: Array,
    dimension: int,
    draws: int,
    generator: np.random.Generator,
) -> Array:
    """(N, draws) bootstrap residuals: corrected residuals with one random sign per posture, projected off the model.

    residual_basis : of the model that left the residual, whose leverages are corrected for
    dimension : d, coordinates per posture
    """
    corrected = leverage_corrected(residual, residual_basis, dimension)
    signs = generator.integers(0, 2, (len(corrected), draws)) * 2.0 - 1.0
    drawn = (corrected[:, :, None] * signs[:, None, :]).reshape(len(residual), draws)
    return drawn - model_basis @ (model_basis.T @ drawn)


def omnibus_test(
    residual: Array,
    hypotheses: Dictionary,
    dimension: int,
    draws: int,
    generator: np.random.Generator,
    scatter: Scatter | None = None,
) -> OmnibusTest:
    """Test all hypotheses against the residual (N = m d,) of the fitted model.

    dimension : d, coordinates per posture
    scatter : a fit whose residuals show how large the noise is at each posture; None: those of the model itself
    """
    observed = residual[:, None] - hypotheses.model_basis @ (hypotheses.model_basis.T @ residual[:, None])
    squares = np.square(observed).sum(axis=0)
    reductions = hypotheses.reductions(observed)
    p = hypotheses.p_values(reductions, squares)[:, 0]
    left, own = scatter or (observed[:, 0], hypotheses.model_basis)
    drawn = wild_draws(left, own, hypotheses.model_basis, dimension, draws, generator)
    smallest = np.sort(hypotheses.smallest_weighted(hypotheses.reductions(drawn), np.square(drawn).sum(axis=0)))
    ranks = np.searchsorted(smallest, p / hypotheses.weights, side="right")
    f = hypotheses.f_values(reductions, squares)[:, 0]
    adjusted = np.asarray((1.0 + ranks) / (draws + 1.0))
    return OmnibusTest(p, adjusted, reductions[:, 0], f, float(smallest[int(0.05 * draws)]))
