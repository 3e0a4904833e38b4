"""Quadratic forms of residuals relative to their sum of squares, e^T A e / e^T e, and their moments for white noise.

For white Gaussian noise projected off a model (e = P z, P = I - Q Q^T of rank nu) the ratio is independent of e^T e, so
with B = P A P its mean is tr B / nu and its mean square (2 tr B^2 + (tr B)^2) / (nu (nu + 2)), both exactly
(H. Theil, "Principles of Econometrics", 1971, on the moments of the von Neumann ratio).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class BlockForm:
    """sum_i e_i^T W_i e_i;  blocks : (m, d, d) symmetric W_i"""

    blocks: Array

    def times(self, vectors: Array) -> Array:
        """(m d, B) A v of vectors (m d, B)."""
        m, d, _ = self.blocks.shape
        return np.asarray((self.blocks @ vectors.reshape(m, d, -1)).reshape(vectors.shape))

    @property
    def trace(self) -> float:
        """tr A."""
        return float(np.einsum("mii->", self.blocks))

    @property
    def squared_trace(self) -> float:
        """tr A^2."""
        return float(np.sum(self.blocks**2))


@dataclass(frozen=True)
class LagForm:
    """sum_i e_i^T e_(i-1) over d coordinates;  sequence : (m,) row numbers in the order of measurement"""

    sequence: NDArray[np.int64]
    dimension: int

    def times(self, vectors: Array) -> Array:
        """(m d, B) A v of vectors (m d, B): half the row before and half the row after."""
        rows = vectors.reshape(len(self.sequence), self.dimension, -1)
        found = np.zeros_like(rows)
        found[self.sequence[1:]] += 0.5 * rows[self.sequence[:-1]]
        found[self.sequence[:-1]] += 0.5 * rows[self.sequence[1:]]
        return found.reshape(vectors.shape)

    @property
    def trace(self) -> float:
        """tr A: no row is its own neighbor."""
        return 0.0

    @property
    def squared_trace(self) -> float:
        """tr A^2: 2 (1/2)^2 for each pair of consecutive rows and each coordinate."""
        return 0.5 * (len(self.sequence) - 1) * self.dimension


@dataclass(frozen=True)
class SparseForm:
    """sum_ij A_ij e_i^T e_j over d coordinates;  matrix : (m, m) symmetric"""

    matrix: csr_array
    dimension: int

    def times(self, vectors: Array) -> Array:
        """(m d, B) A v of vectors (m d, B)."""
        rows = vectors.reshape(self.matrix.shape[0], -1)
        return np.asarray(self.matrix @ rows).reshape(vectors.shape)

    @property
    def trace(self) -> float:
        """tr A."""
        return self.dimension * float(self.matrix.trace())

    @property
    def squared_trace(self) -> float:
        """tr A^2."""
        return self.dimension * float(self.matrix.power(2).sum())


Form = BlockForm | LagForm | SparseForm


def ratio(form: Form, sample: Array) -> Array:
    """(B,) e^T A e / e^T e of each column of a sample (N, B)."""
    return np.asarray(np.einsum("nb,nb->b", sample, form.times(sample)) / np.einsum("nb,nb->b", sample, sample))


def ratios(forms: Mapping[str, Form], sample: Array) -> dict[str, Array]:
    """(B,) `ratio` of several forms; block forms share the products of the coordinates of each row."""
    found = {name: ratio(form, sample) for name, form in forms.items() if not isinstance(form, BlockForm)}
    stacked = {name: form.blocks for name, form in forms.items() if isinstance(form, BlockForm)}
    if not stacked:
        return found
    blocks = np.array(list(stacked.values()))
    d = blocks.shape[-1]
    coordinates = np.moveaxis(sample.reshape(-1, d, sample.shape[1]), 1, 0)
    values, whole = np.zeros((len(blocks), sample.shape[1])), np.zeros(sample.shape[1])
    for i, j in combinations_with_replacement(range(d), 2):
        both = coordinates[i] * coordinates[j]
        values += (blocks[:, :, i, j] if i == j else blocks[:, :, i, j] + blocks[:, :, j, i]) @ both
        if i == j:
            whole += both.sum(axis=0)
    return found | dict(zip(stacked, values / whole, strict=True))


def ratio_moments(form: Form, basis: Array) -> tuple[float, float]:
    """Mean and standard deviation of `ratio` for white Gaussian noise projected off an orthonormal basis Q (N, r)."""
    freedom = len(basis) - basis.shape[1]
    applied = form.times(basis)
    inside = basis.T @ applied
    trace = form.trace - float(np.trace(inside))
    squared = form.squared_trace - 2.0 * float(np.sum(applied**2)) + float(np.sum(inside**2))
    mean = trace / freedom
    variance = (2.0 * squared + trace**2) / (freedom * (freedom + 2.0)) - mean**2
    return mean, float(np.sqrt(max(variance, 0.0)))
