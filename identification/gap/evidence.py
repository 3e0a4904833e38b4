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
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr, logsumexp

from identification.arrays import Array, eigen_of_pairs

# reasons: identification/README.md, "Constants"
SIZES: Array = 3.0 * np.exp2(np.arange(14))  # of a block's contribution, in standard deviations of the noise
WIDE = 6  # effort: columns of a block that is not tried in every exchange
ROUNDING = 1e-9  # of a log likelihood
LEAST = 1e-14  # of y^T y: what rounding leaves of a sum of squares

Index = NDArray[np.int64]


class Explained(NamedTuple):
    """What a set of blocks with sizes leaves: (k, P) rows W with W^T W the explained part of G, and (k,) their scores.

    left : R
    """

    rows: Array
    scores: Array
    left: float


class Added(NamedTuple):
    """Each of B blocks beside a set: (B, S) log likelihood ratio against the set, for each of the sizes."""

    blocks: Index
    ratios: Array

    @property
    def averaged(self) -> Array:
        """(B,) averaged over sizes."""
        return np.asarray(logsumexp(self.ratios, axis=1) - np.log(self.ratios.shape[1]))


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
    """Products of the columns of B blocks, projected off the base model.

    gram : (P, P) G;  right : (P,) c;  squares : y^T y;  freedom : f
    starts : (B + 1,) first column of each block, and P;  signs : (B,) 1 where the only parameter cannot be negative
    """

    gram: Array
    right: Array
    squares: float
    freedom: int
    starts: Index
    signs: NDArray[np.bool_]

    def columns(self, blocks: Sequence[int]) -> Index:
        """Indices of the columns of these blocks, in their order."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *(np.arange(*self.starts[b : b + 2]) for b in blocks)])

    @cached_property
    def widths(self) -> Index:
        """(B,) columns of each block."""
        return np.diff(self.starts)

    @cached_property
    def _alike(self) -> list[tuple[Index, Index, Array]]:
        """Blocks of one width: their numbers (b,), columns (b, w) and products (b, w, w)."""
        found = []
        for width in np.unique(self.widths).tolist():
            blocks = np.flatnonzero(self.widths == width)
            index = self.starts[blocks][:, None] + np.arange(width)
            found.append((blocks, index, self.gram[index[:, :, None], index[:, None, :]]))
        return found

    def given(self, blocks: Sequence[int], sizes: Sequence[float]) -> Explained:
        """What a set of blocks with these sizes leaves."""
        own = self.columns(blocks)
        if not len(own):
            return Explained(np.zeros((0, len(self.right))), np.zeros(0), self.squares)
        scales = np.repeat(np.asarray(sizes, dtype=float), self.widths[list(blocks)])
        inner = scales[:, None] * self.gram[np.ix_(own, own)] * scales
        inner[np.diag_indices_from(inner)] += 1.0
        lower = np.linalg.cholesky(inner)
        stacked = np.column_stack([self.gram[own], self.right[own]]) * scales[:, None]
        solved = solve_triangular(lower, stacked, lower=True, check_finite=False)
        scores = solved[:, -1]
        left = max(self.squares - float(scores @ scores), LEAST * self.squares, 1e-300)
        return Explained(solved[:, :-1], scores, left)

    def of(self, blocks: Sequence[int]) -> Products:
        """Those of a few blocks alone."""
        own, widths = self.columns(blocks), self.widths[list(blocks)]
        starts = np.concatenate([[0], np.cumsum(widths)])
        kept = self.gram[np.ix_(own, own)], self.right[own], self.squares, self.freedom
        return Products(*kept, starts, self.signs[list(blocks)])

    def added(self, given: Explained, wide: bool = True) -> Added:
        """Each block added to a set;  wide : False leaves out those of more than `WIDE` columns, which take long"""
        numbers, ratios = [], []
        for blocks, index, own in self._alike:
            if not wide and index.shape[1] > WIDE:
                numbers.append(blocks)
                ratios.append(np.full((len(blocks), len(SIZES)), -np.inf))
                continue
            width = index.shape[1]
            rows = given.rows[:, index]  # (k, b, w)
            scores = self.right[index] - np.tensordot(given.scores, rows, (0, 0))
            left = own - np.einsum("kbi,kbj->bij", rows, rows, optimize=True) if len(rows) else own
            if width == 1:
                values, parts = left[:, 0], scores
            else:
                values, vectors = eigen_of_pairs(left) if width == 2 else np.linalg.eigh(left)
                parts = np.einsum("bwe,bw->be", vectors, scores)
            values = np.maximum(values, 0.0)
            squared = np.square(SIZES)[:, None, None]  # (S, 1, 1)
            spread = 1.0 + squared * values
            gains = np.sum(squared * np.square(parts) / spread, axis=2)  # (S, b)
            rest = np.maximum(given.left - gains, LEAST * self.squares + 1e-300)
            ratio = -0.5 * np.sum(np.log(spread), axis=2) - 0.5 * self.freedom * np.log(rest / given.left)
            if width == 1 and self.signs[blocks].any():
                deviations = parts.T * np.sqrt(squared[:, :, 0] / spread[:, :, 0] * self.freedom / rest)
                ratio += np.where(self.signs[blocks], np.log(2.0) + log_ndtr(deviations), 0.0)
            numbers.append(blocks)
            ratios.append(ratio.T)
        blocks, order = np.concatenate(numbers), np.argsort(np.concatenate(numbers))
        return Added(blocks[order], np.concatenate(ratios)[order])

    def likeliest(self, blocks: Sequence[int], sizes: Sequence[int]) -> Likeliest:
        """A set of blocks at its likeliest sizes;  sizes : numbers of `SIZES` to start from.

        With C the posterior covariance of the coefficients for unit sigma, v and m the eigenvalues of a block's part
        of C and its means along the eigenvectors, another size changes the precision by h = s'^-2 - s^-2, the log
        determinant by sum log(1 + h v), and R by sum h m^2 / (1 + h v) (Woodbury's identity); without the block h is
        infinite.
        """
        own, at = self.of(blocks), np.array(sizes, dtype=np.int64)
        owner = np.repeat(np.arange(len(at)), own.widths)
        if not len(at):
            return Likeliest((), 0.0, np.zeros(0))
        seen: set[tuple[int, ...]] = set()
        while True:
            precision = SIZES[at] ** -2.0
            covariance = np.linalg.inv(own.gram + np.diag(precision[owner]))
            mean = covariance @ own.right
            left = max(own.squares - float(mean @ own.right), LEAST * own.squares, 1e-300)
            volume = -np.linalg.slogdet(covariance)[1] - np.sum(np.log(precision[owner]))
            values, parts = np.zeros((2, len(at), int(own.widths.max())))
            for blocks_alike, index, _ in own._alike:
                width = index.shape[1]
                part = covariance[index[:, :, None], index[:, None, :]]
                value, vectors = eigen_of_pairs(np.asarray(part)) if width == 2 else np.linalg.eigh(part)
                values[blocks_alike, :width] = np.maximum(value, 1e-300)
                parts[blocks_alike, :width] = np.square(np.einsum("bwe,bw->be", vectors, mean[index]))
            change = (SIZES**-2.0 - precision[:, None])[:, :, None]  # (M, S, 1)
            spread = np.maximum(1.0 + change * values[:, None], 1e-300)
            scaled = own.widths[:, None] * np.log(precision[:, None] * np.square(SIZES))
            volumes = volume + np.sum(np.log(spread), axis=2) + scaled
            rest = np.maximum(left + np.sum(change / spread * parts[:, None], axis=2), LEAST * own.squares + 1e-300)
            profiles = -0.5 * volumes - 0.5 * own.freedom * np.log(rest / own.squares)
            there = values > 0.0
            shrunk = np.sum(np.log(np.where(there, values * precision[:, None], 1.0)), axis=1)
            bare = left + np.sum(parts / np.where(there, values, 1.0), axis=1)
            without = -0.5 * (volume + shrunk) - 0.5 * own.freedom * np.log(bare / own.squares)
            best, now = np.unravel_index(np.argmax(profiles), profiles.shape), profiles[0, at[0]]
            if not profiles[best] > now + ROUNDING or (tried := tuple(at.tolist())) in seen:
                break  # a rise that rounding made up, where a set explains all but the last digits, returns
            seen.add(tried)
            at[best[0]] = best[1]
        around = float(np.sum(logsumexp(profiles, axis=1) - now - np.log(len(SIZES))))
        return Likeliest(
            tuple(at.tolist()), float(now) + around + self._signed(blocks, at.tolist()), without - now - around
        )

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
        own = self.columns(blocks)
        scales = np.repeat(np.asarray(sizes, dtype=float), self.widths[list(blocks)])
        inner = scales[:, None] * self.gram[np.ix_(own, own)] * scales
        inner[np.diag_indices_from(inner)] += 1.0
        scores = scales * self.right[own]
        left = max(self.squares - float(scores @ np.linalg.solve(inner, scores)), LEAST * self.squares, 1e-300)
        return float(-0.5 * np.linalg.slogdet(inner)[1] - 0.5 * self.freedom * np.log(left / max(self.squares, 1e-300)))

    def estimates(self, blocks: Sequence[int], sizes: Array) -> tuple[Array, Array]:
        """(k,) posterior mean and (k, k) covariance of the coefficients of a set's columns."""
        own = self.columns(blocks)
        scales = np.repeat(np.asarray(sizes, dtype=float), self.widths[list(blocks)])
        inner = scales[:, None] * self.gram[np.ix_(own, own)] * scales
        inner[np.diag_indices_from(inner)] += 1.0
        inverse = scales[:, None] * np.linalg.inv(inner) * scales
        mean = inverse @ self.right[own]
        left = max(self.squares - float(mean @ self.right[own]), LEAST * self.squares, 1e-300)
        return mean, inverse * (left / max(self.freedom, 1))
