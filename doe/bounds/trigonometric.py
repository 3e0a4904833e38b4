"""Is a model's sensitivity a trigonometric polynomial of the joint angles? Read off its CasADi instructions.

The scaled Jacobians B(q) of a chain of revolute joints, planar or spatial, are sums of products of sines and cosines of
whole combinations of joint angles; most effects keep that. Then d(q) = c_0 + sum_t Re(c_t exp(i f_t . q)), whole f_t,
and its maximum over a box can be bounded by a theorem (`doe.bounds.branch_and_bound`). The walk over the
instructions is the proof: anything that leaves the ring of trigonometric polynomials gives None.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from doe.problem.problem import DesignProblem
from identification.arrays import Array

Frequency = tuple[int, ...]
Polynomial = dict[Frequency, complex]  # whole frequencies -> coefficient of exp(i f . q)
MOST_TERMS = 400  # beyond, a bound by branch and bound is out of reach


@dataclass(frozen=True)
class Angle:
    """A whole combination of joint angles plus a constant [rad]."""

    frequency: Frequency
    constant: float


@dataclass(frozen=True)
class TrigonometricPolynomial:
    """constant + sum_t Re(coefficients_t exp(i frequencies_t . q)); frequencies (T, n) whole, coefficients (T,).

    magnitude, operations : sum of magnitudes that went into the coefficients before anything cancelled, and the number
        of operations in a row, for a bound on the rounding error; 0: the coefficients are exact
    """

    constant: float
    frequencies: NDArray[np.int64]
    coefficients: NDArray[np.complex128]
    magnitude: float = 0.0
    operations: int = 0

    def value(self, q: Array) -> Array:
        """(...) at postures (..., n)."""
        return self.constant + (np.exp(1j * (q @ self.frequencies.T)) @ self.coefficients).real


@dataclass(frozen=True)
class TrigonometricJacobian:
    """B(q) = sum_f C_f exp(i f . q): frequencies (R, n) whole, coefficients (R, d, p) complex."""

    frequencies: NDArray[np.int64]
    coefficients: NDArray[np.complex128]

    def sensitivity(self, gradient: Array, factor: float = 1.0, constant: float = 0.0) -> TrigonometricPolynomial:
        """factor * tr(G B^T B) + constant as a polynomial, G = `gradient` (p, p)."""
        count, n = self.frequencies.shape
        pairs = np.einsum("fda,ab,gdb->fg", self.coefficients, factor * gradient, self.coefficients, optimize=True)
        sums = (self.frequencies[:, None] + self.frequencies[None]).reshape(count * count, n)
        unique, place = np.unique(sums, axis=0, return_inverse=True)
        values = np.zeros(len(unique), dtype=np.complex128)
        np.add.at(values, place.ravel(), pairs.ravel())
        first = np.array([row[np.flatnonzero(row)[0]] if row.any() else 0 for row in unique])
        constant += float(values[first == 0].real.sum())
        size = np.abs(self.coefficients).sum(axis=0)  # (d, p)
        magnitude = abs(factor) * float(np.sum((size @ np.abs(gradient)) * size)) + abs(constant)
        operations = 4 * len(gradient) + 2 * self.coefficients.shape[1] + 2 * count + 16  # lengths of the sums, nested
        return TrigonometricPolynomial(
            constant, unique[first > 0], np.asarray(2.0 * values[first > 0]), magnitude, operations
        )


def trigonometric_jacobian(problem: DesignProblem) -> TrigonometricJacobian | None:
    """B as trigonometric polynomials, or None where they are not (a gear ratio, a sign of a torque)."""
    entries = _entries(problem.scaled_jacobian_function)
    if entries is None:
        return None
    d, p, n = problem.model.dimension, problem.parameters, problem.joints
    frequencies = sorted({f for polynomial in entries.values() for f in polynomial})
    if not frequencies or len(frequencies) > MOST_TERMS:
        return None
    coefficients = np.zeros((len(frequencies), d, p), dtype=complex)
    slot = {frequency: k for k, frequency in enumerate(frequencies)}
    for (row, column), polynomial in entries.items():
        for frequency, value in polynomial.items():
            coefficients[slot[frequency], row, column] = value
    return TrigonometricJacobian(np.array(frequencies).reshape(-1, n), coefficients)


def _entries(function: ca.Function) -> dict[tuple[int, int], Polynomial] | None:
    """(row, column) -> polynomial of the function's one output."""
    n = function.size1_in(0)
    places = list(zip(*function.sparsity_out(0).get_triplet(), strict=True))
    work: dict[int, Angle | Polynomial] = {}
    entries: dict[tuple[int, int], Polynomial] = {}
    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_CONST:
            work[targets[0]] = Angle((0,) * n, function.instruction_constant(k))
        elif operation == ca.OP_INPUT:
            work[targets[0]] = Angle(tuple(int(j == sources[1]) for j in range(n)), 0.0)
        elif operation == ca.OP_OUTPUT:
            polynomial = _polynomial(work[sources[0]])
            if polynomial is None:
                return None
            entries[places[targets[1]]] = polynomial
        else:
            result = _apply(operation, [work[s] for s in sources])
            if result is None:
                return None
            work[targets[0]] = result
    return entries


def _polynomial(value: Angle | Polynomial) -> Polynomial | None:
    if isinstance(value, dict):
        return value
    return {value.frequency: complex(value.constant)} if not any(value.frequency) else None


def _constant(value: Angle | Polynomial) -> float | None:
    return value.constant if isinstance(value, Angle) and not any(value.frequency) else None


def _apply(operation: int, x: list[Angle | Polynomial]) -> Angle | Polynomial | None:
    """One instruction on angles and polynomials; None where the result is neither."""
    if operation in (ca.OP_SIN, ca.OP_COS):
        return _wave(x[0], operation)
    if operation in (ca.OP_ADD, ca.OP_SUB):
        return _add(x[0], x[1], 1.0 if operation == ca.OP_ADD else -1.0)
    if operation in (ca.OP_NEG, ca.OP_TWICE):
        return _scale(x[0], -1.0 if operation == ca.OP_NEG else 2.0)
    if operation == ca.OP_SQ:
        return _multiply(x[0], x[0])
    if operation == ca.OP_MUL:
        return _multiply(x[0], x[1])
    if operation == ca.OP_DIV:
        divisor = _constant(x[1])
        return None if not divisor else _scale(x[0], 1.0 / divisor)
    return x[0] if operation == ca.OP_ASSIGN else None


def _wave(x: Angle | Polynomial, operation: int) -> Polynomial | None:
    if not isinstance(x, Angle):
        return None
    turn = np.exp(1j * x.constant)
    if not any(x.frequency):
        return {x.frequency: complex(turn.imag if operation == ca.OP_SIN else turn.real)}
    half = turn / 2.0 if operation == ca.OP_COS else turn / 2.0j
    opposite = tuple(-f for f in x.frequency)
    return {x.frequency: complex(half), opposite: complex(np.conj(half))}


def _scale(x: Angle | Polynomial, factor: float) -> Angle | Polynomial | None:
    if isinstance(x, dict):
        return {frequency: factor * value for frequency, value in x.items()}
    scaled = tuple(factor * f for f in x.frequency)
    if any(f != int(f) for f in scaled):
        return None  # a fraction of an angle: a gear ratio known to be wrong, not periodic
    return Angle(tuple(int(f) for f in scaled), factor * x.constant)


def _add(x: Angle | Polynomial, y: Angle | Polynomial, sign: float) -> Angle | Polynomial | None:
    if isinstance(x, Angle) and isinstance(y, Angle):
        frequency = tuple(a + int(sign) * b for a, b in zip(x.frequency, y.frequency, strict=True))
        return Angle(frequency, x.constant + sign * y.constant)
    left, right = _polynomial(x), _polynomial(y)
    if left is None or right is None:
        return None
    total = dict(left)
    for frequency, value in right.items():
        total[frequency] = total.get(frequency, 0.0) + sign * value
    return total


def _multiply(x: Angle | Polynomial, y: Angle | Polynomial) -> Angle | Polynomial | None:
    for factor, other in ((_constant(x), y), (_constant(y), x)):
        if factor is not None:
            return _scale(other, factor)
    left, right = _polynomial(x), _polynomial(y)
    if left is None or right is None:
        return None
    product: Polynomial = {}
    for f, a in left.items():
        for g, b in right.items():
            key = tuple(i + j for i, j in zip(f, g, strict=True))
            product[key] = product.get(key, 0.0) + a * b
    return product
