"""Numpy functions as CasADi functions, for IPOPT."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import casadi as ca
import numpy as np

from doe.solvers.solver import Budget
from identification.arrays import Array


class Watch(Protocol):
    """State shared with the caller of IPOPT: the budget, and whether the user pressed Ctrl-C."""

    budget: Budget
    interrupted: bool


@contextmanager
def interrupts_noted(watch: Watch) -> Iterator[None]:
    """Ctrl-C, and SIGTERM where it raises, set `watch.interrupted` instead: CasADi would swallow the exception."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(*_: object) -> None:
        watch.interrupted = True

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # CasADi listens to SIGINT itself, also where a shell started the program in the background and it is ignored
    raising = {number: handler for number, handler in before.items() if number == signal.SIGINT or callable(handler)}
    try:
        for number in raising:
            signal.signal(number, note)
        yield
    finally:
        for number, handler in raising.items():
            signal.signal(number, handler or signal.SIG_DFL)


class Guarded(ca.Callback):
    """A numpy function as a CasADi function. Failures become NaN, which IPOPT answers by a shorter step."""

    def __init__(
        self,
        name: str,
        inputs: dict[str, ca.Sparsity],
        outputs: dict[str, ca.Sparsity],
        function: Callable[..., list[Array]],
    ) -> None:
        ca.Callback.__init__(self)
        self.inputs, self.outputs, self.function = list(inputs.items()), list(outputs.items()), function
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self.inputs)

    def get_n_out(self) -> int:
        return len(self.outputs)

    def get_name_in(self, i: int) -> str:
        return self.inputs[i][0]

    def get_name_out(self, i: int) -> str:
        return self.outputs[i][0]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return self.inputs[i][1]

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self.outputs[i][1]

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        try:
            values = self.function(*(np.asarray(a).ravel() for a in arguments))
            return [ca.DM(sparsity, value) for (_, sparsity), value in zip(self.outputs, values, strict=True)]
        except np.linalg.LinAlgError:
            return [ca.DM(sparsity, np.nan) for _, sparsity in self.outputs]


class Stop(ca.Callback):
    """Ends IPOPT when time is up or the user pressed Ctrl-C."""

    def __init__(self, size: int, constraints: int, owner: Watch) -> None:
        ca.Callback.__init__(self)
        self.size, self.constraints, self.owner = size, constraints, owner
        self.construct("stop", {})

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return ca.nlpsol_out(i)

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        rows = {"f": 1, "x": self.size, "lam_x": self.size, "g": self.constraints, "lam_g": self.constraints}
        count = rows.get(ca.nlpsol_out(i), 0)
        return ca.Sparsity.dense(count, 1) if count else ca.Sparsity(0, 0)

    def eval(self, arguments: Sequence[ca.DM]) -> list[Any]:
        return [float(self.owner.interrupted or self.owner.budget.out_of_time)]
