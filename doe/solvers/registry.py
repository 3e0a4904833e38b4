"""The solvers by name: ours, and those of installed packages; and random plans, common practice to compare with."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType

import numpy as np

from doe.problem.postures import random_postures
from doe.problem.problem import DesignProblem
from doe.solvers.exchange import Exchange, Fedorov
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic
from doe.solvers.polished import ExchangeIpopt, Gradient, RelaxRound
from doe.solvers.solver import Budget, Offer, Solver
from identification.errors import InputError, nearest
from identification.installed import additions


@dataclass(frozen=True)
class Random:
    """Plans uniform within the joint limits, the best of `count`. One: a random plan."""

    count: int = 1
    name: str = "random"

    def starts_for(self, problem: DesignProblem) -> int:
        """Number of random plans."""
        return self.count

    def offers(
        self, problem: DesignProblem, runs: int, generator: np.random.Generator, budget: Budget
    ) -> Iterator[Offer]:
        """One random plan per start."""
        while True:
            yield Offer(random_postures(problem, runs, generator), 1)


SOLVERS: dict[str, Solver] = {
    "analytic": Analytic(),
    "exchange": Exchange(),
    "exchange_ipopt": ExchangeIpopt(),
    "fedorov": Fedorov(),
    "gradient": Gradient(),
    "ipopt": Ipopt(),
    "random": Random(),
    "relaxation_rounding": RelaxRound(),
    "best_of_random": Random(count=1000, name="best_of_random"),
}


def available_solvers() -> Mapping[str, Solver]:
    """Name -> solver of every one known: ours, and those of installed packages (entry-point group `armcal.solvers`).

    An entry point names a settings object, or a class that makes one without arguments. Raises `InputError` for one
    that cannot be loaded.
    """
    return MappingProxyType({**installed_solvers(), **SOLVERS})


@cache
def installed_solvers() -> dict[str, Solver]:
    """Name -> solver of the entry points, loaded once."""
    loaded: dict[str, Solver] = {}
    for name, where, made in additions("armcal.solvers"):
        try:
            solver = made() if isinstance(made, type) else made
        except Exception as error:  # noqa: BLE001 - other people's code
            raise InputError(f"{where}: {error}, allowed: a class that needs no arguments") from None
        if not callable(getattr(solver, "offers", None)):
            raise InputError(f"{where}, allowed: a solver with offers()")
        loaded[name] = solver
    return loaded


def solver_named(name: str) -> Solver:
    """The solver of a name as in `--solver`. Raises `InputError` with the nearest name for an unknown one."""
    if name not in available_solvers():
        raise InputError(f"solver: unknown name {name!r}, {nearest(name, available_solvers())}")
    return available_solvers()[name]
