"""Is a design optimal? The equivalence theorem and the bounds that follow from it, independent of every solver.

A design w is optimal over a set Q of postures if and only if max_(q in Q) tr(G F(q)) = tr(G M(w)), with G the gradient
of the criterion at M(w), B the scaled Jacobian (d, p) of a posture, whose d coordinates are indivisible, and F = B^T B,
or the matrix F of `PriorInformation` where something is known already (doe/README.md, "Equivalence theorem"). For D,
G = M^-1 and the right side is p. From any design, optimal or not, the maximum gives an upper bound for every other
one, exact plans of any number of runs included.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from doe.problem.postures import CHUNK, Candidates, chunks
from doe.problem.problem import DesignProblem, PriorInformation, Stop, never
from identification.arrays import Array

CERTIFIED = 1.0 - 1e-6  # efficiency from which a plan is called optimal
REACHED = 1.0 - 1e-9  # efficiency from which searching on cannot matter
CACHED, FEWEST = 250_000, 1024  # entries of a chunk's Jacobians, which stay in the processor's cache; and postures
REMEMBERED = 4_000_000  # entries of candidates' Jacobians that are remembered between passes: 32 MB
LAST = 2.0  # [s] that a pass over the candidates may take after the time has ended, however short the search was


@dataclass(frozen=True)
class Certificate:
    """What a design proves about all others of its design space.

    value : criterion value of the design;  gap : max tr(G F) - tr(G M), which is zero exactly at an optimum
    bound : no design has a greater criterion value
    efficiency : fraction 0..1 of an optimum that the design reaches at least
    """

    value: float
    gap: float
    bound: float
    efficiency: float


def certify(problem: DesignProblem, information: Array, largest: float, gradient: Array | None = None) -> Certificate:
    """The certificate of a design with information M, given `largest` >= max tr(G F) over the design space.

    largest : inf proves nothing, and neither does a singular M; the certificate says so
    gradient : (p, p) G, default the criterion's at M; E-optimality needs the one of its dual problem
    """
    criterion = problem.criterion
    value = float(criterion.value(information))
    if np.isinf(largest) or np.isinf(value):  # not all of the design space was visited; a singular M has no tangent
        return Certificate(value, np.inf, np.inf, 0.0)
    slope = criterion.gradient(information) if gradient is None else gradient
    bound = criterion.upper_bound(information, largest)
    efficiency = criterion.efficiency(value, bound, problem.parameters)
    return Certificate(value, largest - float(np.sum(slope * information)), bound, efficiency)


def sensitivity(problem: DesignProblem, information: Array, postures: ArrayLike) -> Array:
    """(m,) tr(G B^T B) of postures (m, n), with G the criterion's gradient at the design's information matrix."""
    gradient = problem.criterion.gradient(information)
    return PriorInformation().sensitivities(problem.scaled_jacobians(postures), gradient)


@dataclass(frozen=True)
class CandidateJacobians:
    """Candidates chunk by chunk with their scaled Jacobians, which are remembered between passes where they are few."""

    problem: DesignProblem
    candidates: Candidates
    _remembered: list[tuple[Array, Array]] = field(default_factory=list, repr=False)

    def __iter__(self) -> Iterator[tuple[Array, Array]]:
        """Postures (k, n) and scaled Jacobians (k, d, p) of chunk after chunk."""
        if self._remembered:
            yield from self._remembered
            return
        each = self.problem.model.dimension * self.problem.parameters
        parts = chunks(self.candidates, int(np.clip(CACHED // each, FEWEST, CHUNK)))
        made = ((postures, self.problem.scaled_jacobians(postures)) for _, postures in parts)
        if len(self.candidates) * each > REMEMBERED:
            yield from made
            return
        self._remembered.extend(made)
        yield from self._remembered

    def sensitivities(self, gradient: Array, prior: PriorInformation) -> Iterator[tuple[Array, Array]]:
        """Per chunk: postures (k, n) and g (k,) = tr(G F). Never more than one chunk of values in memory."""
        positive = np.linalg.eigvalsh(gradient)[0] > 1e-14 * np.trace(gradient)
        root = np.linalg.cholesky(gradient) if positive else None
        for postures, jacobians in self:
            across = jacobians.transpose(1, 2, 0)  # (d, p, k) as `vectorize` has it
            half = (gradient if root is None else root.T) @ across  # tr(L L^T B^T B) = |L^T B^T|^2
            half *= across if root is None else half
            yield postures, prior.mixed(half.sum(axis=(0, 1)), gradient)


def last_pass(stop: Stop, began: float) -> Stop:
    """When to give a pass over the candidates up that begins now: the time has ended, and the pass takes longer than
    the search before it, which `began` at that `perf_counter`, and than `LAST` seconds."""
    now = perf_counter()
    end = now + max(LAST, now - began)
    return lambda: perf_counter() > end and stop()


def largest_sensitivity(
    problem: DesignProblem, candidates: Candidates, gradient: Array, prior: PriorInformation, give_up: Stop = never
) -> float:
    """max over the candidates of g = tr(G F), all of them visited, their Jacobians computed afresh.

    prior : per new run;  give_up : asked after every chunk; inf, which is no less than the largest, where it said so
    """
    largest = -np.inf
    for _, g in CandidateJacobians(problem, candidates).sensitivities(gradient, prior):
        largest = max(largest, float(g.max()))
        if give_up():
            return np.inf
    return largest
