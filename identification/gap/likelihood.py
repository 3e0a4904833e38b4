"""Marginal likelihood of sets of blocks, in the space of their columns, whose products G = Z^T Z, c = Z^T y and y^T y
are projected off the base (identification/README.md, "One posterior").

What a set leaves of all columns is V = Z^T (I + Z_A D^2 Z_A^T)^-1 Z; of it the blocks' own parts are kept. With one
block more or less, V changes by a term of that block's rank (M. A. Woodbury, 1950).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, solve_triangular
from scipy.special import log_ndtr

from identification.arrays import Array
from identification.information import VISIBLE, significant

# of a block's contribution, in standard deviations of the noise. Prior: from what can just not be seen by itself to a
# tenth of the reach, equally spaced in log lambda
SIZES: Array = 3.0 * np.exp2(np.arange(14))
LEAST = 1e-14  # of y^T y, and of a probability of 1; numerical: what rounding leaves of a sum

Index = NDArray[np.int64]
Key = tuple[tuple[int, int], ...]  # blocks with the numbers of their sizes, ascending
Remaining = tuple[Array, tuple[Array, ...]]  # of all columns, `State.remaining`


def orthonormal(gram: Array, tolerance: float = VISIBLE) -> Array:
    """(w, r) combinations, orthonormal, of columns with these products (w, w);  tolerance : of `significant`"""
    lengths = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / np.outer(lengths, lengths))
    seen = significant(values, tolerance)
    return np.asarray(vectors[:, seen] / np.sqrt(values[seen]) / lengths[:, None])


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the P columns of B blocks, projected off the base model.

    gram, right : (P, P) G and (P,) c;  squares : y^T y;  freedom : f
    starts : (B + 1,) first column of each block, and P;  signs : (B,) True where the only parameter cannot be negative
    """

    gram: Array
    right: Array
    squares: float
    freedom: int
    starts: Index
    signs: NDArray[np.bool_]

    def of_blocks(self, blocks: Sequence[int]) -> Products:
        """Those of a few blocks alone."""
        chosen, columns = list(blocks), self.columns_of(blocks)
        starts = np.concatenate([[0], np.cumsum(self.widths[chosen])])
        gram, right = self.gram[np.ix_(columns, columns)], self.right[columns]
        return Products(gram, right, self.squares, self.freedom, starts, self.signs[chosen])

    @cached_property
    def widths(self) -> Index:
        """(B,) columns of each block."""
        return np.diff(self.starts)

    def columns_of(self, blocks: Sequence[int]) -> Index:
        """Indices of the columns of these blocks, in their order."""
        chosen = np.array(blocks, dtype=np.int64)
        widths = self.widths[chosen]
        return np.repeat(self.starts[chosen] - np.cumsum(widths) + widths, widths) + np.arange(np.sum(widths))

    @cached_property
    def alike(self) -> list[Index]:
        """Of the blocks of each width w their columns (b, w)."""
        return [self.starts[:-1][self.widths == w][:, None] + np.arange(w) for w in np.unique(self.widths)]

    def state(self, pairs: Sequence[tuple[int, int]] = ()) -> State:
        """The set of these blocks with the numbers of their sizes."""
        return State(self, tuple(pairs))

    def added(self, state: State) -> Array:
        """(B, S) log likelihood ratio of each block added to a set, or in it, for each size."""
        values, parts = np.empty(len(self.right)), np.empty(len(self.right))
        scores, within = state.remaining
        for index, own in zip(self.alike, within, strict=True):
            values[index], vectors = np.linalg.eigh(own)
            parts[index] = (scores[index][:, None, :] @ vectors)[:, 0]
        squared, starts = np.square(SIZES)[:, None], self.starts[:-1]
        spread = 1.0 + squared * np.maximum(values, 0.0)  # (S, P)
        gains = np.add.reduceat(squared * np.square(parts) / spread, starts, axis=1)  # (S, B)
        squares = np.maximum(state.squares - gains, LEAST * self.squares + 1e-300)
        ratios = -0.5 * np.add.reduceat(np.log(spread), starts, axis=1)
        ratios -= 0.5 * self.freedom * np.log(squares / state.squares)
        if self.signs.any():
            columns = starts[self.signs]
            deviations = parts[columns] * np.sqrt(squared / spread[:, columns] * self.freedom / squares[:, self.signs])
            ratios[:, self.signs] += np.log(2.0) + log_ndtr(deviations)
        return np.asarray(ratios.T)


def mixed(states: Sequence[State], shares: Array) -> tuple[Array, Array, float]:
    """Mean (P,) and covariance (P, P) of the coefficients of all columns, zero where a block is not in the set, and the
    variance of the noise, over states with these shares."""
    means = np.zeros((len(states), len(states[0].products.right)))
    spread = np.zeros((means.shape[1],) * 2)
    for row, state, share in zip(means, states, shares, strict=True):
        if share > LEAST:  # else nothing is left of it in a sum
            row[state.columns] = state.mean
            spread[np.ix_(state.columns, state.columns)] += share * state.variance * state.covariance
    mean = shares @ means
    apart = means - mean
    variance = sum(float(share) * state.variance for state, share in zip(states, shares, strict=True))
    return mean, spread + (apart.T * shares) @ apart, variance


@dataclass(frozen=True, eq=False)
class State:
    """A set of blocks with their sizes, and k columns, those of one block after the other.

    pairs : the blocks, in any order, with the numbers of their sizes;  computed : name -> what is known already
    """

    products: Products
    pairs: Key
    computed: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.__dict__.update(self.computed)

    @cached_property
    def key(self) -> Key:
        """Its blocks, ascending, with the numbers of their sizes."""
        return tuple(sorted(self.pairs))

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of the blocks, ascending."""
        return tuple(block for block, _ in self.key)

    @cached_property
    def columns(self) -> Index:
        """(k,) of its columns among all."""
        return self.products.columns_of([block for block, _ in self.pairs])

    @cached_property
    def sizes(self) -> Array:
        """(k,) s of the columns."""
        return np.repeat(SIZES[[s for _, s in self.pairs]], self.products.widths[[b for b, _ in self.pairs]])

    @cached_property
    def factor(self) -> Array:
        """(k, k) lower Cholesky factor of G_A + D^-2, whose inverse is the coefficients' covariance for unit sigma."""
        inner = self.products.gram[np.ix_(self.columns, self.columns)]
        inner[np.diag_indices(len(inner))] += self.sizes**-2.0
        return np.asarray(lapack.dpotrf(inner.T, lower=1, clean=1, overwrite_a=1)[0]) if self.pairs else inner

    def solve(self, table: Array) -> Array:
        """(k, n) of the coefficients' covariance, for unit sigma, times a table (k, n)."""
        return np.asarray(lapack.dpotrs(self.factor, table, lower=1)[0]) if table.size else table

    @cached_property
    def covariance(self) -> Array:
        """(k, k) of its coefficients, for unit sigma."""
        half = lapack.dpotri(self.factor, lower=1)[0] if self.pairs else self.factor
        return np.asarray(half + np.tril(half, -1).T)

    @cached_property
    def mean(self) -> Array:
        """(k,) of its coefficients."""
        return self.solve(self.products.right[self.columns][:, None])[:, 0]

    @cached_property
    def squares(self) -> float:
        """R, not below rounding."""
        whole = self.products.squares
        return max(whole - float(self.mean @ self.products.right[self.columns]), LEAST * whole, 1e-300)

    @cached_property
    def remaining(self) -> Remaining:
        """What the set leaves of all columns: (P,) V's counterpart of c, and of each group of `Products.alike` the
        blocks' own parts of V."""
        rows = self.products.gram[self.columns]
        within = tuple(self.products.gram[i[:, :, None], i[:, None, :]] for i in self.products.alike)
        return self._moved((self.products.right, within), self.mean, rows, -self.solve(rows))

    def _moved(self, left: Remaining, mean: Array, one: Array, other: Array) -> Remaining:
        """`remaining` for V + one^T other, with (v, P) each, where rows `one` have coefficients (v,)."""
        pairs = zip(self.products.alike, left[1], strict=True)
        within = tuple(part + one[:, i].transpose(1, 2, 0) @ other[:, i].transpose(1, 0, 2) for i, part in pairs)
        return left[0] - mean @ one, within

    @property
    def variance(self) -> float:
        """Of the noise."""
        return self.squares / max(self.products.freedom, 1)

    @property
    def ratio(self) -> float:
        """Log likelihood ratio against nothing missing, signs left out."""
        volume = 2.0 * float(np.sum(np.log(np.diag(self.factor) * self.sizes)))
        share = self.squares / max(self.products.squares, 1e-300)
        return -0.5 * volume - 0.5 * self.products.freedom * float(np.log(share))

    @property
    def signed(self) -> float:
        """Log of the factor by which the signs that physics allows make the set likelier."""
        chosen = [block for block, _ in self.pairs]
        signs = np.repeat(self.products.signs[chosen], self.products.widths[chosen])
        spread = np.diag(self.solve(np.eye(len(signs))[:, signs])[signs])
        deviations = np.sqrt(np.maximum(spread * self.variance, 1e-300))
        return float(np.sum(np.log(2.0) + log_ndtr(self.mean[signs] / deviations)))

    def without(self, block: int | None) -> State:
        """The set without one of its blocks; None: itself."""
        if block is None:
            return self
        number = next(k for k, (b, _) in enumerate(self.pairs) if b == block)
        first = len(self.products.columns_of([b for b, _ in self.pairs[:number]]))
        out = slice(first, first + int(self.products.widths[block]))
        part = self.solve(np.eye(len(self.columns))[:, out]).T
        # by what V is larger in the block's coefficients, and how they take up a unit of each column
        inner, taken = np.linalg.inv(part[:, out]), part @ self.products.gram[self.columns]
        remaining = self._moved(self.remaining, -inner @ self.mean[out], taken, inner @ taken)
        squares = self.squares + float(self.mean[out] @ inner @ self.mean[out])
        fewer = self.pairs[:number] + self.pairs[number + 1 :]
        return State(self.products, fewer, {"squares": squares, "remaining": remaining})

    def with_block(self, pair: tuple[int, int] | None) -> State:
        """The set with a further block of the size with this number; None: itself."""
        if pair is None:
            return self
        columns = self.products.columns_of([pair[0]])
        rows, ridge = self.products.gram[columns], SIZES[pair[1]] ** -2.0 * np.eye(len(columns))
        across = rows[:, self.columns]
        taken = rows - self.solve(across.T).T @ self.products.gram[self.columns]
        inner, (scores, _) = taken[:, columns] + ridge, self.remaining
        factor = np.zeros((len(self.columns) + len(columns),) * 2, order="F")
        factor[: len(self.columns), : len(self.columns)] = self.factor
        factor[len(self.columns) :, : len(self.columns)] = solve_triangular(self.factor, across.T, lower=True).T
        factor[len(self.columns) :, len(self.columns) :] = np.linalg.cholesky(inner)
        remaining = self._moved(
            self.remaining, np.linalg.solve(inner, scores[columns]), taken, -np.linalg.solve(inner, taken)
        )
        return State(self.products, (*self.pairs, pair), {"factor": factor, "remaining": remaining})
