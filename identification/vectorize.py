"""CasADi expressions on numpy arrays: the instructions of an SX function as vectorised numpy source.

CasADi evaluates one posture at a time. Here each of its instructions runs once on arrays, so a million postures cost
one pass, and arguments broadcast: what depends only on the posture is computed per posture, what depends only on the
parameters is computed per parameter set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

Evaluate = Callable[..., tuple[np.ndarray, ...]]  # of arrays, see `vectorize`
PART = 4096  # of a batch at a time: the arrays of an instruction, 32 kB each, stay in the processor's cache

BINARY = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_POW: "np.power({0}, {1})",
    ca.OP_CONSTPOW: "np.power({0}, {1})",
    ca.OP_ATAN2: "np.arctan2({0}, {1})",
    ca.OP_FMIN: "np.minimum({0}, {1})",
    ca.OP_FMAX: "np.maximum({0}, {1})",
    ca.OP_FMOD: "np.fmod({0}, {1})",
    ca.OP_HYPOT: "np.hypot({0}, {1})",
    ca.OP_COPYSIGN: "np.copysign({0}, {1})",
    ca.OP_LT: "np.less({0}, {1}) * 1.0",
    ca.OP_LE: "np.less_equal({0}, {1}) * 1.0",
    ca.OP_EQ: "np.equal({0}, {1}) * 1.0",
    ca.OP_NE: "np.not_equal({0}, {1}) * 1.0",
    ca.OP_AND: "np.logical_and({0}, {1}) * 1.0",
    ca.OP_OR: "np.logical_or({0}, {1}) * 1.0",
    ca.OP_IF_ELSE_ZERO: "np.where({0}, {1}, 0.0)",
}
UNARY = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_SIN: "np.sin({0})",
    ca.OP_COS: "np.cos({0})",
    ca.OP_TAN: "np.tan({0})",
    ca.OP_ASIN: "np.arcsin({0})",
    ca.OP_ACOS: "np.arccos({0})",
    ca.OP_ATAN: "np.arctan({0})",
    ca.OP_SINH: "np.sinh({0})",
    ca.OP_COSH: "np.cosh({0})",
    ca.OP_TANH: "np.tanh({0})",
    ca.OP_EXP: "np.exp({0})",
    ca.OP_LOG: "np.log({0})",
    ca.OP_LOG1P: "np.log1p({0})",
    ca.OP_EXPM1: "np.expm1({0})",
    ca.OP_SQRT: "np.sqrt({0})",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_FABS: "np.abs({0})",
    ca.OP_SIGN: "np.sign({0})",
    ca.OP_FLOOR: "np.floor({0})",
    ca.OP_CEIL: "np.ceil({0})",
    ca.OP_NOT: "np.logical_not({0}) * 1.0",
}


def vectorize(function: ca.Function) -> Evaluate:
    """Numpy version of an SX function whose inputs are dense column vectors.

    The result takes, per input, an array whose LAST axis runs over the components and whose leading axes broadcast
    against those of the other inputs; it returns, per output, an array of the broadcast shape + (rows, columns).
    """
    compiled = _compiled(function.serialize())
    sparsities = [function.sparsity_out(i) for i in range(function.n_out())]
    shapes = [sparsity.shape for sparsity in sparsities]
    places = [tuple(zip(*s.get_triplet(), strict=True)) for s in sparsities]

    def evaluate(*arguments: ArrayLike) -> tuple[np.ndarray, ...]:
        inputs = [np.asarray(a, dtype=float) for a in arguments]
        batch = np.broadcast_shapes(*(a.shape[:-1] for a in inputs))
        # components first: each is written in contiguous runs; structural zeros are zero
        full = [np.zeros((*shape, *batch)) for shape in shapes]
        for part in _parts(batch):
            outputs = compiled([_components(_of(a, part)) for a in inputs])
            for array, values, place in zip(full, outputs, places, strict=True):
                for value, (row, column) in zip(values, place, strict=True):
                    where: tuple[int | slice, ...] = (row, column, *part)
                    array[where] = value
        return tuple(array.transpose(*range(2, array.ndim), 0, 1) for array in full)

    return evaluate


def _parts(batch: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """The batch cut along its longest axis into parts whose arrays stay in the processor's cache; (): all of it."""
    if (total := math.prod(batch)) <= PART:
        yield ()
        return
    axis = int(np.argmax(batch))
    rows = max(1, PART * batch[axis] // total)
    for start in range(0, batch[axis], rows):
        yield tuple(slice(start, start + rows) if k == axis else slice(None) for k in range(len(batch)))


def _of(array: np.ndarray, part: tuple[slice, ...]) -> np.ndarray:
    """What a part of the batch needs of an argument; axes that broadcast stay."""
    if not part:
        return array
    axes = part[len(part) - (array.ndim - 1) :]
    return array[tuple(one if size > 1 else slice(None) for one, size in zip(axes, array.shape[:-1], strict=True))]


def _components(array: np.ndarray) -> list[np.ndarray]:
    """Along the last axis."""
    return list(array.transpose(-1, *range(array.ndim - 1)))


@lru_cache(maxsize=128)
def _compiled(serialized: str) -> Callable[[list[list[np.ndarray]]], list[list[np.ndarray]]]:
    """The function as numpy source; equal functions are set up again and again, as parts of different models."""
    function = ca.Function.deserialize(serialized)
    lines = ["def run(x):", f"    y = [[0.0] * k for k in {[function.nnz_out(i) for i in range(function.n_out())]}]"]
    for k in range(function.n_instructions()):
        lines.append("    " + _line(function, k))
    lines.append("    return y")
    scope: dict[str, object] = {"np": np}
    exec(compile("\n".join(lines), f"<instructions of {function.name()}>", "exec"), scope)
    return scope["run"]  # type: ignore[return-value]


def _line(function: ca.Function, k: int) -> str:
    operation = function.instruction_id(k)
    sources, targets = function.instruction_input(k), function.instruction_output(k)
    if operation == ca.OP_CONST:
        return f"w{targets[0]} = {function.instruction_constant(k)!r}"
    if operation == ca.OP_INPUT:
        return f"w{targets[0]} = x[{sources[0]}][{sources[1]}]"
    if operation == ca.OP_OUTPUT:
        return f"y[{targets[0]}][{targets[1]}] = w{sources[0]}"
    template = UNARY.get(operation) or BINARY.get(operation)
    if template is None:
        raise NotImplementedError(
            f"CasADi operation {operation} has no numpy form here; add it to identification/vectorize.py"
        )
    return f"w{targets[0]} = " + template.format(*(f"w{s}" for s in sources))
