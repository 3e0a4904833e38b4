"""Is a model's sensitivity a trigonometric polynomial of the joint angles? Read off its CasADi instructions.

The scaled Jacobians B(q) of a chain of revolute joints, planar or spatial, are sums of products of sines and cosines of
whole combinations of joint angles; most effects keep that. Then d(q) = c_0 + sum_t Re(c_t exp(i f_t . q)), whole f_t,
and its maximum over a box can be bounded by a theorem (`doe.bounds.branch_and_bound`). The walk over the
instructions is the proof: anything that leaves the ring of trigonometric polynomials gives None.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from doe.bounds.branch_and_bound import TrigonometricPolynomial
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


class NotTrigonometric(Exception):
    """An instruction leaves the ring of trigonometric polynomials."""


def trigonometric_jacobian(problem: DesignProblem) -> TrigonometricJacobian | None:
    """B as trigonometric polynomials, or None where they are not (a gear ratio, a sign of a torque)."""
    try:
        entries = polynomials(problem.scaled_jacobian_function)
    except NotTrigonometric:
        return None
    frequencies = sorted({f for polynomial in entries.values() for f in polynomial})
    if not frequencies or len(frequencies) > MOST_TERMS:
        return None
    coefficients = np.zeros((len(frequencies), problem.model.dimension, problem.parameters), dtype=complex)
    slot = {frequency: k for k, frequency in enumerate(frequencies)}
    for (row, column), polynomial in entries.items():
        for frequency, value in polynomial.items():
            coefficients[slot[frequency], row, column] = value
    return TrigonometricJacobian(np.array(frequencies).reshape(-1, problem.joints), coefficients)


def polynomials(function: ca.Function) -> dict[tuple[int, int], Polynomial]:
    """(row, column) -> polynomial of the function's one output. Raises `NotTrigonometric`."""
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
            entries[places[targets[1]]] = _polynomial(work[sources[0]])
        elif operation in OPERATIONS:
            work[targets[0]] = OPERATIONS[operation](*(work[s] for s in sources))
        else:
            raise NotTrigonometric
    return entries


def _polynomial(value: Angle | Polynomial) -> Polynomial:
    if isinstance(value, dict):
        return value
    return {value.frequency: complex(_constant(value))}


def _constant(value: Angle | Polynomial) -> float:
    if isinstance(value, dict) or any(value.frequency):
        raise NotTrigonometric
    return value.constant


def _is_constant(value: Angle | Polynomial) -> bool:
    return isinstance(value, Angle) and not any(value.frequency)


def _wave(x: Angle | Polynomial, quarter: complex = 1.0) -> Polynomial:
    """cos x, or with a `quarter` of a turn, -i, sin x."""
    if not isinstance(x, Angle):
        raise NotTrigonometric
    turn = quarter * np.exp(1j * x.constant)
    if not any(x.frequency):
        return {x.frequency: complex(turn.real)}
    return {x.frequency: complex(turn / 2.0), tuple(-f for f in x.frequency): complex(np.conj(turn) / 2.0)}


def _scale(x: Angle | Polynomial, factor: float) -> Angle | Polynomial:
    if isinstance(x, dict):
        return {frequency: factor * value for frequency, value in x.items()}
    scaled = tuple(factor * f for f in x.frequency)
    if any(f != int(f) for f in scaled):
        raise NotTrigonometric  # a fraction of an angle: a gear ratio known to be wrong, not periodic
    return Angle(tuple(int(f) for f in scaled), factor * x.constant)


def _add(x: Angle | Polynomial, y: Angle | Polynomial) -> Angle | Polynomial:
    if isinstance(x, Angle) and isinstance(y, Angle):
        return Angle(tuple(a + b for a, b in zip(x.frequency, y.frequency, strict=True)), x.constant + y.constant)
    total = dict(_polynomial(x))
    for frequency, value in _polynomial(y).items():
        total[frequency] = total.get(frequency, 0.0) + value
    return total


def _multiply(x: Angle | Polynomial, y: Angle | Polynomial) -> Angle | Polynomial:
    for factor, other in ((x, y), (y, x)):
        if _is_constant(factor):
            return _scale(other, _constant(factor))
    product: Polynomial = {}
    for f, a in _polynomial(x).items():
        for g, b in _polynomial(y).items():
            key = tuple(i + j for i, j in zip(f, g, strict=True))
            product[key] = product.get(key, 0.0) + a * b
    return product


def _divide(x: Angle | Polynomial, y: Angle | Polynomial) -> Angle | Polynomial:
    if _constant(y) == 0.0:
        raise NotTrigonometric
    return _scale(x, 1.0 / _constant(y))


OPERATIONS: Mapping[int, Callable[..., Angle | Polynomial]] = MappingProxyType(
    {
        ca.OP_ASSIGN: lambda x: x,
        ca.OP_COS: _wave,
        ca.OP_SIN: lambda x: _wave(x, -1j),
        ca.OP_ADD: _add,
        ca.OP_SUB: lambda x, y: _add(x, _scale(y, -1.0)),
        ca.OP_NEG: lambda x: _scale(x, -1.0),
        ca.OP_TWICE: lambda x: _scale(x, 2.0),
        ca.OP_SQ: lambda x: _multiply(x, x),
        ca.OP_MUL: _multiply,
        ca.OP_DIV: _divide,
    }
)
