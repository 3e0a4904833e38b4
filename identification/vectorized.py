"""CasADi expressions on numpy arrays: the instructions of an SX function as vectorised numpy source.

CasADi evaluates one posture at a time. Here each of its instructions runs once on arrays, so a million postures cost
one pass, and arguments broadcast: what depends only on the posture is computed per posture, what depends only on the
parameters is computed per parameter set.
"""

import math
from collections.abc import Callable
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

Evaluate = Callable[..., tuple[np.ndarray, ...]]  # of arrays, see `vectorize`
PART = 4096  # of a batch at a time: the arrays of an instruction, 32 kB each, stay in the processor's cache

# CasADi operation -> numpy source of its operands
ARITHMETIC = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_ASSIGN: "{0}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_IF_ELSE_ZERO: "np.where({0}, {1}, 0.0)",
}
# CasADi operation -> function of numpy, and of those that are true or false
ALIKE = "sin cos tan sinh cosh tanh exp log log1p expm1 sqrt sign floor ceil fmod hypot copysign"
NAMES = {name: name for name in ALIKE.split()} | {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "fabs": "abs"}
NAMES |= {"pow": "power", "constpow": "power", "atan2": "arctan2", "fmin": "minimum", "fmax": "maximum"}
TRUTHS = {"lt": "less", "le": "less_equal", "eq": "equal", "ne": "not_equal"}
TRUTHS |= {"and": "logical_and", "or": "logical_or", "not": "logical_not"}
FUNCTIONS = {getattr(ca, f"OP_{name.upper()}"): function for name, function in (NAMES | TRUTHS).items()}


def vectorize(function: ca.Function) -> Evaluate:
    """Numpy version of an SX function whose inputs are dense column vectors. The result takes, per input, an array
    whose LAST axis runs over the components and whose leading axes broadcast against those of the other inputs; it
    returns, per output, an array of the broadcast shape + (rows, columns)."""
    run, shapes = _compiled(function.serialize()), [function.size_out(i) for i in range(function.n_out())]

    def evaluate(*arguments: ArrayLike) -> tuple[np.ndarray, ...]:
        # components first: each is written in contiguous runs
        inputs = [a.transpose(-1, *range(a.ndim - 1)) for a in (np.asarray(a, dtype=float) for a in arguments)]
        batch = np.broadcast_shapes(*(a.shape[1:] for a in inputs))
        sizes = batch or (1,)
        inputs = [a.reshape(len(a), *[1] * (1 + len(sizes) - a.ndim), *a.shape[1:]) for a in inputs]
        full = [np.zeros((*shape, *sizes)) for shape in shapes]  # structural zeros are zero
        # cut along the longest axis into parts whose arrays stay in the processor's cache; axes that broadcast stay
        axis, longest = sizes.index(max(sizes)), max(sizes)
        rows = max(1, PART * longest // max(1, math.prod(sizes)))
        for start in range(0, longest, rows):
            part = (*[slice(None)] * axis, slice(start, start + rows))
            run([[*(a[:, *part] if a.shape[1 + axis] > 1 else a)] for a in inputs], [y[:, :, *part] for y in full])
        return tuple(y.reshape(*y.shape[:2], *batch).transpose(*range(2, 2 + len(batch)), 0, 1) for y in full)

    return evaluate


@lru_cache(maxsize=128)
def _compiled(serialized: str) -> Callable[[list[list[np.ndarray]], list[np.ndarray]], None]:
    """The function as numpy source, of components x of its inputs, which writes its outputs into y; equal functions are
    set up again and again, as parts of different models."""
    function, lines = ca.Function.deserialize(serialized), ["def run(x, y):"]
    places = [[*zip(*function.sparsity_out(i).get_triplet(), strict=True)] for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        operation, operands = function.instruction_id(k), function.instruction_input(k)
        target, *place = function.instruction_output(k)
        words = [*map("w{}".format, operands)]
        if operation == ca.OP_OUTPUT:
            line = "y[{}][{}, {}] = {}".format(target, *places[target][place[0]], words[0])
        elif operation == ca.OP_CONST:
            line = f"w{target} = {function.instruction_constant(k)!r}"
        elif operation == ca.OP_INPUT:
            line = f"w{target} = x[{operands[0]}][{operands[1]}]"
        elif operation in ARITHMETIC:
            line = f"w{target} = " + ARITHMETIC[operation].format(*words)
        elif operation in FUNCTIONS:
            one = " * 1.0" if FUNCTIONS[operation] in TRUTHS.values() else ""
            line = f"w{target} = np.{FUNCTIONS[operation]}({', '.join(words)}){one}"
        else:
            reason = f"CasADi operation {operation} has no numpy form here"
            raise NotImplementedError(f"{reason}; add it to identification/vectorized.py")
        lines.append(f"    {line}")
    scope: dict[str, object] = {"np": np}
    exec(compile("\n".join([*lines, "    return"]), f"<instructions of {function.name()}>", "exec"), scope)
    return scope["run"]  # type: ignore[return-value]
