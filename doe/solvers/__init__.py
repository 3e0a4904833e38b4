"""Exact solvers, and `solve`, the only entry point to them."""

from doe.solvers.exchange import Exchange
from doe.solvers.ipopt import Ipopt
from doe.solvers.solver import Offer, Solver
from doe.solvers.solving import SOLVERS, Analytic, Random, available_solvers, solve

__all__ = ["SOLVERS", "Analytic", "Exchange", "Ipopt", "Offer", "Random", "Solver", "available_solvers", "solve"]
