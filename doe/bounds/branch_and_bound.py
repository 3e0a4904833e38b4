"""The largest value of a trigonometric polynomial over a box of joint angles, as a theorem: branch and bound.

Two upper bounds hold on every box with centre c and half widths r, and the lower of them is used:

    termwise   c_0 + sum_t |c_t| max cos(phase_t)
               exact for a sum of waves of separate joints, which is what the sensitivity of the base model is at its
               optimum (H^-1 is tridiagonal there)
    Taylor     v(x) + max_(q in box) v'(x)(q - x) + lambda/2 max |q - x|^2
               for x near the box's maximum; lambda >= 0 bounds the largest eigenvalue of the Hessian over the box

Where a derivative cannot change its sign the box shrinks to its face. Rounding is covered by a margin: the standard
bound on the error of sums of products (number of operations times 2.2e-16 times the sum of magnitudes), where the
magnitudes are those before anything cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from doe.bounds.trigonometric import TrigonometricPolynomial
from doe.problem.problem import Stop, never
from identification.arrays import Array

BATCH = 2048  # boxes examined together
UNIT = float(np.finfo(float).eps)


@dataclass(frozen=True)
class Maximum:
    """max v over the box lies in [value, upper]; `value` is attained at `posture` (n,).

    proven : True if `upper` is within the tolerance asked for; else `upper` still holds but is loose
    boxes : how many were examined
    """

    value: float
    posture: Array
    upper: float
    proven: bool
    boxes: int


def maximum(
    polynomial: TrigonometricPolynomial,
    lower: Array,
    upper: Array,
    *,
    known: Array,
    tolerance: float = 1e-10,
    most_boxes: int = 100_000,
    stop: Stop = never,
) -> Maximum:
    """The largest value over lower <= q <= upper, to `tolerance` (absolute).

    known : (k, n) good postures within the box, which save most of the work;  stop : asked between batches of boxes
    """
    waves = Waves.of(polynomial)
    values = waves.value(known)
    best, posture = float(values.max()), known[int(values.argmax())]
    center, half = (0.5 * (lower + upper))[None], (0.5 * (upper - lower))[None]
    promise = np.full(1, np.inf)  # upper bound of every box that waits
    boxes, discarded_bound = 0, -np.inf
    while len(center) and boxes < most_boxes and not stop():
        order = np.argsort(-promise)
        now, later = order[:BATCH], order[BATCH:]
        boxes += len(now)
        shrunk = waves.shrink(center[now], half[now])
        point, bound = waves.bound(*shrunk)
        bound = np.minimum(bound, promise[now])
        reached = waves.value(point)
        if reached.max() > best:
            best, posture = float(reached.max()), point[int(reached.argmax())]
        left = bound > best + tolerance
        discarded_bound = max(discarded_bound, float(bound[~left].max(initial=-np.inf)))
        halves = waves.split(shrunk[0][left], shrunk[1][left])
        center, half = np.concatenate([center[later], halves[0]]), np.concatenate([half[later], halves[1]])
        promise = np.concatenate([promise[later], bound[left], bound[left]])
    highest = max(discarded_bound, best, float(promise.max(initial=-np.inf))) + waves.margin
    inside = np.clip(posture, lower, upper)  # the middle and half of a box are rounded
    return Maximum(best, inside, highest, not len(center), boxes)


@dataclass(frozen=True)
class Waves:
    """A trigonometric polynomial as amplitudes and phases, with its bounds over boxes (center (b, n), half (b, n))."""

    constant: float
    frequencies: Array  # (T, n)
    amplitudes: Array  # (T,)
    phases: Array  # (T,)
    margin: float  # what rounding can have cost

    @classmethod
    def of(cls, polynomial: TrigonometricPolynomial) -> Waves:
        """|c_t| and arg c_t."""
        c = polynomial.coefficients
        magnitude = polynomial.magnitude or abs(polynomial.constant) + float(np.abs(c).sum())
        margin = UNIT * (polynomial.operations + len(c) + 64) * magnitude
        return cls(polynomial.constant, polynomial.frequencies.astype(float), np.abs(c), np.angle(c), margin)

    def value(self, q: Array) -> Array:
        """(b,) values at (b, n) postures."""
        return self.constant + np.cos(q @ self.frequencies.T + self.phases) @ self.amplitudes

    def termwise(self, center: Array, half: Array) -> Array:
        """(b,) upper bound: every wave at its own largest."""
        return self.constant + self._highest(*self._phase(center, half)) @ self.amplitudes

    def _phase(self, center: Array, half: Array) -> tuple[Array, Array]:
        return center @ self.frequencies.T + self.phases, half @ np.abs(self.frequencies).T

    @staticmethod
    def _highest(phase: Array, reach: Array) -> Array:
        """max cos over [phase - reach, phase + reach]: at the distance to the nearest multiple of 2 pi."""
        distance = np.abs(np.remainder(phase + np.pi, 2.0 * np.pi) - np.pi)
        return np.cos(np.maximum(distance - reach, 0.0))

    def slopes(self, center: Array, half: Array) -> tuple[Array, Array]:
        """(b, n) lowest and highest derivative by every joint over the boxes."""
        phase, reach = self._phase(center, half)
        highest = self._highest(phase + 0.5 * np.pi, reach)  # of -sin = cos(. + pi/2)
        lowest = -self._highest(phase - 0.5 * np.pi, reach)
        rising = self.amplitudes[:, None] * np.maximum(self.frequencies, 0.0)
        falling = self.amplitudes[:, None] * np.minimum(self.frequencies, 0.0)
        return lowest @ rising + highest @ falling, highest @ rising + lowest @ falling

    def shrink(self, center: Array, half: Array) -> tuple[Array, Array]:
        """Boxes reduced to the face where the polynomial is largest, joint by joint, where it is monotone."""
        lowest, highest = self.slopes(center, half)
        slack = self.margin * np.abs(self.frequencies).max(initial=1.0)
        up, down = lowest > slack, highest < -slack
        moved = center + np.where(up, half, 0.0) - np.where(down, half, 0.0)
        return moved, np.where(up | down, 0.0, half)

    def bound(self, center: Array, half: Array) -> tuple[Array, Array]:
        """Per box a good posture (b, n) in it and an upper bound (b,) over it."""
        curvature = self.curvature(center, half)
        point = center
        for _ in range(3):
            point = self._newton(point, center, half)
        slope = self._slope(point)
        above, below = center + half - point, point - center + half
        linear = np.maximum(slope * above, -slope * below).sum(axis=1)
        farthest = np.square(np.maximum(above, below)).sum(axis=1)
        taylor = self.value(point) + linear + 0.5 * np.maximum(curvature, 0.0) * farthest
        return point, np.minimum(taylor, self.termwise(center, half))

    def _slope(self, q: Array) -> Array:
        return -np.sin(q @ self.frequencies.T + self.phases) * self.amplitudes @ self.frequencies

    def _hessian(self, cosines: Array) -> Array:
        """(b, n, n) - sum_t |c_t| f_t f_t^T cosines_t."""
        n = self.frequencies.shape[1]
        outer = np.einsum("ti,tj->tij", self.frequencies, self.frequencies).reshape(-1, n * n)
        return -((cosines * self.amplitudes) @ outer).reshape(-1, n, n)

    def curvature(self, center: Array, half: Array) -> Array:
        """(b,) upper bound of the Hessian's largest eigenvalue over the box, in the joints that the box still spans."""
        phase, reach = self._phase(center, half)
        high, low = self._highest(phase, reach), -self._highest(phase + np.pi, reach)
        spans = (half > 0.0).astype(float)
        mask = spans[:, :, None] * spans[:, None, :]
        middle = self._hessian(0.5 * (high + low)) * mask
        n = self.frequencies.shape[1]
        outer = np.einsum("ti,tj->tij", np.abs(self.frequencies), np.abs(self.frequencies)).reshape(-1, n * n)
        radius = ((0.5 * (high - low) * self.amplitudes) @ outer).reshape(-1, n, n) * mask
        largest = float(self.amplitudes @ np.square(self.frequencies).sum(axis=1))  # no eigenvalue exceeds it
        middle = middle - largest * np.eye(n) * (1.0 - spans)[:, :, None]  # joints without width never decide
        return np.linalg.eigvalsh(middle)[:, -1] + radius.sum(axis=2).max(axis=1) + 1e-14 * largest

    def _newton(self, point: Array, center: Array, half: Array) -> Array:
        """One Newton step towards the maximum, clipped to the box; joints of zero width do not move."""
        n = self.frequencies.shape[1]
        slope = self._slope(point)
        free = (half > 0.0).astype(float)
        hessian = self._hessian(np.cos(point @ self.frequencies.T + self.phases))
        hessian = hessian * free[:, :, None] * free[:, None, :] - np.eye(n) * (1.0 - free)[:, :, None]
        values, vectors = np.linalg.eigh(hessian)
        along = np.einsum("bij,bi->bj", vectors, slope * free) / np.maximum(np.abs(values), 1e-9)
        step = np.einsum("bij,bj->bi", vectors, along)
        return np.clip(point + step, center - half, center + half)

    def split(self, center: Array, half: Array) -> tuple[Array, Array]:
        """Every box bisected along the joint that its polynomial depends on most."""
        importance = half * (self.amplitudes @ np.abs(self.frequencies))
        rows, widest = np.arange(len(center)), np.argmax(importance, axis=1)
        smaller, shift = half.copy(), np.zeros_like(half)
        smaller[rows, widest] *= 0.5
        shift[rows, widest] = smaller[rows, widest]
        return np.concatenate([center - shift, center + shift]), np.concatenate([smaller, smaller])
