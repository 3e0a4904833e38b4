"""The loop of column generation: a small working set of postures, and searches that offer it more.

    repeat:  weights   solve the small problem on the working set           (interior_point, convex_program)
             price     find postures with tr(G F(q)) above tr(G M)          (a stage)
             purge     drop postures that need not carry weight

Cheap stages come first; the last one decides. The loop ends when no posture improves the design.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from doe.bounds.approximate_design import SparseDesign
from doe.bounds.continuous import SAME, distinct
from doe.bounds.convex_program import smallest_eigenvalue_weights
from doe.bounds.equivalence import level
from doe.bounds.interior_point import solve_weights
from doe.bounds.weights import Weights, sparsest
from doe.criteria import Criterion
from doe.plan.plan import Plan
from doe.problem.prior import PriorInformation
from doe.problem.problem import DesignProblem, Stop, never
from identification.arrays import Array
from identification.errors import JobError

ROUNDS = 200
CROWD = 30  # postures per parameter
ROUGH = 1e-4  # gap of the weights relative to that of the postures, until the end
EXACT = 1e-14  # the same at the end: rounding
FINE = 1e-6  # gap of the postures from which the end is exact
NEGLIGIBLE = 1e-10  # weight below which a posture is dropped

# price(gradient, level, working postures) -> postures that improve the design (k, n), largest g over its whole set
Price = Callable[[Array, float, Array], tuple[Array, float]]


@dataclass(frozen=True)
class Stage:
    """One pricing, used until the gap it finds is below `goal` (relative).

    back : stages to go back when it found something: a cheaper search refines what a thorough one found
    """

    price: Price
    goal: float
    back: int = 0


@dataclass(frozen=True)
class WorkingSet:
    """The few postures of the master problem: postures (k, n), scaled Jacobians (k, d, p), and its solution."""

    problem: DesignProblem
    prior: PriorInformation
    postures: Array
    jacobians: Array
    solution: Weights

    @classmethod
    def solved(
        cls, problem: DesignProblem, prior: PriorInformation, postures: Array, jacobians: Array, accuracy: float
    ) -> WorkingSet:
        """A working set with optimal weights. Raises `JobError` if the postures do not identify all parameters."""
        check_identified(problem, prior, jacobians)
        weights = optimal_weights(jacobians, problem.criterion, prior, accuracy)
        return cls(problem, prior, postures, jacobians, weights)

    def refined(self, accuracy: float) -> WorkingSet:
        """The same postures with weights of another accuracy."""
        return self.solved(self.problem, self.prior, self.postures, self.jacobians, accuracy)

    def extended(self, offers: Array, accuracy: float, *, purge: bool) -> WorkingSet:
        """The set with new postures added and, if `purge`, those that need no weight removed; with new weights."""
        carrying = np.flatnonzero(self.sparse > 0.0) if purge else np.arange(len(self.postures))
        postures = np.concatenate([self.postures[carrying], offers])
        jacobians = np.concatenate([self.jacobians[carrying], self.problem.scaled_jacobians(offers)])
        once = np.sort(distinct(self.problem.comparable(postures)))
        return self.solved(self.problem, self.prior, postures[once], jacobians[once], accuracy)

    def has(self, offers: Array) -> bool:
        """True if every posture offered is in the set already."""
        comparable = self.problem.comparable
        own = comparable(self.postures)
        return all(np.abs(own - comparable(offer)).max(axis=1).min() <= SAME for offer in offers)

    @property
    def level(self) -> float:
        """tr(G M)."""
        return level(self.solution.gradient, self.prior.mixture(self.jacobians, self.solution.weights))

    @property
    def sparse(self) -> Array:
        """(k,) weights of the same information on as few postures as possible."""
        return sparsest(self.jacobians, np.where(self.solution.weights > NEGLIGIBLE, self.solution.weights, 0.0))

    @property
    def design(self) -> SparseDesign:
        """The plan that is reported."""
        weights = self.sparse
        order = np.argsort(-weights, kind="stable")[: np.count_nonzero(weights)]
        plan = Plan(self.postures[order], weights[order], self.problem.model.joint_types)
        dual = self.solution.gradient if self.problem.criterion.name == "E" else None
        return SparseDesign(self.problem, self.prior, plan, dual)


def generate_columns(
    problem: DesignProblem,
    prior: PriorInformation,
    start: Array,
    stages: Sequence[Stage],
    stop: Stop = never,
) -> tuple[SparseDesign, float]:
    """Optimal weights, and the gap (absolute) that the last pricing, of the last stage unless `stop` said so, found."""
    accuracy = EXACT  # of the weights; later, far from the end, exact ones would be wasted
    jacobians = problem.scaled_jacobians(start)
    if stop():  # before the first weights, which take seconds where parameters are many: equal ones prove a bound too
        check_identified(problem, prior, jacobians)
        working = WorkingSet(problem, prior, start, jacobians, equal_weights(jacobians, problem.criterion, prior))
    else:
        working = WorkingSet.solved(problem, prior, start, jacobians, accuracy)
    finest = EXACT if stages[-1].goal <= FINE else ROUGH * stages[-1].goal
    current, gap, smallest = 0, np.inf, np.inf
    for _ in range(ROUNDS):
        stage, reached = stages[current], working.level
        offers, largest = stage.price(working.solution.gradient, reached, working.postures)
        gap = largest - reached
        if stop():
            break
        stuck = accuracy == finest and working.has(offers)  # a gap that rounding leaves
        if len(offers) and gap > stage.goal * abs(reached) and not stuck:
            accuracy = max(ROUGH * gap / abs(reached), finest)
            # dropping postures although the gap has not shrunk can go in circles, never dropping any takes for ever
            crowded = len(working.postures) > CROWD * problem.parameters
            working = working.extended(offers, accuracy, purge=crowded or gap < 0.9 * smallest)
            smallest = min(smallest, gap)
            current -= stage.back
        elif accuracy > finest:
            accuracy = finest
            working = working.refined(accuracy)
        elif current == len(stages) - 1:
            break
        else:
            current, smallest = current + 1, np.inf
    return working.design, gap


def optimal_weights(
    jacobians: Array, criterion: Criterion, prior: PriorInformation, accuracy: float = EXACT
) -> Weights:
    """Optimal weights for scaled Jacobians (k, d, p), by the method that the criterion allows."""
    if criterion.name == "E":
        return smallest_eigenvalue_weights(jacobians, prior)
    return solve_weights(jacobians, criterion, prior, tolerance=accuracy)


def equal_weights(jacobians: Array, criterion: Criterion, prior: PriorInformation) -> Weights:
    """Equal weights for scaled Jacobians (k, d, p), with the gradient and the gap there."""
    weights = np.full(len(jacobians), 1.0 / len(jacobians))
    gradient = criterion.gradient(prior.mixture(jacobians, weights))
    g = prior.sensitivities(jacobians, gradient)
    return Weights(weights, gradient, float(g.max() - weights @ g), 0)


def check_identified(problem: DesignProblem, prior: PriorInformation, jacobians: Array) -> None:
    """Raises `JobError` where postures with these scaled Jacobians (k, d, p) do not identify all parameters."""
    equal = prior.mixture(jacobians, np.full(len(jacobians), 1.0 / len(jacobians)))
    if not np.isfinite(problem.criterion.value(equal)):
        raise JobError(
            "approximate design: the information matrix is singular on these postures, the parameters cannot all "
            "be identified; drop an effect or allow more postures"
        )
