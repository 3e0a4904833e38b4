"""The solvers by name: ours, and those of installed packages."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from doe.solvers.exchange import Exchange
from doe.solvers.exchange_ipopt import ExchangeIpopt
from doe.solvers.fedorov import Fedorov
from doe.solvers.gradient import Gradient
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic
from doe.solvers.random import Random
from doe.solvers.relaxation_rounding import RelaxRound
from doe.solvers.solver import Solver
from identification.errors import InputError, nearest
from identification.installed import additions

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
    found: dict[str, Solver] = {}
    for name, where, made in additions("armcal.solvers"):
        try:
            solver = made() if isinstance(made, type) else made
        except Exception as error:  # noqa: BLE001 - other people's code
            raise InputError(f"{where}: {error}, allowed: a class that needs no arguments") from None
        if not callable(getattr(solver, "offers", None)):
            raise InputError(f"{where}, allowed: a solver with offers()")
        found[name] = solver
    return found


def solver_named(name: str) -> Solver:
    """The solver of a name as in `--solver`. Raises `InputError` with the nearest name for an unknown one."""
    if name not in available_solvers():
        raise InputError(f"solver: unknown name {name!r}, {nearest(name, available_solvers())}")
    return available_solvers()[name]
