"""Pricing: which postures column generation should add to its working set, out of a list or of all there are."""

from __future__ import annotations

import numpy as np

from doe.bounds.continuous import ContinuousSet, distinct
from doe.bounds.equivalence import CandidateJacobians, candidate_sensitivities
from doe.bounds.restricted_master import Price
from doe.problem.candidates import Candidates, PostureList
from doe.problem.prior import PriorInformation
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array

NEAR = 0.2  # [rad] times the root of the relative gap
SHORT = 30_000  # candidates of a shortlist, whose Jacobians are remembered
PARTS = 256  # of the candidates, of which each may offer one posture per round: keeps new postures apart


def candidate_price(
    problem: DesignProblem,
    candidates: Candidates,
    prior: PriorInformation,
    give_up: Stop = never,
) -> Price:
    """Price of a candidate set: every candidate is evaluated, and each chunk offers its best.

    give_up : asked after every chunk; no offers and inf, which is no less than the largest, where it said so
    """
    part = max(16, -(-len(candidates) // PARTS))
    jacobians = CandidateJacobians(problem, candidates)

    def price(gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        offers, values = [near[:0]], [np.empty(0)]
        for postures, g in candidate_sensitivities(jacobians, gradient, prior):
            edges = np.arange(0, len(g), part)
            top = np.array([edge + int(np.argmax(g[edge : edge + part])) for edge in edges])
            offers.append(postures[top])
            values.append(g[top])
            if give_up():
                return near[:0], np.inf
        return _best_offers(np.concatenate(offers), np.concatenate(values), level, 3 * problem.parameters)

    return price


class Shortlist:
    """The best candidates found in the last full pass over a very large set; pricing them needs no further pass."""

    def __init__(self, problem: DesignProblem, candidates: Candidates, prior: PriorInformation) -> None:
        self.problem, self.prior = problem, prior
        self.all = CandidateJacobians(problem, candidates)
        self.short: Price | None = None

    def best(self, gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        """`Price` of the shortlist, or of all candidates while there is no shortlist yet."""
        return self.everything(gradient, level, near) if self.short is None else self.short(gradient, level, near)

    def everything(self, gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        """`Price` of all candidates, which makes the shortlist anew."""
        best: list[tuple[Array, Array]] = []
        floor, count = -np.inf, 0
        for some, g in candidate_sensitivities(self.all, gradient, self.prior):
            above = g > floor
            best.append((some[above], g[above]))
            count += len(best[-1][1])
            if count > 2 * SHORT:
                best = [_highest(best)]
                floor, count = float(best[0][1].min()), SHORT
        self.short = candidate_price(self.problem, PostureList(_highest(best)[0]), self.prior)
        return self.short(gradient, level, near)


def _highest(offers: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """(SHORT, n) the postures of greatest value of all, and their values, greatest first."""
    postures, values = (np.concatenate(parts) for parts in zip(*offers, strict=True))
    order = np.argsort(-values, kind="stable")[:SHORT]
    return postures[order], values[order]


def continuous_price(
    everything: ContinuousSet, generator: np.random.Generator | None = None, stop: Stop = never
) -> Price:
    """The local maxima that a multistart ascent finds; a thorough one with fresh starts where a generator is given."""

    def price(gradient: Array, level: float, near: Array) -> tuple[Array, float]:
        postures, values = everything.best(gradient, near, generator, stop)
        # a posture this near to a better one differs in value by a small part of the gap: one of the two is enough
        apart = distinct(everything.problem.comparable(postures), NEAR * np.sqrt(max(values[0] / level - 1.0, 0.0)))
        postures, values = postures[apart], values[apart]
        return _best_offers(postures, values, level, 10 * everything.problem.parameters, 0.0)

    return price


def _best_offers(
    postures: Array, values: Array, level: float, count: int, fraction: float = 0.1
) -> tuple[Array, float]:
    largest = float(values.max())
    order = np.argsort(-values)[:count]
    order = order[values[order] > level + fraction * max(largest - level, 0.0)]
    return postures[order], largest
