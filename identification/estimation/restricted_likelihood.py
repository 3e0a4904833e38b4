"""Marginal likelihood of noise and of the sizes of effects, the parameters without a prior integrated out (restricted
maximum likelihood, H. D. Patterson, R. Thompson, "Recovery of inter-block information when block sizes are unequal",
1971)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from identification.arrays import Array

GRID = 33  # values of the noise at once, on a logarithmic scale: each pass finds it 16 times as closely
FINE = 1e-4  # of its logarithm, where the likelihood is a parabola
LARGEST = 1e3  # noise in units of sigma, or of the scatter of a fit without the parameters that have a prior


@dataclass(frozen=True)
class Restricted:
    """Residuals as noise and effects of normal sizes, with the parameters without a prior integrated out.

    values : variances of orthogonal combinations of residuals that effects of deviation one make
    squares : of these combinations;  rest, count : sum of squares of the others, and their number
    """

    values: Array
    squares: Array
    rest: float
    count: int

    @classmethod
    def of(cls, target: Array, free: Array, effects: Array, spare: int | None = None) -> Restricted:
        """Of (N,) residuals, (N, f) columns without a prior and (N, e) columns times the deviation of their prior.

        spare : equations less f, where the rows stand for more than they are
        """
        spare = len(target) - free.shape[1] if spare is None else spare
        basis = np.linalg.qr(free)[0]
        target, effects = target - basis @ (basis.T @ target), effects - basis @ (basis.T @ effects)
        square, many = float(target @ target), effects.shape[0] < effects.shape[1]
        normal = effects @ effects.T if many else effects.T @ effects  # both have the same values, but for zeros
        values, vectors = np.linalg.eigh(normal)
        kept = np.flatnonzero(values > 1e-12 * max(values.max(initial=0.0), 1e-300))[-spare:]  # no rounding
        values, vectors = values[kept], vectors[:, kept]
        along = (vectors.T @ target) ** 2 if many else (vectors.T @ (effects.T @ target)) ** 2 / values
        return cls(values, along, max(square - float(along.sum()), 0.0), spare - len(values))

    def minus_log(self, noise: Array, size: Array) -> Array:
        """-2 log of the likelihood, up to a constant;  size : factors on the deviations of the effects."""
        total = size[..., None] ** 2 * self.values + noise[..., None] ** 2
        own = np.sum(np.log(total) + self.squares / total, axis=-1)
        return np.asarray(own + self.count * 2.0 * np.log(noise) + self.rest / noise**2)

    def likeliest(self, least: float, largest: float, size: Array, given: bool = False) -> Array:
        """(2, w) least -2 log of the likelihood for factors (w,) on the deviations of the effects, and the noise there,
        between two values;  given : the noise is the least."""
        low, high = (np.full(len(size), np.log(value)) for value in (least, least if given else largest))
        places = np.arange(GRID)[:, None]
        while np.max(high - low) > FINE:
            step = (high - low) / (GRID - 1)
            lowest = np.argmin(self.minus_log(np.exp(low + places * step), size), axis=0)
            low, high = low + np.maximum(lowest - 1, 0) * step, low + np.minimum(lowest + 1, GRID - 1) * step
        ends = np.stack([low, 0.5 * (low + high), high])
        first, middle, last = self.minus_log(np.exp(ends), size)
        bend = first - 2.0 * middle + last  # the vertex of a parabola: a last digit cannot turn it
        share = np.divide(first - last, bend, out=np.zeros_like(bend), where=bend > 0.0)
        vertex = ends[1] + 0.25 * (high - low) * share
        noise = np.exp(np.clip(vertex, low, high))
        return np.stack([self.minus_log(noise, size), noise])
