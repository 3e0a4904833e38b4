"""The largest value of a trigonometric polynomial over a box of joint angles, as a theorem (doe/README.md, "Branch and
bound"): on every box with centre c and half widths r the lower of two upper bounds is used,

    termwise   c_0 + sum_t |c_t| max cos(phase_t)
    Taylor     v(x) + max_(q in box) v'(x)(q - x) + lambda/2 max |q - x|^2
               for x near the box's maximum; lambda >= 0 bounds the largest eigenvalue of the Hessian over the box

Rounding is covered by a margin: the standard bound on the error of sums of products (number of operations times 2.2e-16
times the sum of magnitudes), where the magnitudes are those before anything cancels. Whether a sensitivity is such a
polynomial is read off the model's CasADi instructions: the walk over them is the proof.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from doe.problem.problem import DesignProblem, Stop, never
from identification import Array


class Maximum(NamedTuple):
    """max v over the box lies in [value, upper]; `value` is attained at `posture` (n,).

    proven : True if `upper` is within the tolerance asked for; else `upper` still holds but is loose
    boxes : how many were examined
    """

    value: float
    posture: Array
    upper: float
    proven: bool
    boxes: int


@dataclass(frozen=True)
class TrigonometricPolynomial:
    """constant + sum_t Re(coefficients_t exp(i frequencies_t . q)); frequencies (T, n) whole, coefficients (T,).

    Its bounds are over boxes, center (b, n) and half (b, n).

    magnitude, operations : sum of magnitudes that went into the coefficients before anything cancelled, and the number
        of operations in a row, for a bound on the rounding error; 0: the coefficients are exact
    """

    constant: float
    frequencies: NDArray[np.int64]
    coefficients: NDArray[np.complex128]
    magnitude: float = 0.0
    operations: int = 0

    @classmethod
    def of_sensitivity(cls, jacobian: Jacobian, gradient: Array, factor: float = 1.0, constant: float = 0.0) -> Self:
        """factor * tr(G B^T B) + constant as a polynomial, G = `gradient` (p, p)."""
        frequencies, coefficients = jacobian
        count, d = coefficients.shape[:2]
        pairs = np.einsum("fda,ab,gdb->fg", coefficients, factor * gradient, coefficients, optimize=True)
        sums = (frequencies[:, None] + frequencies[None]).reshape(count * count, -1)
        unique, place = np.unique(sums, axis=0, return_inverse=True)
        values = np.zeros(len(unique), dtype=np.complex128)
        np.add.at(values, place.ravel(), pairs.ravel())
        first = np.array([row[np.flatnonzero(row)[0]] if row.any() else 0 for row in unique])
        constant += float(values[first == 0].real.sum())
        size = np.abs(coefficients).sum(axis=0)  # (d, p)
        magnitude = abs(factor) * float(np.sum((size @ np.abs(gradient)) * size)) + abs(constant)
        operations = 4 * len(gradient) + 2 * d + 2 * count + 16  # lengths of the sums, nested
        return cls(constant, unique[first > 0], np.asarray(2.0 * values[first > 0]), magnitude, operations)

    @cached_property
    def margin(self) -> float:
        """What rounding can have cost."""
        magnitude = self.magnitude or abs(self.constant) + float(self._amplitudes.sum())
        return float(np.finfo(float).eps) * (self.operations + len(self.coefficients) + 64) * magnitude

    @cached_property
    def _amplitudes(self) -> Array:
        return np.abs(self.coefficients)

    def _phase(self, q: Array) -> Array:
        return np.asarray(q @ self.frequencies.T + np.angle(self.coefficients))

    def _weighted(self, weights: Array, frequencies: NDArray[np.int64]) -> Array:
        """(b, n, n) sum_t |c_t| weights_t f_t f_t^T."""
        n = frequencies.shape[1]
        outer = np.einsum("ti,tj->tij", frequencies, frequencies).reshape(-1, n * n)
        return ((weights * self._amplitudes) @ outer).reshape(-1, n, n)

    def value(self, q: Array) -> Array:
        """(b,) at postures (b, n)."""
        return self.constant + np.cos(self._phase(q)) @ self._amplitudes

    def termwise(self, center: Array, half: Array) -> Array:
        """(b,) upper bound: every wave at its own largest."""
        return self.constant + highest_cosine(self._phase(center), half @ np.abs(self.frequencies).T) @ self._amplitudes

    def bound(self, center: Array, half: Array) -> tuple[Array, Array]:
        """Per box a good posture (b, n) in it, by Newton's method, and an upper bound (b,) over it."""

        def slopes(q: Array) -> Array:
            return -np.sin(self._phase(q)) * self._amplitudes @ self.frequencies

        n, free = half.shape[1], (half > 0.0).astype(float)
        point = center
        for _ in range(3):  # joints of zero width do not move
            hessian = -self._weighted(np.cos(self._phase(point)), self.frequencies)
            hessian = hessian * free[:, :, None] * free[:, None, :] - np.eye(n) * (1.0 - free)[:, :, None]
            values, vectors = np.linalg.eigh(hessian)
            along = np.einsum("bij,bi->bj", vectors, slopes(point) * free) / np.maximum(np.abs(values), 1e-9)
            point = np.clip(point + np.einsum("bij,bj->bi", vectors, along), center - half, center + half)
        slope, above, below = slopes(point), center + half - point, point - center + half
        linear = np.maximum(slope * above, -slope * below).sum(axis=1)
        farthest = np.square(np.maximum(above, below)).sum(axis=1)
        taylor = self.value(point) + linear + 0.5 * np.maximum(self.curvature(center, half), 0.0) * farthest
        return point, np.minimum(taylor, self.termwise(center, half))

    def curvature(self, center: Array, half: Array) -> Array:
        """(b,) upper bound of the Hessian's largest eigenvalue over the box, in the joints that the box still spans."""
        phase, reach = self._phase(center), half @ np.abs(self.frequencies).T
        high, low = highest_cosine(phase, reach), -highest_cosine(phase + np.pi, reach)
        spans = (half > 0.0).astype(float)
        mask = spans[:, :, None] * spans[:, None, :]
        middle = -self._weighted(0.5 * (high + low), self.frequencies) * mask
        radius = self._weighted(0.5 * (high - low), np.abs(self.frequencies)) * mask
        largest = float(self._amplitudes @ np.square(self.frequencies).sum(axis=1))  # no eigenvalue exceeds it
        middle -= largest * np.eye(half.shape[1]) * (1.0 - spans)[:, :, None]  # joints without width never decide
        return np.linalg.eigvalsh(middle)[:, -1] + radius.sum(axis=2).max(axis=1) + 1e-14 * largest

    def split(self, center: Array, half: Array) -> tuple[Array, Array]:
        """Every box bisected along the joint that its polynomial depends on most."""
        rows, importance = np.arange(len(center)), half * (self._amplitudes @ np.abs(self.frequencies))
        widest = np.argmax(importance, axis=1)
        smaller, shift = half.copy(), np.zeros_like(half)
        smaller[rows, widest] *= 0.5
        shift[rows, widest] = smaller[rows, widest]
        return np.concatenate([center - shift, center + shift]), np.concatenate([smaller, smaller])


def highest_cosine(phase: Array, reach: Array) -> Array:
    """max cos over [phase - reach, phase + reach]: at the distance to the nearest multiple of 2 pi."""
    return np.cos(np.maximum(np.abs(np.remainder(phase + np.pi, 2.0 * np.pi) - np.pi) - reach, 0.0))


def maximum(
    polynomial: TrigonometricPolynomial,
    lower: Array,
    upper: Array,
    *,
    tried: Array,
    tolerance: float = 1e-10,
    most_boxes: int = 8_000,  # about a second
    stop: Stop = never,
) -> Maximum:
    """The largest value over lower <= q <= upper, to `tolerance` (absolute).

    tried : (k, n) good postures within the box, which save most of the work;  stop : asked between batches of boxes
    """
    values = polynomial.value(tried)
    best, posture = float(values.max()), tried[int(values.argmax())]
    center, half = (0.5 * (lower + upper))[None], (0.5 * (upper - lower))[None]
    promise = np.full(1, np.inf)  # upper bound of every box that waits
    boxes, discarded_bound = 0, -np.inf
    while len(center) and boxes < most_boxes and not stop():
        order = np.argsort(-promise)
        now, later = order[:2048], order[2048:]  # examined together
        boxes += len(now)
        point, bound = polynomial.bound(center[now], half[now])
        bound = np.minimum(bound, promise[now])
        reached = polynomial.value(point)
        if reached.max() > best:
            best, posture = float(reached.max()), point[int(reached.argmax())]
        left = bound > best + tolerance
        discarded_bound = max(discarded_bound, float(bound[~left].max(initial=-np.inf)))
        halves = polynomial.split(center[now][left], half[now][left])
        center, half = np.concatenate([center[later], halves[0]]), np.concatenate([half[later], halves[1]])
        promise = np.concatenate([promise[later], bound[left], bound[left]])
    top = max(discarded_bound, best, float(promise.max(initial=-np.inf))) + polynomial.margin
    return Maximum(best, np.clip(posture, lower, upper), top, not len(center), boxes)  # boxes are rounded


# -- is a sensitivity such a polynomial? -------------------------------------------------------------------------------
Frequency = tuple[int, ...]
# joint j -> coefficient of q_j itself; whole frequencies f -> that of exp(i f . q)
Sum = dict[int | Frequency, complex]
Jacobian = tuple[NDArray[np.int64], NDArray[np.complex128]]  # (R, n) f and (R, d, p) C of sum_f C_f exp(i f . q)


class NotTrigonometric(Exception):
    """An instruction leaves the ring of trigonometric polynomials."""


def trigonometric_jacobian(problem: DesignProblem) -> Jacobian | None:
    """B(q) as trigonometric polynomials, or None where it is not (a gear ratio, a sign of a torque)."""
    function, n = problem.scaled_jacobian_function, problem.joints
    constant = (0,) * n

    def add(x: Sum, y: Sum, sign: float = 1.0) -> Sum:
        return {key: x.get(key, 0.0) + sign * y.get(key, 0.0) for key in x | y}

    def multiply(x: Sum, y: Sum) -> Sum:
        terms: Sum = {}
        for (f, a), (g, b) in product(x.items(), y.items()):
            if constant in (f, g):
                key = g if f == constant else f
            elif isinstance(f, int) or isinstance(g, int):
                raise NotTrigonometric
            else:
                key = tuple(i + j for i, j in zip(f, g, strict=True))
            terms[key] = terms.get(key, 0.0) + a * b
        return terms

    def wave(x: Sum, quarter: complex = 1.0) -> Sum:
        """cos x, or with a `quarter` of a turn, -i, sin x."""
        slopes = [x.get(j, 0.0) for j in range(n)]
        # a fraction of an angle, as of a gear ratio known to be wrong, is not periodic
        if x.keys() - {constant, *range(n)} or any(slope != int(slope.real) for slope in slopes):
            raise NotTrigonometric
        ahead, back = (tuple(int(sign * slope.real) for slope in slopes) for sign in (1, -1))
        turn = complex(quarter * np.exp(1j * x.get(constant, 0.0)))
        return add({ahead: turn / 2.0}, {back: turn.conjugate() / 2.0})

    def divide(x: Sum, y: Sum) -> Sum:
        if y.keys() - {constant}:
            raise NotTrigonometric
        return multiply(x, {constant: 1.0 / y[constant]})

    operations: dict[int, Callable[..., Sum]] = {
        ca.OP_ASSIGN: lambda x: x,
        ca.OP_COS: wave,
        ca.OP_SIN: lambda x: wave(x, -1j),
        ca.OP_ADD: add,
        ca.OP_SUB: lambda x, y: add(x, y, -1.0),
        ca.OP_NEG: lambda x: add({}, x, -1.0),
        ca.OP_TWICE: lambda x: add(x, x),
        ca.OP_SQ: lambda x: multiply(x, x),
        ca.OP_MUL: multiply,
        ca.OP_DIV: divide,
    }
    places = list(zip(*function.sparsity_out(0).get_triplet(), strict=True))
    work, entries = dict[int, Sum](), dict[tuple[int, int], Sum]()
    try:
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            sources, targets = function.instruction_input(k), function.instruction_output(k)
            if operation == ca.OP_CONST:
                work[targets[0]] = {constant: function.instruction_constant(k)}
            elif operation == ca.OP_INPUT:
                work[targets[0]] = {sources[1]: 1.0}
            elif operation == ca.OP_OUTPUT:
                entries[places[targets[1]]] = work[sources[0]]
            elif operation in operations:
                work[targets[0]] = operations[operation](*(work[s] for s in sources))
            else:
                return None
    except (NotTrigonometric, ZeroDivisionError):
        return None
    every = {f for entry in entries.values() for f in entry}
    frequencies = sorted(f for f in every if not isinstance(f, int))
    # beyond 400, a bound by branch and bound is out of reach
    if not frequencies or len(frequencies) < len(every) or len(frequencies) > 400:
        return None
    coefficients = np.zeros((len(frequencies), problem.model.dimension, problem.parameters), dtype=complex)
    for (row, column), entry in entries.items():
        for k, frequency in enumerate(frequencies):
            coefficients[k, row, column] = entry.get(frequency, 0.0)
    return np.array(frequencies).reshape(-1, n), coefficients
