"""Marginal likelihood of sets of blocks, in the space of their columns.

After linearization and whitening, y = J g + sum_b Z_b z_b + e with flat g, e ~ N(0, sigma^2 I), p(sigma) ~ 1 / sigma,
and z_b ~ N(0, sigma^2 s_b^2 I) for each block of the set. With everything projected off J, only the products G = Z^T Z,
c = Z^T y and y^T y enter. For a set A with sizes s, D = diag(s) and f degrees of freedom of the base model,

    log p(y | A, s) = -1/2 log |I + D G_A D| - f/2 log(R / y^T y),     R = y^T y - c_A^T D (I + D G_A D)^-1 D c_A,

relative to nothing missing (A. Zellner, 1971). The columns of a block are scaled such that s_b^2 is the expected
square, in units of the noise, of what the block contributes to the rows. s_b has equal probability at each of `SIZES`;
of several blocks each is averaged with the others at their likeliest sizes, and the averages relative to the
likelihood there are multiplied: they would be independent if it were not for sigma and what the blocks have in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr, logsumexp

from identification.arrays import Array, eigen_of_pairs

# reasons: identification/README.md, "Constants"
SIZES: Array = 3.0 * np.exp2(np.arange(14))  # of a block's contribution, in standard deviations of the noise
ROUNDING = 1e-9  # of a log likelihood
LEAST = 1e-14  # of y^T y: what rounding leaves of a sum of squares

Index = NDArray[np.int64]


class Left(NamedTuple):
    """What a set of blocks with sizes leaves: (k, P) rows W with W^T W the explained part of G, (k,) their scores, and
    R, the squares that are left."""

    rows: Array
    scores: Array
    squares: float


class Likeliest(NamedTuple):
    """A set of M blocks at its likeliest sizes, given by their numbers in `SIZES`.

    ratio : log likelihood ratio against nothing missing, averaged over sizes;  fewer : (M,) its change without each
    block
    """

    sizes: tuple[int, ...]
    ratio: float
    fewer: Array


@dataclass(frozen=True, eq=False)
class Products:
    """Products of the columns of B blocks, projected off the base model; of G only the rows that are used.

    columns : (N, P) Z;  target : (N,) y;  freedom : f
    starts : (B + 1,) first column of each block, and P;  signs : (B,) 1 where the only parameter cannot be negative
    limits : (B,) how many of `SIZES` a block may have
    """

    columns: Array
    target: Array
    freedom: int
    starts: Index
    signs: NDArray[np.bool_]
    limits: Index
    _rows: dict[int, Array] = field(default_factory=dict)

    @cached_property
    def right(self) -> Array:
        """(P,) c = Z^T y."""
        return self.target @ self.columns

    @cached_property
    def squares(self) -> float:
        """y^T y."""
        return float(self.target @ self.target)

    @cached_property
    def widths(self) -> Index:
        """(B,) columns of each block."""
        return np.diff(self.starts)

    def places(self, blocks: Sequence[int]) -> Index:
        """Indices of the columns of these blocks, in their order."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(*self.starts[b : b + 2]) for b in blocks)])

    def rows(self, blocks: Sequence[int]) -> Array:
        """(k, P) rows of G of these blocks."""
        new = [b for b in blocks if b not in self._rows]
        if new:  # of several at a time, as reading the columns takes longest
            rows = self.columns[:, self.places(new)].T @ self.columns
            self._rows.update(zip(new, np.split(rows, np.cumsum(self.widths[new])[:-1]), strict=True))
        return np.concatenate([np.zeros((0, len(self.right))), *(self._rows[b] for b in blocks)])

    @cached_property
    def _alike(self) -> list[tuple[Index, Index, Array]]:
        """Blocks of one width: their numbers (b,), columns (b, w) and products (b, w, w)."""
        alike = []
        for width in np.unique(self.widths).tolist():
            blocks = np.flatnonzero(self.widths == width)
            index = self.starts[blocks][:, None] + np.arange(width)
            each = self.columns[:, index].transpose(1, 0, 2)  # (b, N, w)
            alike.append((blocks, index, each.transpose(0, 2, 1) @ each))
        return alike

    def _scaled(self, blocks: Sequence[int], sizes: Array) -> tuple[Index, Array, Array]:
        """Places and scales (k,) of the columns of a set, and (k, k) I + D G D."""
        places = self.places(blocks)
        scales = np.repeat(np.asarray(sizes, dtype=float), self.widths[list(blocks)])
        inner = scales[:, None] * self.rows(blocks)[:, places] * scales
        inner[np.diag_indices_from(inner)] += 1.0
        return places, scales, inner

    def left(self, blocks: Sequence[int], sizes: Array) -> Left:
        """What a set of blocks with these sizes leaves."""
        if not len(blocks):
            return Left(np.zeros((0, len(self.right))), np.zeros(0), self.squares)
        places, scales, inner = self._scaled(blocks, sizes)
        lower = np.linalg.cholesky(inner)
        stacked = np.column_stack([self.rows(blocks), self.right[places]]) * scales[:, None]
        solved = solve_triangular(lower, stacked, lower=True, check_finite=False)
        return Left(solved[:, :-1], solved[:, -1], self._rest(float(np.sum(np.square(solved[:, -1])))))

    def _rest(self, explained: float) -> float:
        return max(self.squares - explained, LEAST * self.squares, 1e-300)

    def of(self, blocks: Sequence[int]) -> Products:
        """Those of a few blocks alone."""
        kept = list(blocks)
        starts = np.concatenate([[0], np.cumsum(self.widths[kept])])
        columns = self.columns[:, self.places(blocks)]
        return Products(columns, self.target, self.freedom, starts, self.signs[kept], self.limits[kept])

    def added(self, left: Left) -> Array:
        """(B, S) log likelihood ratio of each block added to a set, for each of the sizes it may have, else -inf."""
        ratios = np.full((len(self.widths), len(SIZES)), -np.inf)
        for blocks, index, own in self._alike:
            width = index.shape[1]
            rows = left.rows[:, index].transpose(1, 0, 2)  # (b, k, w)
            scores = self.right[index] - np.einsum("k,bkw->bw", left.scores, rows)
            rest = own - rows.transpose(0, 2, 1) @ rows
            if width == 1:
                values, parts = rest[:, 0], scores
            else:
                values, vectors = eigen_of_pairs(rest) if width == 2 else np.linalg.eigh(rest)
                parts = (scores[:, None, :] @ vectors)[:, 0]
            values = np.maximum(values, 0.0)
            squared = np.square(SIZES[: self.limits[blocks].max()])[:, None, None]  # (S, 1, 1)
            spread = 1.0 + squared * values
            gains = np.sum(squared * np.square(parts) / spread, axis=2)  # (S, b)
            squares = np.maximum(left.squares - gains, LEAST * self.squares + 1e-300)
            ratio = -0.5 * np.sum(np.log(spread), axis=2) - 0.5 * self.freedom * np.log(squares / left.squares)
            if width == 1 and self.signs[blocks].any():
                deviations = parts.T * np.sqrt(squared[:, :, 0] / spread[:, :, 0] * self.freedom / squares)
                ratio += np.where(self.signs[blocks], np.log(2.0) + log_ndtr(deviations), 0.0)
            ratios[blocks, : len(squared)] = ratio.T
        return np.where(np.arange(len(SIZES)) < self.limits[:, None], ratios, -np.inf)

    def likeliest(self, blocks: Sequence[int], sizes: Sequence[int]) -> Likeliest:
        """A set of blocks at its likeliest sizes;  sizes : numbers of `SIZES` to start from.

        With C the posterior covariance of the coefficients for unit sigma, v and m the eigenvalues of a block's part
        of C and its means along the eigenvectors, another size changes the precision by h = s'^-2 - s^-2, the log
        determinant by sum log(1 + h v), and R by sum h m^2 / (1 + h v) (Woodbury's identity); without the block h is
        infinite.
        """
        if not len(blocks):
            return Likeliest((), 0.0, np.zeros(0))
        gram, right = self.rows(blocks)[:, self.places(blocks)], self.right[self.places(blocks)]
        widths, limits = self.widths[list(blocks)], self.limits[list(blocks)]
        owner, ends = np.repeat(np.arange(len(blocks)), widths), np.concatenate([[0], np.cumsum(widths)])
        at = np.minimum(np.array(sizes, dtype=np.int64), limits - 1)
        allowed = np.arange(len(SIZES)) < limits[:, None]
        seen: set[tuple[int, ...]] = set()
        while True:
            precision = SIZES[at] ** -2.0
            covariance = np.linalg.inv(gram + np.diag(precision[owner]))
            mean = covariance @ right
            left = self._rest(float(mean @ right))
            volume = -np.linalg.slogdet(covariance)[1] - np.sum(np.log(precision[owner]))
            values, parts = np.zeros((2, len(at), int(widths.max())))
            for width in np.unique(widths).tolist():
                same = np.flatnonzero(widths == width)
                index = ends[same][:, None] + np.arange(width)
                part = covariance[index[:, :, None], index[:, None, :]]
                value, vectors = eigen_of_pairs(np.asarray(part)) if width == 2 else np.linalg.eigh(part)
                values[same, :width] = np.maximum(value, 1e-300)
                parts[same, :width] = np.square((mean[index][:, None, :] @ vectors)[:, 0])
            change = (SIZES**-2.0 - precision[:, None])[:, :, None]  # (M, S, 1)
            spread = np.maximum(1.0 + change * values[:, None], 1e-300)
            scaled = widths[:, None] * np.log(precision[:, None] * np.square(SIZES))
            volumes = volume + np.sum(np.log(spread), axis=2) + scaled
            rest = np.maximum(left + np.sum(change / spread * parts[:, None], axis=2), LEAST * self.squares + 1e-300)
            profiles = -0.5 * volumes - 0.5 * self.freedom * np.log(rest / self.squares)
            profiles[~allowed] = -np.inf
            there = values > 0.0
            shrunk = np.sum(np.log(np.where(there, values * precision[:, None], 1.0)), axis=1)
            bare = left + np.sum(parts / np.where(there, values, 1.0), axis=1)
            without = -0.5 * (volume + shrunk) - 0.5 * self.freedom * np.log(bare / self.squares)
            best, now = np.unravel_index(np.argmax(profiles), profiles.shape), profiles[0, at[0]]
            if not profiles[best] > now + ROUNDING or (tried := tuple(at.tolist())) in seen:
                break  # a rise that rounding made up, where a set explains all but the last digits, returns
            seen.add(tried)
            at[best[0]] = best[1]
        around = logsumexp(profiles, axis=1) - now - np.log(limits)  # (M,) of each block, the others as they are
        ratio = float(now + np.sum(around)) + self._signed(blocks, at.tolist())
        return Likeliest(tuple(at.tolist()), ratio, without - now - around)

    def _signed(self, blocks: Sequence[int], at: Sequence[int]) -> float:
        """Log of the factor by which signs that physics allows make the set likelier."""
        if not self.signs[list(blocks)].any():
            return 0.0
        mean, covariance = self.estimates(blocks, SIZES[list(at)])
        signed = np.repeat(self.signs[list(blocks)], self.widths[list(blocks)])
        deviations = mean[signed] / np.sqrt(np.maximum(np.diag(covariance)[signed], 1e-300))
        return float(np.sum(np.log(2.0) + log_ndtr(deviations)))

    def ratio(self, blocks: Sequence[int], sizes: Array) -> float:
        """Log likelihood ratio of a set with sizes against nothing missing, signs left out."""
        places, scales, inner = self._scaled(blocks, sizes)
        scores = scales * self.right[places]
        rest = self._rest(float(scores @ np.linalg.solve(inner, scores)))
        return float(-0.5 * np.linalg.slogdet(inner)[1] - 0.5 * self.freedom * np.log(rest / max(self.squares, 1e-300)))

    def estimates(self, blocks: Sequence[int], sizes: Array) -> tuple[Array, Array]:
        """(k,) posterior mean and (k, k) covariance of the coefficients of a set's columns."""
        places, scales, inner = self._scaled(blocks, sizes)
        inverse = scales[:, None] * np.linalg.inv(inner) * scales
        mean = inverse @ self.right[places]
        return mean, inverse * (self._rest(float(mean @ self.right[places])) / max(self.freedom, 1))
