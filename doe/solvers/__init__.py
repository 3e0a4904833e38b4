"""Exact solvers, and `solve`, the only entry point to them."""

from __future__ import annotations

from doe.solvers.exchange import Exchange, ExchangeIpopt, Fedorov, Gradient, RelaxRound
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic
from doe.solvers.solver import Offer, Solver
from doe.solvers.solving import SOLVERS, Random, available_solvers, solve, solver_named

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
