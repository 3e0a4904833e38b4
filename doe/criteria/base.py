"""What a criterion is. Every criterion is MAXIMISED and is a concave function of the information matrix."""

from __future__ import annotations

from typing import Protocol

from identification.arm import Array


class Criterion(Protocol):
    """A concave function Phi of the (p, p) scaled information matrix per run, M = sum_i w_i B_i^T B_i, sum w = 1.

    A singular M has the value -inf, not an error.
    """

    name: str  # as in `--criterion`

    def value(self, information: Array) -> Array:
        """(...) Phi(M) of matrices (..., p, p); -inf where M is singular."""
        ...

    def gradient(self, information: Array) -> Array:
        """(p, p) G = dPhi/dM. Equivalence theorem: w is optimal iff max_q tr(G B(q)^T B(q)) = tr(G M)."""
        ...

    def upper_bound(self, information: Array, largest: float) -> float:
        """No design has a greater value than this, given `largest` >= max_q tr(G B(q)^T B(q)) over the design space."""
        ...

    def efficiency(self, value: float, bound: float, parameters: int) -> float:
        """Share 0..1 of the runs that an optimal design would need for the same accuracy."""
        ...
