"""Marginal likelihood of sets of blocks, in the space of their columns.

After linearization and whitening, y = J g + sum_b Z_b z_b + e with flat g, e ~ N(0, sigma^2 I), p(sigma) ~ 1 / sigma, and
z_b ~ N(0, sigma^2 s_b^2 I) for each block of the set. With everything projected off J, only the products G = Z^T Z,
c = Z^T y and y^T y enter. For a set A with sizes s, D = diag(s) and f degrees of freedom of the base model,

    log p(y | A, s) = -1/2 log |I + D G_A D| - f/2 log(R / y^T y),     R = y^T y - c_A^T D (I + D G_A D)^-1 D c_A,

relative to nothing missing (A. Zellner, 1971). The columns of a block are scaled such that s_b^2 is the expected square, in
units of the noise, of what the block contributes to the rows. s_b has equal probability at each of `SIZES`; of several
blocks each is averaged with the others at their likeliest sizes, and the averages relative to the likelihood there are
multiplied: they would be independent if it were not for sigma and what the blocks have in common.
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
SWEEPS = 20  # effort: over the blocks of a set, for their likeliest sizes
ROUNDING = 1e-9  # of a log likelihood
LEAST = 1e-14  # of y^T y: what rounding leaves of a sum of squares

Index = NDArray[np.int64]


class Given(NamedTuple):
    """What a set of blocks with sizes leaves: (k, P) rows W with W^T W the explained part of G, and (k,) their scores.

    left : R;  volume : log |I + D G_A D|
    """

    rows: Array
    scores: Array
    left: float
    volume: float


class Added(NamedTuple):
    """Each of B blocks beside a set: (B, S) log likelihood ratio against the set, for each of the sizes."""

    blocks: Index
    ratios: Array

    @property
    def averaged(self) -> Array:
        """(B,) averaged over sizes."""
        return np.asarray(logsumexp(self.ratios, axis=1) - np.log(self.ratios.shape[1]))


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

    def given(self, blocks: Sequence[int], sizes: Sequence[float]) -> Given:
        """What a set of blocks with these sizes leaves."""
        own = self.columns(blocks)
        if not len(own):
            return Given(np.zeros((0, len(self.right))), np.zeros(0), self.squares, 0.0)
        scales = np.repeat(np.asarray(sizes, dtype=float), self.widths[list(blocks)])
        inner = scales[:, None] * self.gram[np.ix_(own, own)] * scales
        inner[np.diag_indices_from(inner)] += 1.0
        lower = np.linalg.cholesky(inner)
        stacked = np.column_stack([self.gram[own], self.right[own]]) * scales[:, None]
        solved = solve_triangular(lower, stacked, lower=True, check_finite=False)
        scores = solved[:, -1]
        left = max(self.squares - float(scores @ scores), LEAST * self.squares, 1e-300)
        return Given(solved[:, :-1], scores, left, 2.0 * float(np.sum(np.log(np.diag(lower)))))

    def ratio(self, given: Given) -> float:
        """Log likelihood ratio of a set with sizes against nothing missing, signs left out."""
        return -0.5 * given.volume - 0.5 * self.freedom * float(np.log(given.left / max(self.squares, 1e-300)))

    def of(self, blocks: Sequence[int]) -> Products:
        """Those of a few blocks alone."""
        own, widths = self.columns(blocks), self.widths[list(blocks)]
        starts = np.concatenate([[0], np.cumsum(widths)])
        kept = self.gram[np.ix_(own, own)], self.right[own], self.squares, self.freedom
        return Products(*kept, starts, self.signs[list(blocks)])

    def added(self, given: Given, some: int | None = None) -> Added:
        """Each block, or the one of this number, added to a set."""
        numbers, ratios = [], []
        for blocks, index, own in self._alike:
            if some is not None:
                at = int(np.searchsorted(blocks, some))
                if at == len(blocks) or blocks[at] != some:
                    continue
                blocks, index, own = blocks[at : at + 1], index[at : at + 1], own[at : at + 1]
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

    def likeliest(self, blocks: Sequence[int], sizes: Sequence[int]) -> tuple[tuple[int, ...], float]:
        """Likeliest sizes of the blocks of a set, as numbers of `SIZES`, and the log likelihood ratio averaged over sizes.

        sizes : to start from
        """
        at, own = list(sizes), self.of(blocks)
        every = list(range(len(at)))
        profiles = np.zeros((len(at), len(SIZES)))
        for _ in range(SWEEPS):
            before = list(at)
            for k in every:
                others = own.given([*every[:k], *every[k + 1 :]], SIZES[[*at[:k], *at[k + 1 :]]])
                profiles[k] = own.added(others, k).ratios[0]
                if profiles[k].max() > profiles[k, at[k]] + ROUNDING:
                    at[k] = int(np.argmax(profiles[k]))
            if at == before:
                break
        there = own.given(every, SIZES[at])
        best = np.array([profile[one] for profile, one in zip(profiles, at, strict=True)])
        around = np.sum(logsumexp(profiles, axis=1) - best - np.log(len(SIZES))) if at else 0.0
        return tuple(at), own.ratio(there) + float(around) + self._signed(blocks, at)

    def _signed(self, blocks: Sequence[int], at: Sequence[int]) -> float:
        """Log of the factor by which signs that physics allows make the set likelier."""
        if not self.signs[list(blocks)].any():
            return 0.0
        mean, covariance = self.estimates(blocks, SIZES[list(at)])
        signed = np.repeat(self.signs[list(blocks)], self.widths[list(blocks)])
        deviations = mean[signed] / np.sqrt(np.maximum(np.diag(covariance)[signed], 1e-300))
        return float(np.sum(np.log(2.0) + log_ndtr(deviations)))

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
