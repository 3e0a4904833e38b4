"""Exact solvers: one method per file, and `solve`, the only entry point to them."""

from __future__ import annotations

from doe.solvers.exchange import Exchange
from doe.solvers.exchange_ipopt import ExchangeIpopt
from doe.solvers.fedorov import Fedorov
from doe.solvers.gradient import Gradient
from doe.solvers.ipopt import Ipopt
from doe.solvers.planar_theory import Analytic
from doe.solvers.random import Random
from doe.solvers.registry import SOLVERS, available_solvers, solver_named
from doe.solvers.relaxation_rounding import RelaxRound
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
