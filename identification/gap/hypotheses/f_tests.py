"""F statistics of all hypotheses at once, for one residual vector or for many.

The columns of a hypothesis, projected off the Jacobian of the fitted model, span what only this hypothesis can
explain. With U (N, d) an orthonormal basis of that space, adding the hypothesis reduces the sum of squares by
|U^T r|^2, and F = (|U^T r|^2 / d) / ((|r|^2 - |U^T r|^2) / (dof - d)). All hypotheses share one matrix product, and U
is never formed: with Q the basis of the model and X the columns, U = (X - Q Q^T X) T with small blocks T, so that
U^T r = T^T (X^T r - (Q^T X)^T Q^T r) needs only products of the original columns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc, stdtr

from identification.arrays import Array, eigen_of_pairs

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# reasons: identification/README.md, "Constants"
VISIBLE = 1e-4  # fraction of a column's length that must survive projection; less is an alias of what is in the model
TINY = 1e-300  # smaller p-values count as equal
CHUNK = 2**20  # numbers worked on at once: eight megabytes


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of all hypotheses side by side, shared by many fitted models.

    matrix : (N, C);  sizes : (H,) number of columns of each hypothesis
    """

    matrix: Array
    sizes: NDArray[np.int64]

    @classmethod
    def of(cls, columns: Sequence[Array], rows: int) -> Columns:
        """Stack the columns (N, d) of each hypothesis;  rows : N."""
        sizes = np.array([c.shape[1] for c in columns], dtype=np.int64)
        return cls(np.concatenate([np.zeros((rows, 0)), *columns], axis=1), sizes)

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """(H,) index of the first column of each hypothesis."""
        return np.cumsum(self.sizes) - self.sizes

    def places(self, size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(h,) indices of the hypotheses of a size, and (h, size) indices of their columns."""
        members = np.flatnonzero(self.sizes == size)
        return members, self.starts[members][:, None] + np.arange(size)

    @cached_property
    def products(self) -> dict[int, Array]:
        """Size -> (h, size, size) Gram matrices of the h hypotheses of that size."""
        return {size: self._products(self.places(size)[1]) for size in np.unique(self.sizes).tolist()}

    def _products(self, index: NDArray[np.int64]) -> Array:
        """(h, size, size) Gram matrices of hypotheses with these columns (h, size)."""
        found = np.zeros((len(index), index.shape[1], index.shape[1]))
        for part in self.chunks():
            block = self.matrix[part][:, index.ravel()].reshape(-1, *index.shape).transpose(1, 2, 0)
            found += block @ block.transpose(0, 2, 1)
        return found

    def changed(self, places: NDArray[np.int64], columns: Array) -> Columns:
        """The same with other columns (N, c) at these places (c,), all those of some hypotheses."""
        matrix = self.matrix.copy()
        matrix[:, places] = columns
        found = Columns(matrix, self.sizes)
        products = {size: known.copy() for size, known in self.products.items()}
        for size, known in products.items():
            index = self.places(size)[1]
            if (other := np.isin(index[:, 0], places)).any():
                known[other] = found._products(index[other])
        found.__dict__["products"] = products  # of the others they are known
        return found

    def chunks(self, multiple: int = 1) -> Iterator[slice]:
        """Slices of rows with about `CHUNK` numbers each, each starting at a multiple of `multiple` rows."""
        step = max(CHUNK // max(self.matrix.shape[1], 1) // multiple, 1) * multiple
        return (slice(k, k + step) for k in range(0, len(self.matrix), step))


@dataclass(frozen=True, eq=False)
class Group:
    """Hypotheses of equal size, sign and prior weight.

    members : (h,) their indices;  starts : (h,) index of the first basis vector of each
    """

    size: int
    one_sided: bool
    weight: float
    members: NDArray[np.int64]
    starts: NDArray[np.int64]

    def reductions(self, scores: Array) -> Array:
        """(h, B) reduction of the sum of squares by each, from the scores (D, B) of all; 0 for a forbidden sign."""
        found = np.square(self._rows(scores, 0))
        for further in range(1, self.size):
            found += np.square(self._rows(scores, further))
        return np.where(self._rows(scores, 0) > 0.0, found, 0.0) if self.one_sided else found

    def _rows(self, scores: Array, further: int) -> Array:
        """(h, B) scores of basis vector number `further` of each; a view where they are equally spaced."""
        first, last = int(self.starts[0]), int(self.starts[-1])
        step = (last - first) // (len(self.starts) - 1) if len(self.starts) > 1 else 1
        if step > 0 and np.array_equal(self.starts, np.arange(first, last + 1, step)):
            return scores[first + further : last + further + 1 : step]
        return np.asarray(scores[self.starts + further])


@dataclass(frozen=True, eq=False)
class Dictionary:
    """Hypotheses projected off a fitted model.

    columns : of these and possibly of further hypotheses;  model_basis : (N, r) orthonormal basis Q of the model
    inside : (r, C) products Q^T X with the columns
    index, turn : (D, w) basis vector k is sum_j turn[k, j] times the projected column index[k, j]
    starts, sizes : (H,) index of the first of each hypothesis's basis vectors among all D, and their number
    norm_fractions : (H,) fraction of the columns' norm left after projection off the model
    one_sided : (H,) True where physics allows one sign only;  weights : (H,) prior weights
    """

    columns: Columns
    model_basis: Array
    inside: Array
    index: NDArray[np.int64]
    turn: Array
    starts: NDArray[np.int64]
    sizes: NDArray[np.int64]
    norm_fractions: Array
    one_sided: NDArray[np.bool_]
    weights: Array

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def freedom(self) -> int:
        """Residual degrees of freedom of the fitted model."""
        return len(self.model_basis) - self.model_basis.shape[1]

    def subset(self, keep: NDArray[np.int64]) -> Dictionary:
        """The dictionary of some of the hypotheses, by their indices."""
        widths = self.sizes[keep]
        starts = np.cumsum(widths) - widths
        chosen = np.repeat(self.starts[keep] - starts, widths) + np.arange(int(widths.sum()))
        return replace(
            self,
            index=self.index[chosen],
            turn=self.turn[chosen],
            starts=starts,
            sizes=widths,
            norm_fractions=self.norm_fractions[keep],
            one_sided=self.one_sided[keep],
            weights=self.weights[keep],
        )

    def _vectors(self, k: int) -> NDArray[np.int64]:
        return self.starts[k] + np.arange(self.sizes[k])

    def block(self, k: int) -> Array:
        """(N, d) orthonormal basis of one hypothesis."""
        vectors = self._vectors(k)
        used = np.unique(self.index[vectors])
        turn = np.zeros((len(used), len(vectors)))
        for column, v in enumerate(vectors):
            np.add.at(turn[:, column], np.searchsorted(used, self.index[v]), self.turn[v])
        return self.columns.matrix[:, used] @ turn - self.model_basis @ (self.inside[:, used] @ turn)

    @cached_property
    def products(self) -> dict[int, tuple[Array, Array]]:
        """Size -> (h, size, size) Gram matrices of the hypotheses of that size in `columns`, before and after
        projection."""
        found = {}
        for size, before in self.columns.products.items():
            inside = self.inside.T[self.columns.places(size)[1]]
            found[size] = before, before - inside @ inside.transpose(0, 2, 1)
        return found

    def scores(self, raw: Array, model_scores: Array) -> Array:
        """(D, B) U^T r of vectors r, from X^T r (C, B) and Q^T r (rank, B)."""
        return np.asarray(self._turns @ (raw - self.inside.T @ model_scores))

    @cached_property
    def _turns(self) -> csr_array:
        """(D, C) sparse matrix T^T: coefficients of the projected columns in each basis vector."""
        from scipy.sparse import csr_array

        vector, j = np.nonzero(self.turn)
        place = (vector, self.index[vector, j])
        return csr_array((self.turn[vector, j], place), shape=(len(self.index), self.columns.matrix.shape[1]))

    def reductions(self, residuals: Array) -> Array:
        """(H, B) reduction of the sum of squares of residuals (N, B); 0 for a forbidden sign."""
        return self.reductions_of(self.scores(self.columns.matrix.T @ residuals, self.model_basis.T @ residuals))

    def reductions_of(self, scores: Array) -> Array:
        """`reductions` from the scores (D, B)."""
        if len(self) == 0:
            return np.zeros((0, scores.shape[1]))
        found = np.empty((len(self), scores.shape[1]), dtype=scores.dtype)
        for group in self.groups:
            found[group.members] = group.reductions(scores)
        return found

    @cached_property
    def groups(self) -> list[Group]:
        """Hypotheses by size, sign and weight: within a group the largest reduction has the smallest p-value."""
        order = np.lexsort((self.weights, self.one_sided, self.sizes))
        keys = [values[order] for values in (self.sizes, self.one_sided, self.weights)]
        new = np.any([np.diff(values) != 0 for values in keys], axis=0)
        parts = np.split(order, np.flatnonzero(new) + 1) if len(order) else []
        return [
            Group(int(self.sizes[k[0]]), bool(self.one_sided[k[0]]), float(self.weights[k[0]]), k, self.starts[k])
            for k in parts
        ]

    def p_values(self, reductions: Array, squares: Array) -> Array:
        """(H, B) p-value of each hypothesis by itself, from `reductions` (H, B) and sums of squares (B,)."""
        result = np.ones_like(reductions)
        for group in self.groups:
            result[group.members] = self._p(group, reductions[group.members], squares)
        return result

    def smallest_weighted(self, scores: Array, squares: Array) -> Array:
        """(B,) smallest ratio of p-value to prior weight over all hypotheses, from the scores (D, B)."""
        best = np.full(scores.shape[1], np.inf)
        for group in self.groups:
            largest = group.reductions(scores).max(axis=0)
            best = np.minimum(best, self._p(group, largest, squares) / group.weight)
        return best

    def _p(self, group: Group, reductions: Array, squares: Array) -> Array:
        size, rest = group.size, self.freedom - group.size
        variance = np.maximum(squares - reductions, 1e-12 * squares) / rest
        if group.one_sided:
            return np.where(reductions > 0.0, np.maximum(stdtr(rest, -np.sqrt(reductions / variance)), TINY), 1.0)
        return np.maximum(fdtrc(size, rest, reductions / size / variance), TINY)

    def f_values(self, reductions: Array, squares: Array) -> Array:
        """(H, B) F statistics."""
        sizes = self.sizes[:, None]
        variance = np.maximum(squares - reductions, 1e-12 * squares) / (self.freedom - sizes)
        return reductions / sizes / variance


def dictionary(
    model_basis: Array,
    columns: Columns,
    one_sided: NDArray[np.bool_],
    weights: Array,
    inside: Array | None = None,
) -> Dictionary:
    """Project the columns of each hypothesis off a fitted model and orthonormalize them.

    model_basis : (N, r) orthonormal basis of the columns of the model's Jacobian, `information.column_space`
    one_sided, weights : (H,) as in `Dictionary`
    inside : (r, C) products of the basis with the columns; None: computed here

    Directions whose length falls below the fraction `VISIBLE` are dropped; a hypothesis without any is given size 0,
    and the caller must leave it out.
    """
    inside = model_basis.T @ columns.matrix if inside is None else inside
    widest = int(columns.sizes.max(initial=1))
    count = int(columns.sizes.sum())
    index, turn = np.zeros((count, widest), dtype=np.int64), np.zeros((count, widest))
    norm_fractions, widths = np.zeros(len(columns.sizes)), np.zeros(len(columns.sizes), dtype=np.int64)
    seen = np.zeros(count, dtype=bool)
    for size, products in columns.products.items():
        members, places = columns.places(size)
        index[places, :size] = places[:, None, :]
        turn[places, :size], lengths = _orthonormal(products, inside.T[places])
        norm_fractions[members] = lengths[:, 0]
        widths[members] = np.sum(lengths > VISIBLE, axis=1)
        seen[places] = lengths > VISIBLE
    starts = np.cumsum(widths) - widths
    found = (index[seen], turn[seen], starts, widths, norm_fractions)
    return Dictionary(columns, model_basis, inside, *found, one_sided, weights)


def _orthonormal(products: Array, inside: Array) -> tuple[Array, Array]:
    """Coefficients of an orthonormal basis in the projected columns of each hypothesis.

    products : (h, d, d) Gram matrices of the columns;  inside : (h, d, r) their products with the model's basis

    Returns (h, d, d) coefficients, one row for each basis vector, and (h, d) singular values of the projected columns
    scaled to unit length before projection, ascending.
    """
    norms = np.sqrt(np.einsum("hdd->hd", products))
    unit = 1.0 / np.where(norms > 0.0, norms, 1.0)
    left = (products - inside @ inside.transpose(0, 2, 1)) * unit[:, :, None] * unit[:, None, :]
    squares, directions = eigen_of_pairs(left) if left.shape[1] == 2 else np.linalg.eigh(left)
    lengths = np.sqrt(np.maximum(squares, 0.0))
    if products.shape[1] == 1:
        directions = np.ones_like(directions)  # a positive score is a positive parameter
    scaled = directions / np.maximum(lengths, VISIBLE)[:, None, :] * unit[:, :, None]
    return scaled.transpose(0, 2, 1), lengths
