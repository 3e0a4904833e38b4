"""F statistics of all hypotheses at once, for one residual vector or for many.

The columns of a hypothesis, projected off the Jacobian of the fitted model, span what only this hypothesis can
explain. With U an orthonormal basis of that (N, d), the sum of squares falls by |U^T r|^2 when it is added, and
F = (|U^T r|^2 / d) / ((|r|^2 - |U^T r|^2) / (dof - d)). All hypotheses share one matrix product, however many.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtr

from identification.arrays import Array

# reasons: identification/README.md, "Constants"
VISIBLE = 1e-4  # fraction of a column's length that must survive projection; less is an alias of what is in the model
TINY = 1e-300  # smaller p-values count as equal


@dataclass(frozen=True)
class Dictionary:
    """Hypotheses projected off a fitted model.

    bases : (N, C) the orthonormal bases side by side;  starts, sizes : (H,) where each begins, how wide it is
    norm_fractions : (H,) of the columns' norm left after projection off the model
    one_sided : (H,) physics allows one sign only;  weights : (H,) prior weights
    """

    model_basis: Array
    bases: Array
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    norm_fractions: Array
    one_sided: NDArray[np.bool_]
    weights: Array

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def freedom(self) -> int:
        """Degrees of freedom the fitted model leaves."""
        return len(self.model_basis) - self.model_basis.shape[1]

    def subset(self, keep: NDArray[np.int64]) -> Dictionary:
        """Only some of the hypotheses."""
        owner = np.repeat(np.arange(len(self)), self.sizes)
        columns = np.isin(owner, keep)
        widths = self.sizes[keep]
        return Dictionary(
            self.model_basis,
            self.bases if columns.all() else self.bases[:, columns],
            np.cumsum(widths) - widths,
            widths,
            self.norm_fractions[keep],
            self.one_sided[keep],
            self.weights[keep],
        )

    def block(self, k: int) -> Array:
        """(N, d) orthonormal basis of one hypothesis."""
        return self.bases[:, self.starts[k] : self.starts[k] + self.sizes[k]]

    def reductions(self, residuals: Array) -> Array:
        """(H, B) reduction of the sum of squares of residuals (N, B) off the model; 0 for the forbidden sign."""
        if len(self) == 0:
            return np.zeros((0, residuals.shape[1]))
        scores = self.bases.T @ residuals
        squares = np.square(scores)
        reductions = np.add.reduceat(squares, self.starts, axis=0) if self.sizes.max() > 1 else squares[self.starts]
        first = scores[self.starts[self.one_sided]]
        reductions[self.one_sided] = np.where(first > 0.0, reductions[self.one_sided], 0.0)
        return reductions

    @cached_property
    def groups(self) -> list[tuple[int, bool, float, NDArray[np.int64]]]:
        """Hypotheses of one (size, one_sided, weight): in a group the largest reduction has the smallest p-value."""
        keys = list(zip(self.sizes.tolist(), self.one_sided.tolist(), self.weights.tolist(), strict=True))
        return [(*key, np.flatnonzero([k == key for k in keys])) for key in sorted(set(keys))]

    def p_values(self, reductions: Array, squares: Array) -> Array:
        """(H, B) p-value of each hypothesis on its own, from the `reductions` (H, B) and the sums of squares (B)."""
        result = np.ones_like(reductions)
        for size, one_sided, _, members in self.groups:
            result[members] = self._p(size, one_sided, reductions[members], squares)
        return result

    def smallest_weighted(self, reductions: Array, squares: Array) -> Array:
        """(B,) smallest p-value divided by prior weight over all hypotheses."""
        best = np.full(reductions.shape[1], np.inf)
        for size, one_sided, weight, members in self.groups:
            best = np.minimum(best, self._p(size, one_sided, reductions[members].max(axis=0), squares) / weight)
        return best

    def _p(self, size: int, one_sided: bool, reductions: Array, squares: Array) -> Array:
        rest = self.freedom - size
        variance = np.maximum(squares - reductions, 1e-12 * squares) / rest
        if one_sided:
            return np.where(reductions > 0.0, np.maximum(stdtr(rest, -np.sqrt(reductions / variance)), TINY), 1.0)
        return np.maximum(fdtrc(size, rest, reductions / size / variance), TINY)

    def f_values(self, reductions: Array, squares: Array) -> Array:
        """(H, B) F statistics."""
        sizes = self.sizes[:, None]
        variance = np.maximum(squares - reductions, 1e-12 * squares) / (self.freedom - sizes)
        return reductions / sizes / variance


def dictionary(model_basis: Array, columns: list[Array], one_sided: NDArray[np.bool_], weights: Array) -> Dictionary:
    """Project the columns (N, d) of each hypothesis off a fitted model and orthonormalise them.

    model_basis : (N, r) orthonormal basis of the columns of the model's Jacobian, `information.column_space`

    Directions of which less than `VISIBLE` survives are dropped; a hypothesis that has none left gets size 0, and the
    caller must leave it out.
    """
    sizes = np.array([c.shape[1] for c in columns], dtype=np.int64)
    stacked = _projected(model_basis, columns)
    starts = np.cumsum(sizes) - sizes
    norm_fractions, widths = np.zeros(len(sizes)), np.zeros(len(sizes), dtype=np.int64)
    seen = np.zeros(len(stacked), dtype=bool)
    for size in np.unique(sizes):
        members = np.flatnonzero(sizes == size)
        index = starts[members][:, None] + np.arange(size)  # (members, d)
        stacked[index], lengths = _orthonormalized(stacked[index])
        norm_fractions[members] = lengths[:, 0]
        widths[members] = np.sum(lengths > VISIBLE, axis=1)
        seen[index] = lengths > VISIBLE
    bases = stacked.T if seen.all() else stacked[seen].T
    return Dictionary(model_basis, bases, np.cumsum(widths) - widths, widths, norm_fractions, one_sided, weights)


def _projected(model_basis: Array, columns: list[Array]) -> Array:
    """(C, N) the columns of all hypotheses scaled to unit length, then projected off the model.

    A row for each column, so that what is worked on together lies together in memory.
    """
    stacked = np.concatenate([np.zeros((0, len(model_basis))), *(c.T for c in columns)])
    norms = np.linalg.norm(stacked, axis=1, keepdims=True)
    stacked /= np.where(norms > 0.0, norms, 1.0)
    for _ in range(2):  # the second pass removes what rounding left
        stacked -= (stacked @ model_basis) @ model_basis.T
    return stacked


def _orthonormalized(blocks: Array) -> tuple[Array, Array]:
    """(H, d, N) orthonormal rows spanning those of each block, and (H, d) their lengths before, ascending."""
    squares, turn = np.linalg.eigh(blocks @ blocks.transpose(0, 2, 1))
    lengths = np.sqrt(np.maximum(squares, 0.0))
    if blocks.shape[1] == 1:
        turn = np.ones_like(turn)  # a positive score is a positive parameter
    return (turn / np.maximum(lengths, VISIBLE)[:, None, :]).transpose(0, 2, 1) @ blocks, lengths
