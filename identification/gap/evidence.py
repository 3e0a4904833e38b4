"""Marginal likelihood of sets of blocks, in the space of their columns.

After linearization and whitening, y = J g + sum_b Z_b z_b + e with flat g, e ~ N(0, sigma^2 I), p(sigma) ~ 1 / sigma,
and z_b ~ N(0, sigma^2 s_b^2 I) for each block of the set. With everything projected off J, only the products G = Z^T Z,
c = Z^T y and y^T y enter. For a set A with sizes s, D = diag(s) and f degrees of freedom of the base model,

    log p(y | A, s) = -1/2 log |I + D G_A D| - f/2 log(R / y^T y),     R = y^T y - c_A^T D (I + D G_A D)^-1 D c_A,

relative to nothing missing (A. Zellner, 1971). The columns of a block are scaled such that s_b^2 is the expected
square, in units of the noise, of what the block contributes to the rows; s_b is one of `SIZES`.

A set is changed by one block at a time, and what it leaves of all columns, V = Z^T (I + Z_A D^2 Z_A^T)^-1 Z, by a term
of that block's rank (M. A. Woodbury, 1950): Z_A is never factorized anew.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from identification.arrays import Array, eigen_of_pairs

# reasons: identification/README.md, "Constants"
SIZES: Array = 3.0 * np.exp2(np.arange(14))  # of a block's contribution, in standard deviations of the noise
DIGITS = 1e-7  # of the scores, which a set's coefficients explain but for rounding
LEAST = 1e-14  # of y^T y: what rounding leaves of a sum of squares

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class State:
    """A set of M blocks with k columns, and what it leaves of all P columns.

    blocks, sizes : numbers of the blocks in ascending order, and of their sizes in `SIZES`
    places : (k,) of its columns among all, in the order of `order`, in which the blocks were added
    mean, covariance : (k,) and (k, k) of the posterior of its coefficients, for unit sigma
    shares : (k, P) by which its coefficients take up a unit of each column
    scores : (P,) V's counterpart of c;  within : of each group of `Products.alike` the blocks' own parts of V
    squares : R;  volume : log |I + D G_A D|
    """

    order: tuple[tuple[int, int], ...]
    places: Index
    mean: Array
    covariance: Array
    shares: Array
    scores: Array
    within: tuple[Array, ...]
    squares: float
    volume: float

    @cached_property
    def key(self) -> tuple[tuple[int, int], ...]:
        """Pairs of block and size, ascending."""
        return tuple(sorted(self.order))

    @cached_property
    def blocks(self) -> tuple[int, ...]:
        """Numbers of the blocks, ascending."""
        return tuple(block for block, _ in self.key)


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the columns of B blocks, projected off the base model.

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
    def alike(self) -> list[tuple[Index, Index]]:
        """Blocks of one width: their numbers (b,) and columns (b, w)."""
        numbers = [np.flatnonzero(self.widths == width) for width in np.unique(self.widths)]
        return [(b, self.starts[b][:, None] + np.arange(self.widths[b[0]])) for b in numbers]

    @cached_property
    def nothing(self) -> State:
        """The empty set."""
        within = tuple(self.gram[index[:, :, None], index[:, None, :]] for _, index in self.alike)
        covariance, shares = np.zeros((0, 0)), np.zeros((0, len(self.right)))
        places, mean = np.zeros(0, dtype=np.int64), np.zeros(0)
        return State((), places, mean, covariance, shares, self.right, within, self.squares, 0.0)

    def state(self, pairs: Sequence[tuple[int, int]]) -> State:
        """The set of these blocks with the numbers of their sizes."""
        if not pairs:
            return self.nothing
        places = self.places([block for block, _ in pairs])
        precision = np.repeat([SIZES[size] ** -2.0 for _, size in pairs], self.widths[[block for block, _ in pairs]])
        inner = self.gram[np.ix_(places, places)] + np.diag(precision)
        covariance = np.asarray(np.linalg.inv(inner))
        shares, mean = covariance @ self.gram[places], covariance @ self.right[places]
        return State(
            tuple(pairs),
            places,
            mean,
            covariance,
            shares,
            self.right - mean @ self.gram[places],
            self._within(self.nothing, self.gram[places], shares, -1.0),
            self._rest(self.squares - float(mean @ self.right[places])),
            float(np.linalg.slogdet(inner)[1] - np.sum(np.log(precision))),
        )

    def with_block(self, state: State, block: int, size: int) -> State:
        """A set and one more block: the block inverse of a larger matrix."""
        columns = slice(*self.starts[block : block + 2])
        rows = self.gram[columns]
        width, precision = len(rows), SIZES[size] ** -2.0
        left = rows - rows[:, state.places] @ state.shares  # (w, P) rows of V
        inner = left[:, columns] + precision * np.eye(width)
        inverse = np.linalg.inv(inner)
        new, taken = inverse @ left, state.shares[:, columns]
        gain, give = inverse @ state.scores[columns], taken @ inverse
        return State(
            (*state.order, (block, size)),
            np.concatenate([state.places, np.arange(self.starts[block], self.starts[block + 1])]),
            np.concatenate([state.mean - taken @ gain, gain]),
            np.block([[state.covariance + give @ taken.T, -give], [-give.T, inverse]]),
            np.concatenate([state.shares - taken @ new, new]),
            state.scores - gain @ left,
            self._within(state, left, new, -1.0),
            self._rest(state.squares - float(gain @ state.scores[columns])),
            state.volume + float(np.linalg.slogdet(inner)[1]) - width * float(np.log(precision)),
        )

    def without(self, state: State, block: int) -> State:
        """A set less one of its blocks: the same step back."""
        which = next(k for k, (b, _) in enumerate(state.order) if b == block)
        out = np.isin(state.places, np.arange(self.starts[block], self.starts[block + 1]))
        mean, shares = state.mean[out], state.shares[out]
        inner = np.linalg.inv(state.covariance[np.ix_(out, out)])
        give = state.covariance[np.ix_(~out, out)] @ inner
        precision = SIZES[state.order[which][1]] ** -2.0
        fewer = State(
            (*state.order[:which], *state.order[which + 1 :]),
            state.places[~out],
            state.mean[~out] - give @ mean,
            state.covariance[np.ix_(~out, ~out)] - give @ state.covariance[np.ix_(out, ~out)],
            state.shares[~out] - give @ shares,
            state.scores + (inner @ mean) @ shares,
            self._within(state, shares, inner @ shares, 1.0),
            self._rest(state.squares + float(mean @ inner @ mean)),
            state.volume - float(np.linalg.slogdet(inner)[1]) + len(mean) * float(np.log(precision)),
        )
        # what two nearly equal blocks share cancels when one of them goes: made at once where too few digits are left
        right = self.right[fewer.places]
        precisions = np.repeat(
            [SIZES[size] ** -2.0 for _, size in fewer.order], self.widths[[b for b, _ in fewer.order]]
        )
        off = self.gram[np.ix_(fewer.places, fewer.places)] @ fewer.mean + precisions * fewer.mean - right
        return fewer if np.linalg.norm(off) <= DIGITS * np.linalg.norm(right) else self.state(fewer.order)

    def _within(self, state: State, one: Array, other: Array, sign: float) -> tuple[Array, ...]:
        """The blocks' own parts of V + sign one^T other, with (v, P) each."""
        changed = []
        for (_, index), part in zip(self.alike, state.within, strict=True):
            left, right = one[:, index].transpose(1, 2, 0), other[:, index].transpose(1, 0, 2)  # (b, w, v), (b, v, w)
            changed.append(part + sign * (left @ right))
        return tuple(changed)

    def _rest(self, squares: float) -> float:
        return max(squares, LEAST * self.squares, 1e-300)

    def ratio(self, state: State) -> float:
        """Log likelihood ratio of a set with sizes against nothing missing, signs left out."""
        return -0.5 * state.volume - 0.5 * self.freedom * float(np.log(state.squares / max(self.squares, 1e-300)))

    def signed(self, state: State) -> float:
        """Log of the factor by which the signs that physics allows make a set likelier."""
        signs = np.repeat(self.signs[[b for b, _ in state.order]], self.widths[[b for b, _ in state.order]])
        if not signs.any():
            return 0.0
        variance = np.diag(state.covariance)[signs] * state.squares / max(self.freedom, 1)
        return float(np.sum(np.log(2.0) + log_ndtr(state.mean[signs] / np.sqrt(np.maximum(variance, 1e-300)))))

    def added(self, state: State, barred: Collection[int] = ()) -> Array:
        """(B, S) log likelihood ratio of each block added to a set, for each of the sizes it may have, else -inf.

        barred : blocks that are not asked, beside those that are in the set
        """
        ratios = np.full((len(self.widths), len(SIZES)), -np.inf)
        asked = np.ones(len(self.widths), dtype=bool)
        asked[[*state.blocks, *barred]] = False
        for (every, every_index), parts_of_all in zip(self.alike, state.within, strict=True):
            chosen = asked[every]
            if not chosen.any():
                continue
            blocks, index, left = every[chosen], every_index[chosen], parts_of_all[chosen]
            width, scores = index.shape[1], state.scores[index]
            if width == 1:
                values, parts = left[:, 0], scores
            else:
                values, vectors = eigen_of_pairs(left) if width == 2 else np.linalg.eigh(left)
                parts = (scores[:, None, :] @ vectors)[:, 0]
            values = np.maximum(values, 0.0)
            squared = np.square(SIZES[: self.limits[blocks].max()])[:, None, None]  # (S, 1, 1)
            spread = 1.0 + squared * values
            gains = np.sum(squared * np.square(parts) / spread, axis=2)  # (S, b)
            squares = np.maximum(state.squares - gains, LEAST * self.squares + 1e-300)
            ratio = -0.5 * np.sum(np.log(spread), axis=2) - 0.5 * self.freedom * np.log(squares / state.squares)
            if width == 1 and self.signs[blocks].any():
                deviations = parts.T * np.sqrt(squared[:, :, 0] / spread[:, :, 0] * self.freedom / squares)
                ratio += np.where(self.signs[blocks], np.log(2.0) + log_ndtr(deviations), 0.0)
            ratios[blocks, : len(squared)] = ratio.T
        return np.where(np.arange(len(SIZES)) < self.limits[:, None], ratios, -np.inf)
