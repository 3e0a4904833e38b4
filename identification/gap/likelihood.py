"""Marginal likelihood of sets of blocks. It needs only the products G = Z^T Z, c = Z^T y and y^T y of their columns,
projected off the base (identification/README.md, "One posterior").

What a set A leaves of all columns is V = Z^T (I + Z_A D^2 Z_A^T)^-1 Z. If two sets differ by a few blocks, their V
differ by a term of the rank of these (M. A. Woodbury, 1950), so the result for one set serves all similar sets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack
from scipy.special import log_ndtr

from identification.arrays import Array
from identification.information import VISIBLE, significant

# of a block's contribution, in standard deviations of the noise. Prior: from what can just not be seen by itself to a
# tenth of the reach, equally spaced in log lambda
SIZES: Array = 3.0 * np.exp2(np.arange(14))
CHANGED = 96  # effort: columns by which a set differs from the one that it is computed from
# numerical: of a set that others are computed from, by what factors the variances of its coefficients are larger than
# if each was alone, in sum; rounding counts with its square, here by 1e-4 of a log likelihood
INFLATED = 1e6
LEAST = 1e-14  # of y^T y, and of a probability of 1; numerical: what rounding leaves of a sum

Index = NDArray[np.int64]
Key = tuple[tuple[int, int], ...]  # blocks with the numbers of their sizes, ascending


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
        return State(self, tuple(sorted(pairs)))

    def added(self, state: State) -> Array:
        """(B, S) log likelihood ratio of each block added to a set, for each size; one in it does nothing."""
        values, parts = np.zeros((2, len(self.right)))
        outside, (scores, within) = np.repeat(state.variances == 0.0, self.widths), state.remaining
        for index, own in zip(self.alike, within, strict=True):
            chosen = index[out := outside[index[:, 0]]]
            values[chosen], vectors = np.linalg.eigh(own[out])
            parts[chosen] = (scores[chosen][:, None, :] @ vectors)[:, 0]
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

    key : the blocks, ascending, with the numbers of their sizes
    like : a set that differs by few columns, from which this one is computed; None: it is computed by itself
    left : of blocks that are not in it, as far as others needed them, (w, P) rows of V
    """

    products: Products
    key: Key
    like: State | None = None
    left: dict[int, Array] = field(default_factory=dict)

    # numbers of the blocks, ascending; (k,) of their columns among all
    blocks = cached_property(lambda self: tuple(block for block, _ in self.key))
    columns = cached_property(lambda self: self.products.columns_of(self.blocks))

    @cached_property
    def sizes(self) -> Array:
        """(k,) s of the columns."""
        return np.repeat(SIZES[[s for _, s in self.key]], self.products.widths[[*self.blocks]])

    @cached_property
    def factor(self) -> Array:
        """(k, k) lower Cholesky factor of G_A + D^-2, whose inverse is the coefficients' covariance for unit sigma."""
        inner = self.products.gram[np.ix_(self.columns, self.columns)]
        inner[np.diag_indices(len(inner))] += self.sizes**-2.0
        return np.asarray(lapack.dpotrf(inner.T, lower=1, clean=1, overwrite_a=1)[0]) if self.key else inner

    def solve(self, table: Array) -> Array:
        """(k, n) of the coefficients' covariance, for unit sigma, times a table (k, n)."""
        return np.asarray(lapack.dpotrs(self.factor, table, lower=1)[0]) if table.size else table

    @cached_property
    def covariance(self) -> Array:
        """(k, k) of its coefficients, for unit sigma."""
        half = lapack.dpotri(self.factor, lower=1)[0] if self.key else self.factor
        return np.asarray(half + np.tril(half, -1).T)

    # (k,) of its coefficients
    mean = cached_property(lambda self: self.solve(self.products.right[self.columns][:, None])[:, 0])

    @cached_property
    def variances(self) -> Array:
        """(B,) s^2 of all blocks, 0 of those outside."""
        values = np.zeros(len(self.products.widths))
        values[[*self.blocks]] = np.square(SIZES[[size for _, size in self.key]])
        return values

    @cached_property
    def taken(self) -> Array:
        """(k, P) by how much its coefficients take up a unit of each column."""
        return self.solve(self.products.gram[self.columns])

    @cached_property
    def change(self) -> tuple[Array, Array, Array, float]:
        """From the set that it is like: S (P, q), t (q,) and v (q,), with which V changes by -S v^-1 S^T, its
        counterpart of c by -S v^-1 t, and R by -t v^-1 t; and by how much the log of the volume changes."""
        like = self if self.like is None else self.like
        differs, widths = self.variances != like.variances, self.products.widths
        place = np.flatnonzero(np.repeat(differs, widths)[like.columns])
        others, n = np.flatnonzero(differs & (like.variances == 0.0)).tolist(), len(place)
        for block in {*others} - {*like.left}:
            own = self.products.gram[self.products.columns_of([block])]
            like.left[block] = own - own[:, like.columns] @ like.taken
        # rows of V of the columns with another s^2, times their own s^2 if there was one, and their scores
        rows = np.concatenate([like.taken[place], *(like.left[block] for block in others)])
        columns = np.concatenate([like.columns[place], self.products.columns_of(others)])
        scores = np.concatenate([like.mean[place], like.remaining[0][columns[n:]]])
        old, new = (np.repeat(state.variances, widths)[columns] for state in (like, self))
        factor = np.where(old > 0.0, old, 1.0)
        inner = rows[:, columns]
        inner[:n, :n], inner[n:, :n] = -like.covariance[np.ix_(place, place)], inner[:n, n:].T
        inner += np.diag(factor * (factor / (new - old) + (old > 0.0)))
        scale = np.abs(inner).max(axis=1, initial=0.0) ** -0.5  # else small ones would lose their digits
        values, vectors = np.linalg.eigh(scale[:, None] * inner * scale)
        volume = np.sum(np.log(np.abs(values / scale**2 * (new - old) / factor**2)))
        vectors *= scale[:, None]
        return rows.T @ vectors, scores @ vectors, values, float(volume)

    @cached_property
    def remaining(self) -> tuple[Array, tuple[Array, ...]]:
        """What the set leaves of all columns: (P,) V's counterpart of c, and of each group of `Products.alike` the
        blocks' own parts of V."""
        if self.like is None:
            gram, mean, one, other = self.products.gram, self.mean, self.products.gram[self.columns].T, self.taken.T
            scores, within = self.products.right, tuple(gram[i[:, :, None], i[:, None, :]] for i in self.products.alike)
        else:
            (scores, within), (one, missed, values, _) = self.like.remaining, self.change
            other, mean = one / values, missed / values
        pairs = zip(self.products.alike, within, strict=True)
        return scores - one @ mean, tuple(part - one[i] @ other[i].transpose(0, 2, 1) for i, part in pairs)

    @cached_property
    def evidence(self) -> tuple[float, float]:
        """R, not below rounding, and log |I + D G_A D|."""
        if self.like is None:
            left = self.products.squares - float(self.mean @ self.products.right[self.columns])
            volume = 2.0 * float(np.sum(np.log(np.diag(self.factor) * self.sizes)))
        else:
            _, missed, values, more = self.change
            left = self.like.squares - float(missed @ (missed / values))
            volume = self.like.evidence[1] + more
        return max(left, LEAST * self.products.squares, 1e-300), volume

    squares = property(lambda self: self.evidence[0])
    variance = property(lambda self: self.squares / max(self.products.freedom, 1))  # of the noise

    @property
    def ratio(self) -> float:
        """Log likelihood ratio against nothing missing, signs left out."""
        share = self.squares / max(self.products.squares, 1e-300)
        return -0.5 * self.evidence[1] - 0.5 * self.products.freedom * float(np.log(share))

    @property
    def signed(self) -> float:
        """Log of the factor by which the signs that physics allows make the set likelier."""
        signs = np.repeat(self.products.signs, self.products.widths)[self.columns]
        spread = np.diag(self.solve(np.eye(len(signs))[:, signs])[signs])
        deviations = np.sqrt(np.maximum(spread * self.variance, 1e-300))
        return float(np.sum(np.log(2.0) + log_ndtr(self.mean[signs] / deviations)))

    def without(self, block: int) -> State:
        """The set without one of its blocks."""
        return State(self.products, tuple(pair for pair in self.key if pair[0] != block), self.near)

    def with_block(self, pair: tuple[int, int] | None) -> State:
        """The set with a further block of the size with this number; None: itself."""
        return self if pair is None else State(self.products, tuple(sorted((*self.key, pair))), self.near)

    @cached_property
    def near(self) -> State:
        """What sets that differ by a block are like: a copy, where this one is no longer like another, without blocks
        that are nearly the same as others in it, which would cost sets computed from it their digits."""
        if self.like is None:
            factors = np.diag(self.covariance) * np.diag(self.products.gram)[self.columns]
            if np.sum(factors) <= INFLATED:
                return self
            worst = np.repeat(self.blocks, self.products.widths[[*self.blocks]])[np.argmax(factors)]
            return self.products.state([pair for pair in self.key if pair[0] != worst]).near
        changed = self.products.widths[self.variances != self.like.variances]
        return self.like if np.sum(changed) <= CHANGED else self.products.state(self.key).near
