"""Exact solvers, and `solve`, the only entry point to them."""

from __future__ import annotations

from doe.solvers.exchange import Exchange, Fedorov
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic
from doe.solvers.polished import ExchangeIpopt, Gradient, RelaxRound
from doe.solvers.registry import SOLVERS, Random, available_solvers, solver_named
from doe.solvers.solver import Offer, Solver
from doe.solvers.solving import solve

__all__ = [
    "SOLVERS",
    "Analytic",
    "Exchange",
    "ExchangeIpopt",
    "Fedorov",
    "Gradient",
    "Ipopt",
    "Offer",
    "Random",
    "RelaxRound",
    "Solver",
    "available_solvers",
    "solve",
    "solver_named",
]
