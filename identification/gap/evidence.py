"""Marginal likelihood of sets of blocks, in the space of their columns.

After linearization and whitening, y = J g + sum_b Z_b z_b + e with flat g, e ~ N(0, sigma^2 I), p(sigma) ~ 1 / sigma,
and z_b ~ N(0, sigma^2 s_b^2 I) for each block of the set. With everything projected off J, only the products G = Z^T Z,
c = Z^T y and y^T y enter. For a set A with sizes s, D = diag(s) and f degrees of freedom of the base model,

    log p(y | A, s) = -1/2 log |I + D G_A D| - f/2 log(R / y^T y),     R = y^T y - c_A^T D (I + D G_A D)^-1 D c_A,

relative to nothing missing (A. Zellner, 1971). The columns of a block are scaled such that s_b^2 is the expected
square, in units of the noise, of what the block contributes to the rows; s_b is one of `SIZES`.

What a set leaves of all columns is V = Z^T (I + Z_A D^2 Z_A^T)^-1 Z; of it the scores and the blocks' own parts are
kept. A set changes by one block at a time: with one block less, and with another in its place, V changes by a term of
that block's rank (M. A. Woodbury, 1950).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.special import log_ndtr

from identification.arrays import Array, eigen_of_pairs

# of a block's contribution, in standard deviations of the noise. Prior: from what can just not be seen by itself to a
# tenth of the reach, equally spaced in log lambda
SIZES: Array = 3.0 * np.exp2(np.arange(14))
LEAST = 1e-14  # of y^T y; numerical: what rounding leaves of a sum of squares

Index = NDArray[np.int64]
Key = tuple[tuple[int, int], ...]  # blocks with the numbers of their sizes, ascending


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the P columns of B blocks, projected off the base model.

    gram, right : (P, P) G and (P,) c;  squares : y^T y;  freedom : f
    starts : (B + 1,) first column of each block, and P;  signs : (B,) 1 where the only parameter cannot be negative
    limits : (B,) how many of `SIZES` a block may have
    """

    gram: Array
    right: Array
    squares: float
    freedom: int
    starts: Index
    signs: NDArray[np.bool_]
    limits: Index

    @classmethod
    def of(
        cls, columns: Array, target: Array, freedom: int, starts: Index, signs: NDArray[np.bool_], limits: Index
    ) -> Products:
        """Those of columns (N, P) with y (N,)."""
        gram = np.asarray(columns.T @ columns)
        return cls(gram, target @ columns, float(target @ target), freedom, starts, signs, limits)

    def of_blocks(self, blocks: Sequence[int]) -> Products:
        """Those of a few blocks alone."""
        chosen, places = list(blocks), self.places(blocks)
        starts = np.concatenate([[0], np.cumsum(self.widths[chosen])])
        gram, right = self.gram[np.ix_(places, places)], self.right[places]
        return Products(gram, right, self.squares, self.freedom, starts, self.signs[chosen], self.limits[chosen])

    @cached_property
    def widths(self) -> Index:
        """(B,) columns of each block."""
        return np.diff(self.starts)

    def places(self, blocks: Sequence[int]) -> Index:
        """Indices of the columns of these blocks, in their order."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(*self.starts[b : b + 2]) for b in blocks)])

    @cached_property
    def owners(self) -> Index:
        """(P,) number of the block that each column belongs to."""
        return np.repeat(np.arange(len(self.widths)), self.widths)

    @cached_property
    def alike(self) -> list[Index]:
        """Of the blocks of each width w their columns (b, w)."""
        widths = np.unique(self.widths)
        return [self.starts[np.flatnonzero(self.widths == w)][:, None] + np.arange(w) for w in widths]

    @cached_property
    def nothing(self) -> State:
        """The empty set."""
        return self.state(())

    def state(self, pairs: Sequence[tuple[int, int]]) -> State:
        """The set of these blocks with the numbers of their sizes."""
        return State(self, tuple(sorted(pairs)))

    def least(self, squares: float) -> float:
        """A sum of squares, not below rounding."""
        return max(squares, LEAST * self.squares, 1e-300)

    def added(self, left: Left) -> Array:
        """(B, S) log likelihood ratio of each block added to a set, for each of the sizes it may have, else -inf; of
        those that are in the set, too."""
        values, parts = np.empty(len(self.right)), np.empty(len(self.right))
        for index, own in zip(self.alike, left.within, strict=True):
            if own.shape[1] == 1:
                values[index], parts[index] = own[:, 0], left.scores[index]
            else:
                values[index], vectors = eigen_of_pairs(own) if own.shape[1] == 2 else np.linalg.eigh(own)
                parts[index] = (left.scores[index][:, None, :] @ vectors)[:, 0]
        squared, starts = np.square(SIZES)[:, None], self.starts[:-1]
        spread = 1.0 + squared * np.maximum(values, 0.0)  # (S, P)
        gains = np.add.reduceat(squared * np.square(parts) / spread, starts, axis=1)  # (S, B)
        squares = np.maximum(left.squares - gains, LEAST * self.squares + 1e-300)
        ratios = -0.5 * np.add.reduceat(np.log(spread), starts, axis=1)
        ratios -= 0.5 * self.freedom * np.log(squares / left.squares)
        if self.signs.any():
            places = starts[self.signs]
            deviations = parts[places] * np.sqrt(squared / spread[:, places] * self.freedom / squares[:, self.signs])
            ratios[:, self.signs] += np.log(2.0) + log_ndtr(deviations)
        return np.where(np.arange(len(SIZES)) < self.limits[:, None], ratios.T, -np.inf)

    def changed(self, within: tuple[Array, ...], one: Array, other: Array) -> tuple[Array, ...]:
        """The blocks' own parts of V + one^T other, with (v, P) each, from those of V."""
        pairs = zip(self.alike, within, strict=True)
        return tuple(own + one[:, i].transpose(1, 2, 0) @ other[:, i].transpose(1, 0, 2) for i, own in pairs)


@dataclass(frozen=True, eq=False)
class State:
    """A set of blocks with their sizes, and k columns;  given : `within`, where it is known."""

    products: Products
    key: Key
    given: tuple[Array, ...] | None = None

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of the blocks, ascending."""
        return tuple(block for block, _ in self.key)

    @cached_property
    def places(self) -> Index:
        """(k,) of its columns among all, ascending."""
        inside = np.zeros(len(self.products.widths), dtype=bool)
        inside[[*self.blocks]] = True
        return np.flatnonzero(inside[self.products.owners])

    @cached_property
    def sizes(self) -> Array:
        """(k,) s of the columns."""
        return np.repeat(SIZES[[size for _, size in self.key]], self.products.widths[[*self.blocks]])

    @cached_property
    def rows(self) -> Array:
        """(k, P) of G."""
        return self.products.gram[self.places]

    @cached_property
    def _factor(self) -> Array:
        """(k, k) lower triangular root of G_A + D^-2."""
        inner = self.rows[:, self.places]
        inner[np.diag_indices(len(inner))] += self.sizes**-2.0
        return np.asarray(lapack.dpotrf(inner.T, lower=1, clean=1, overwrite_a=1)[0]) if self.key else inner

    def solve(self, table: Array) -> Array:
        """(k, n) the coefficients' covariance, for unit sigma, times a table (k, n)."""
        return np.asarray(lapack.dpotrs(self._factor, table, lower=1)[0]) if table.size else table

    @cached_property
    def covariance(self) -> Array:
        """(k, k) of its coefficients, for unit sigma."""
        half = lapack.dpotri(self._factor, lower=1)[0] if self.key else self._factor
        return np.asarray(half + np.tril(half, -1).T)

    @cached_property
    def mean(self) -> Array:
        """(k,) of its coefficients."""
        return self.solve(self.products.right[self.places][:, None])[:, 0]

    @cached_property
    def squares(self) -> float:
        """R"""
        return self.products.least(self.products.squares - float(self.mean @ self.products.right[self.places]))

    @property
    def ratio(self) -> float:
        """Log likelihood ratio against nothing missing, signs left out."""
        volume = 2.0 * float(np.sum(np.log(np.diag(self._factor) * self.sizes)))
        share = self.squares / self.products.least(self.products.squares)
        return -0.5 * volume - 0.5 * self.products.freedom * float(np.log(share))

    @property
    def signed(self) -> float:
        """Log of the factor by which the signs that physics allows make the set likelier."""
        signs = np.repeat(self.products.signs[[*self.blocks]], self.products.widths[[*self.blocks]])
        if not signs.any():
            return 0.0
        variance = (
            np.diag(self.solve(np.eye(len(signs))[:, signs])[signs]) * self.squares / max(self.products.freedom, 1)
        )
        return float(np.sum(np.log(2.0) + log_ndtr(self.mean[signs] / np.sqrt(np.maximum(variance, 1e-300)))))

    @cached_property
    def within(self) -> tuple[Array, ...]:
        """Of each group of `Products.alike` the blocks' own parts of V."""
        if self.given is not None:
            return self.given
        own = tuple(self.products.gram[i[:, :, None], i[:, None, :]] for i in self.products.alike)
        return self.products.changed(own, self.rows, -self.solve(self.rows))

    def without(self, block: int | None = None) -> Left:
        """What it leaves with one of its blocks less, None: with all of them."""
        return Left(self, block)


@dataclass(frozen=True, eq=False)
class Left:
    """What a set, less one of its blocks with w columns (or none, w = 0), leaves of y and of all columns."""

    whole: State
    block: int | None

    @cached_property
    def key(self) -> Key:
        """Of the set without the block."""
        return tuple(pair for pair in self.whole.key if pair[0] != self.block)

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of the blocks, ascending."""
        return tuple(block for block, _ in self.key)

    @cached_property
    def _out(self) -> NDArray[np.bool_]:
        """(k,) the block's columns in the set."""
        owners = self.whole.products.owners[self.whole.places]
        return owners == (-1 if self.block is None else self.block)

    @cached_property
    def _covariance(self) -> Array:
        """(w, k) of the block's coefficients with those of the set."""
        return self.whole.solve(np.eye(len(self._out))[:, self._out]).T

    @cached_property
    def _taken(self) -> Array:
        """(w, P) by which the block's coefficients take up a unit of each column."""
        return np.asarray(self._covariance @ self.whole.rows)

    @cached_property
    def _inner(self) -> Array:
        """(w, w) by which V is larger, in these."""
        return np.asarray(np.linalg.inv(self._covariance[:, self._out]))

    @cached_property
    def squares(self) -> float:
        """R"""
        mean = self.whole.mean[self._out]
        return self.whole.products.least(self.whole.squares + float(mean @ self._inner @ mean))

    @cached_property
    def scores(self) -> Array:
        """(P,) V's counterpart of c."""
        whole = self.whole
        scores = whole.products.right - whole.mean @ whole.rows
        return np.asarray(scores + (self._inner @ whole.mean[self._out]) @ self._taken)

    @cached_property
    def within(self) -> tuple[Array, ...]:
        """Of each group of `Products.alike` the blocks' own parts of V."""
        if self.block is None:
            return self.whole.within
        return self.whole.products.changed(self.whole.within, self._taken, self._inner @ self._taken)

    def put(self, block: int, size: int) -> State:
        """The set with a block in this one's place."""
        products, whole = self.whole.products, self.whole
        own = slice(*products.starts[block : block + 2])
        rows = products.gram[own] - whole.solve(whole.rows[:, own]).T @ whole.rows  # (w, P) of V
        rows += (self._taken[:, own].T @ self._inner) @ self._taken
        inner = rows[:, own] + SIZES[size] ** -2.0 * np.eye(len(rows))
        given = products.changed(self.within, rows, -np.linalg.solve(inner, rows))
        return State(products, tuple(sorted((*self.key, (block, size)))), given)

    @property
    def rest(self) -> State:
        """The set without the block."""
        return State(self.whole.products, self.key, self.within)
